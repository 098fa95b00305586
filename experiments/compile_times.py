"""What compiling costs: tracing, lowering and compiling of a sweep, gradients and designs, cold and from JAX's cache.

    python experiments/compile_times.py

Every case is compiled in fresh processes: with nothing set; after `configure_cpu()` with an empty compilation cache;
and once more with what that one left there, warm. All have 64 `hanging` starts, 3 s at 2 ms, float64, but the sweep,
which has 4,096 and is timed by its calls: the first less the second. Gradients are in eight parameters of the
corrected, centred law with pole placement.
"""

import dataclasses
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table
from cpjax.linear import stability_margins

LOOPS: dict[str, dict[str, Any]] = {
    "sampled": {"clock": "sampled"},
    "mean derivative": {"clock": "sampled", "derivative": "mean"},
    "located": {"clock": "continuous", "switching": "located"},
}
CASES = (
    "sweep",
    *(
        f"{loop}, {kind}"
        for loop in LOOPS
        for kind in ("values", "gradient")
        if (loop, kind) != ("mean derivative", "values")
    ),
    "dry friction, located, gradient",
    "encoders and observer, gradient",
    "lqr",
    "place",
    "stability margins",
)


def _objective(settings: Mapping[str, Any], dry: bool = False, bench: bool = False) -> Callable[..., jax.Array]:
    plant: Any = paper.appendix_plant()
    if dry:
        plant = dataclasses.replace(plant, coulomb_friction=1.0, pivot_coulomb_friction=0.01)
    rig = cpjax.Rig(plant, sensors=cpjax.Encoders(x_step=2e-5, theta_step=1.5e-3)) if bench else plant

    def outside(p: Mapping[str, jax.Array], start: cpjax.State) -> jax.Array:
        numbers = {name: p[name] for name in ("energy_gain", "cart_stiffness", "cart_damping")}
        law: Any = cpjax.Hybrid(
            cpjax.EnergySwingUp(plant, **numbers), cpjax.StateFeedback(p["K"][None]), cpjax.AngleGate(p["half_angle"])
        )
        if bench:
            law = cpjax.Digital(law, estimator=cpjax.Observer(plant, poles=(-60.0, -61.0, -62.0, -63.0)))
        found: jax.Array = cpjax.measure(
            rig, law, start, duration=3.0, dt=2e-3, metrics=cpjax.TimeOutside(), **settings
        )
        return found

    return outside


def _function(case: str) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """Returns the function that is compiled, and its arguments."""
    plant = paper.appendix_plant()
    A, B = cpjax.linearize(plant)
    Q = jnp.eye(4)
    K = jnp.asarray(paper.PRINTED_GAINS["placement"])
    if case == "lqr":
        return lambda Q: cpjax.lqr(A, B, Q, 1.0), (Q,)
    if case == "place":
        return lambda poles: cpjax.place(A, B, poles), (jnp.asarray([-3.0, -4.0, -5.0, -6.0]),)
    if case == "stability margins":
        return lambda K: stability_margins(A, B, K[None]), (K,)
    loop = next((name for name in LOOPS if name in case), "sampled")
    outside = _objective(LOOPS[loop], dry="dry friction" in case, bench="observer" in case)
    function = outside if case.endswith("values") else jax.value_and_grad(outside)
    parameters = {
        "energy_gain": jnp.asarray(5.0),
        "cart_stiffness": jnp.asarray(4.0),
        "cart_damping": jnp.asarray(2.0),
        "half_angle": jnp.asarray(paper.SWITCH_ANGLE),
        "K": K,
    }
    starts = jax.tree.map(jnp.asarray, cpjax.sample_starts("hanging", 64, seed=1))
    return jax.vmap(function, (None, 0)), (parameters, starts)


def _sweep() -> dict[str, float]:
    """Returns how much longer the first of two sweeps takes [s]."""
    plant = paper.appendix_plant()
    law = paper.controller("corrected-centred", "placement", plant)
    starts = cpjax.sample_starts("hanging", 4096, seed=1)
    seconds = []
    for _ in range(2):
        begin = time.perf_counter()
        jax.block_until_ready(cpjax.sweep(plant, law, starts, duration=3.0, dt=2e-3))  # type: ignore[no-untyped-call]  # untyped in JAX
        seconds.append(time.perf_counter() - begin)
    return {"all": seconds[0] - seconds[1]}


def _phases(case: str) -> dict[str, float]:
    """Returns what each phase takes [s]."""
    function, arguments = _function(case)
    times = [time.perf_counter()]
    traced = jax.jit(function).trace(*arguments)
    times.append(time.perf_counter())
    lowered = traced.lower()
    times.append(time.perf_counter())
    lowered.compile()
    times.append(time.perf_counter())
    phases = [after - before for before, after in itertools.pairwise(times)]
    return dict(zip(("trace", "lower", "compile", "all"), [*phases, sum(phases)], strict=True))


def _in_a_process(case: str, cache: str, configured: bool) -> dict[str, float]:
    environment = os.environ | {
        "JAX_ENABLE_X64": "1",
        "JAX_COMPILATION_CACHE_DIR": cache,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    done = subprocess.run(
        [sys.executable, __file__, "--measure", case, "configured" if configured else "bare"],
        check=False,
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(done.stderr)
    measured: dict[str, float] = json.loads(done.stdout)
    return measured


def main(out: Path, quick: bool = False, seed: int = 1, count: int = 3) -> list[dict[str, Any]]:
    """Prints the table, of medians over `count` laps, and writes compile_times.json."""
    found: dict[str, list[tuple[dict[str, float], ...]]] = {}
    for _ in range(1 if quick else count):
        for case in ("lqr",) if quick else CASES:
            with tempfile.TemporaryDirectory() as other, tempfile.TemporaryDirectory() as cache:
                bare = _in_a_process(case, other, configured=False)
                found.setdefault(case, []).append((bare, *(_in_a_process(case, cache, configured=True) for _ in "12")))
    rows: list[dict[str, Any]] = [
        {
            "case": case,
            **{
                kept: {phase: statistics.median(lap[place][phase] for lap in laps) for phase in laps[0][place]}
                for place, kept in enumerate(("bare", "cold", "warm"))
            },
        }
        for case, laps in found.items()
    ]
    phases = ("trace", "lower", "compile", "all")
    cells = [
        [
            row["case"],
            f"{row['bare']['all']:.2f}",
            *(f"{row['cold'][p]:.2f}" if p in row["cold"] else "" for p in phases),
            f"{row['warm']['all']:.2f}",
        ]
        for row in rows
    ]
    print_table("Compiling [s]", ("case", "all, bare", *phases, "all, warm"), cells, text_columns=1)
    files.write_json(out / "compile_times.json", {"versions": files.versions(), "rows": rows})
    return rows


if __name__ == "__main__":
    if sys.argv[1:2] == ["--measure"]:
        if sys.argv[3] == "configured":
            cpjax.configure_cpu()
        print(json.dumps(_sweep() if sys.argv[2] == "sweep" else _phases(sys.argv[2])))
    else:
        run(main, __doc__ or "")
