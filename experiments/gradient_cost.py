"""What located switching and gradients cost, against the rollout that reads its mode once per step.

    python experiments/gradient_cost.py

64 starts (and 4,096 in chunks of 64), 10 s at steps of 2 ms, float64, the smooth time outside the target of the
corrected, centred law with pole placement; derivatives in eight parameters. On the sampled clock, the derivative of the
mean beside the pathwise one. All after `configure_cpu(1)`, on one core. Everything is compiled first; then all ways run
in turn, several times, so that a busy machine slows all of them. Memory is what the compiler sets aside for
temporaries.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table

DURATION, DT = 10.0, 2e-3


def objective(
    switching: Any, checkpoint: Any, duration: float, derivative: Any = "pathwise"
) -> Callable[[Mapping[str, jax.Array], Any], jax.Array]:
    """The time outside the target as a function of eight parameters and a start."""
    plant = paper.appendix_plant()

    def outside(p: Mapping[str, jax.Array], start: cpjax.State) -> jax.Array:
        numbers = {name: p[name] for name in ("energy_gain", "cart_stiffness", "cart_damping")}
        law = cpjax.Hybrid(
            cpjax.EnergySwingUp(plant, **numbers), cpjax.StateFeedback(p["K"][None]), cpjax.AngleGate(p["half_angle"])
        )
        settings: dict[str, Any] = {"checkpoint": checkpoint, "clock": "continuous", "switching": switching}
        if switching == "per_step":
            settings["derivative"] = derivative  # its cost is what is asked for here
        if switching == "sampled":
            settings |= {"clock": "sampled", "switching": None, "derivative": derivative}
        settings = {name: value for name, value in settings.items() if value is not None}
        found: jax.Array = cpjax.measure(
            plant, law, start, duration=duration, dt=DT, metrics=cpjax.TimeOutside(), **settings
        )
        return found

    return outside


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes gradient_cost.json."""
    duration, repeats, many = (0.1, 1, 64) if quick else (DURATION, 5, 4096)
    parameters = {
        "energy_gain": jnp.asarray(5.0),
        "cart_stiffness": jnp.asarray(4.0),
        "cart_damping": jnp.asarray(2.0),
        "half_angle": jnp.asarray(paper.SWITCH_ANGLE),
        "K": jnp.asarray(paper.PRINTED_GAINS["placement"]),
    }
    few, lots = (jax.tree.map(jnp.asarray, cpjax.sample_starts("hanging", n, seed=seed)) for n in (64, many))

    ways: dict[tuple[int, str, str], Any] = {}
    for switching in ("per_step", "located"):
        plain = objective(switching, "every_step", duration)
        segments = objective(switching, "segments", duration)
        ways[64, switching, "values"] = _compiled(jax.vmap(plain, (None, 0)), parameters, few)
        if quick:
            continue
        ways[64, switching, "forward"] = _compiled(_gradients(plain, "forward"), parameters, few)
        ways[64, switching, "reverse, every step"] = _compiled(_gradients(plain, "reverse"), parameters, few)
        ways[64, switching, "reverse, segments"] = _compiled(_gradients(segments, "reverse"), parameters, few)
        ways[many, switching, "values"] = _compiled(_chunked(plain), parameters, lots)
        ways[many, switching, "reverse, every step"] = _compiled(_gradients(plain, "reverse"), parameters, lots)

    if not quick:
        ways[64, "sampled", "values"] = _compiled(
            jax.vmap(objective("sampled", "segments", duration), (None, 0)), parameters, few
        )
        for kind in ("pathwise", "mean"):
            for checkpoint, words in (("every_step", "every step"), ("segments", "segments")):
                sampled = objective("sampled", checkpoint, duration, kind)
                ways[64, "sampled", f"reverse, {words}, {kind}"] = _compiled(
                    _gradients(sampled, "reverse"), parameters, few
                )

    times: dict[Any, list[float]] = {key: [] for key in ways}
    for _ in range(repeats):
        for key, (compiled, starts, _) in ways.items():
            begin = time.perf_counter()
            jax.block_until_ready(compiled(parameters, starts))  # type: ignore[no-untyped-call]  # untyped in JAX
            times[key].append(time.perf_counter() - begin)

    steps = round(duration / DT)
    rows = []
    for key, (compiled, _, compile_time) in ways.items():
        starts, switching, way = key
        best = min(times[key])
        rows.append(
            {
                "starts": starts,
                "switching": switching,
                "way": way,
                "seconds": best,
                "median_seconds": float(np.median(times[key])),
                "million_steps_per_second": starts * steps / best / 1e6,
                "times_its_values": best / min(times[starts, switching, "values"]),
                "times_per_step_values": best / min(times[starts, "per_step", "values"]),
                "temporary_MiB": compiled.memory_analysis().temp_size_in_bytes / 2**20,
                "compile_seconds": compile_time,
            }
        )
    header = (
        "starts",
        "switching",
        "way",
        "best [s]",
        "M steps/s",
        "x its values",
        "x per-step values",
        "MiB",
        "compile",
    )
    cells = [
        [
            str(r["starts"]),
            r["switching"],
            r["way"],
            f"{r['seconds']:.3f}",
            f"{r['million_steps_per_second']:.2f}",
            f"{r['times_its_values']:.2f}",
            f"{r['times_per_step_values']:.2f}",
            f"{r['temporary_MiB']:.1f}",
            f"{r['compile_seconds']:.1f}",
        ]
        for r in rows
    ]
    print_table("Cost of located switching and of gradients", header, cells, text_columns=3)
    files.write_json(out / "gradient_cost.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


def _chunked(outside: Any) -> Any:
    return lambda p, starts: jax.lax.map(lambda start: outside(p, start), starts, batch_size=64)


def _gradients(outside: Any, direction: Any) -> Any:
    return lambda p, starts: cpjax.gradients(outside, p, starts, direction=direction, chunk=64)


def _compiled(function: Any, parameters: Any, starts: Any) -> tuple[Any, Any, float]:
    """Compiled and run once; with the starts, and how long compiling took [s]."""
    lowered = jax.jit(function).lower(parameters, starts)
    begin = time.perf_counter()
    compiled = lowered.compile()
    elapsed = time.perf_counter() - begin
    jax.block_until_ready(compiled(parameters, starts))  # type: ignore[no-untyped-call]  # untyped in JAX
    return compiled, starts, elapsed


if __name__ == "__main__":
    cpjax.configure_cpu(1)
    run(main, __doc__ or "")
