"""What dry friction, stops and the parts of a bench cost: time per run with each against without.

    python experiments/cost_of_the_bench.py

All after `configure_cpu()`. Located: 128 runs under `vmap`, as many as a step of `cpjax tune` has, and 512; values and
gradients in the cart's mass, on the continuous clock with dry friction and without, and values by `cpjax.sweep`.
Per step: sweeps of 4,096 `hanging` initial states, in both precisions.
Every case is compiled first; then all run in turn, several times, so that a busy machine slows all of them. A ratio is
that of the medians over the laps.
"""

import dataclasses
import functools
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

DURATION, PERIOD, RUNS, STARTS = 4.0, 2e-3, (128, 512), 4096
PLANT = paper.appendix_plant()
LAW = paper.controller("corrected-centred", "placement", PLANT)
DRY = dataclasses.replace(PLANT, coulomb_friction=1.0, pivot_coulomb_friction=0.01, static_friction_ratio=1.2)
PLANTS = {"ideal": PLANT, "dry friction": DRY}


def seconds(calls: Mapping[str, Callable[[], Any]], laps: int) -> dict[str, float]:
    """Returns the median time of each call [s], called in turn."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for lap in range(laps + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())  # type: ignore[no-untyped-call]  # untyped in JAX
            if lap:  # the first compiles
                taken[name].append(time.perf_counter() - begin)
    return {name: float(np.median(times)) for name, times in taken.items()}


def located(count: int, duration: float, laps: int, seed: int) -> dict[str, float]:
    """Returns the time of located rollouts, without and with dry friction, values and gradients."""
    starts = cpjax.sample_starts("hanging", count, seed=seed)

    def one(mass: Any, start: cpjax.State, plant: cpjax.CartPole) -> Any:
        settings: dict[str, Any] = {"duration": duration, "dt": PERIOD, "clock": "continuous"}
        moved = dataclasses.replace(plant, cart_mass=mass)
        return cpjax.measure(moved, LAW, start, metrics=cpjax.TimeOutside(), switching="located", **settings)

    calls = {}
    for kind, function in (("values", one), ("gradients", jax.value_and_grad(one))):
        for name, plant in PLANTS.items():
            compiled = jax.jit(jax.vmap(functools.partial(function, plant=plant), (None, 0)))
            calls[f"{kind}, {name}"] = functools.partial(compiled, jnp.asarray(PLANT.cart_mass), starts)
    metric = cpjax.TimeOutside()
    settings: dict[str, Any] = {"duration": duration, "dt": PERIOD, "clock": "continuous", "switching": "located"}
    for name, plant in PLANTS.items():
        calls[f"in a sweep, {name}"] = functools.partial(cpjax.sweep, plant, LAW, starts, metrics=metric, **settings)
    return seconds(calls, laps)


def benches() -> dict[str, Any]:
    """Returns rigs by name; the first is ideal."""
    pushes = cpjax.Disturbance(pushes=cpjax.RandomPushes(cart=3.0))
    return {
        "ideal": PLANT,
        "dry friction": DRY,
        "stops": cpjax.Rig(PLANT, track=cpjax.Track(half_length=0.8, ends="stop", restitution=0.3)),
        "dry friction, stops": cpjax.Rig(DRY, track=cpjax.Track(half_length=0.8, ends="stop", restitution=0.3)),
        "lag": cpjax.Rig(PLANT, drive=cpjax.Drive(lag=5e-3)),
        "inductance": dataclasses.replace(PLANT, motor=dataclasses.replace(PLANT.motor, inductance=1e-3)),
        "random pushes": cpjax.Rig(PLANT, disturbance=pushes),
        "wind": cpjax.Rig(PLANT, disturbance=cpjax.Disturbance(wind=cpjax.Wind(force=0.3))),
        "drive noise": cpjax.Rig(PLANT, drive=cpjax.Drive(noise=0.2)),
    }


def swept(count: int, duration: float, laps: int, seed: int, dtype: Any) -> dict[str, float]:
    """Returns the time of sweeps on each rig."""
    starts = cpjax.sample_starts("hanging", count, seed=seed, dtype=dtype)
    settings: dict[str, Any] = {"duration": duration, "dt": PERIOD, "seed": seed}
    return seconds(
        {name: functools.partial(cpjax.sweep, rig, LAW, starts, **settings) for name, rig in benches().items()}, laps
    )


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the tables and writes cost_of_the_bench.json."""
    duration, laps, runs, starts = (0.1, 1, (8,), 64) if quick else (DURATION, 9, RUNS, STARTS)
    found: dict[str, Any] = {f"located, {many} runs": located(many, duration, laps, seed) for many in runs}
    counts = dict(zip(found, runs, strict=True))
    for dtype in (np.float32, np.float64):
        found[dtype.__name__] = swept(starts, duration, laps, seed, dtype)
    rows = []
    for table, times in found.items():
        for name, taken in times.items():
            ideal = times[f"{name.split(', ')[0]}, ideal"] if table in counts else times["ideal"]
            each = taken / counts.get(table, starts)
            rows.append((table, name, f"{1e6 * each:.1f}", f"{taken / ideal:.2f}"))
    print_table("Cost of the bench", ("table", "case", "microseconds per run", "time / ideal"), rows, 2)
    files.write_json(out / "cost_of_the_bench.json", {"versions": files.versions(), "seed": seed, "seconds": found})
    return found


if __name__ == "__main__":
    cpjax.configure_cpu()
    run(main, __doc__ or "")
