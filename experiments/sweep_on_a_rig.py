"""What a rig costs a sweep: noise, a delay and estimators, against the ideal rig.

    python experiments/sweep_on_a_rig.py

4,096 `hanging` initial states, 4 s at steps and control periods of 2 ms, in float32 after `configure_cpu()`, with the
corrected, centred law and its pole placement. Every case is compiled first; then all run in turn, several times, so
that a busy machine slows all of them. Look at the ratios: they are medians over the laps.
"""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table

DURATION, PERIOD, STARTS = 4.0, 2e-3, 4096


def cases(plant: cpjax.CartPole) -> dict[str, tuple[Any, Any]]:
    """Returns rig and firmware by name; the first is ideal."""
    law = paper.controller("corrected-centred", "placement", plant)
    x_step, theta_step = 2.275e-5, 2.0 * np.pi / 4096
    sensors = cpjax.Encoders(x_step=x_step, theta_step=theta_step, x_noise=x_step, theta_noise=theta_step)
    # What noise of one step and rounding to a step do together.
    deviations = {"x_deviation": x_step * (13 / 12) ** 0.5, "theta_deviation": theta_step * (13 / 12) ** 0.5}
    rig = cpjax.Rig(plant, sensors=sensors, drive=cpjax.Drive(delay=PERIOD))
    observer = cpjax.kalman_observer(plant, period=PERIOD, **deviations)
    fine = cpjax.Observer(plant, observer.gain, prediction="runge-kutta")
    filters = {kind: cpjax.KalmanFilter(plant, **deviations, kind=kind) for kind in ("time-varying", "extended")}
    return {
        "ideal rig": (plant, law),
        "noise, delay, filtered derivative": (rig, cpjax.Digital(law, cpjax.FilteredDerivative(300.0))),
        "noise, delay, observer": (rig, cpjax.Digital(law, observer)),
        "noise, delay, observer that knows it": (rig, cpjax.Digital(law, observer, delay=1)),
        "noise, delay, observer by runge-kutta": (rig, cpjax.Digital(law, fine)),
        "noise, delay, time-varying filter": (rig, cpjax.Digital(law, filters["time-varying"])),
        "noise, delay, extended filter": (rig, cpjax.Digital(law, filters["extended"])),
    }


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes sweep_on_a_rig.json."""
    duration, laps, count = (0.1, 1, 64) if quick else (DURATION, 15, STARTS)
    starts = cpjax.sample_starts("hanging", count, seed=seed, dtype=np.float32)
    settings: dict[str, Any] = {"duration": duration, "dt": PERIOD, "control_period": PERIOD, "seed": seed}
    known = cases(paper.appendix_plant())
    calls: dict[str, Callable[[], Any]] = {
        name: functools.partial(cpjax.sweep, rig, firmware, starts, **settings)
        for name, (rig, firmware) in known.items()
    }
    for call in calls.values():
        call()
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(laps):
        for name, call in calls.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())  # type: ignore[no-untyped-call]  # untyped in JAX
            seconds[name].append(time.perf_counter() - begin)

    steps = count * round(duration / PERIOD)
    ideal = np.array(seconds["ideal rig"])
    rows: list[dict[str, Any]] = []
    for name in calls:
        low, ratio, high = np.quantile(ideal / np.array(seconds[name]), (0.25, 0.5, 0.75))
        rows.append(
            {
                "case": name,
                "median_seconds": float(np.median(seconds[name])),
                "million_steps_per_second": steps / float(np.median(seconds[name])) / 1e6,
                "rate_of_the_ideal_rigs": float(ratio),
                "quartiles": [float(low), float(high)],
            }
        )
    texts = [
        (
            r["case"],
            f"{r['million_steps_per_second']:.1f}",
            f"{r['rate_of_the_ideal_rigs']:.2f}",
            "{:.2f} to {:.2f}".format(*r["quartiles"]),
        )
        for r in rows
    ]
    header = ("case", "M steps/s", "rate / ideal", "quartiles")
    print_table(f"Sweeps of {count} initial states on a rig, float32", header, texts, 1)
    files.write_json(out / "sweep_on_a_rig.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


if __name__ == "__main__":
    cpjax.configure_cpu()
    run(main, __doc__ or "")
