"""A reference for the settling time: the shortest that direct collocation finds, start by start.

    python experiments/reference_times.py

For 64 `hanging` starts: the least time after which |theta| <= 0.05 rad and |x| <= 0.05 m hold for 1 s, with |u| <= 12 V
and a free track, by Hermite and Simpson's rule and IPOPT (CasADi, the extra "baselines"), the better of two first
guesses: the runs of the two shipped laws. Locally optimal: the best that was found, not a bound. The shipped laws stand
beside it.
"""

import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
from _common import run

from cpjax import files, paper
from cpjax.plant import CartPole
from cpjax.plant.initial_states import sample_starts
from cpjax.plant.state import NAMES, State
from cpjax.presets import preset
from cpjax.sim.metrics import Metrics
from cpjax.sim.rollout import rollout
from cpjax.sim.sweep import sweep

INTERVALS, HOLD, HOLD_INTERVALS, BAND = 80, 1.0, 20, 0.05


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the ratios and writes reference_times.json."""
    plant = paper.appendix_plant()
    count = 1 if quick else 64
    starts = sample_starts("hanging", count, seed=40_000 + seed)
    laws = {design: preset(design) for design in get_args(paper.Design)}
    times = {}
    for design, law in laws.items():
        found: Metrics = sweep(plant, law, starts, duration=20.0, dt=0.002, clock="sampled")
        times[design] = np.asarray(found.settling_time)
    try:
        import casadi
    except ImportError:
        print("the package casadi is missing: no reference")
        files.write_json(out / "reference_times.json", {"versions": files.versions(), "settling_times": times})
        return {}
    best = np.full(count, math.inf)
    for i in range(count):
        start = State(*(float(getattr(starts, name)[i]) for name in NAMES))
        for law in laws.values():
            guess = rollout(plant, law, start, duration=4.0, dt=0.004, clock="sampled")
            best[i] = min(best[i], _shortest(casadi, plant, start, guess))
        if (i + 1) % 8 == 0 or quick:
            print(
                f"{i + 1} of {count}: reference {np.min(best[: i + 1]):.3f} to {np.max(best[: i + 1]):.3f} s",
                flush=True,
            )
            files.write_json(out / "reference_times.json", {"reference": best[: i + 1]})
    solved = np.isfinite(best)
    result: dict[str, Any] = {"versions": files.versions(), "reference": best, "solved": int(solved.sum()), "laws": {}}
    for design, time in times.items():
        ratio = (time / best)[solved]
        result["laws"][design] = {
            "settling_times": time,
            "mean_ratio": float(ratio.mean()),
            "worst": float(ratio.max()),
        }
        print(f"{design}: {ratio.mean():.3f} times the reference on average, {ratio.max():.3f} at worst")
    print(f"reference: {best[solved].mean():.3f} s on average, {int(solved.sum())} of {count} solved")
    files.write_json(out / "reference_times.json", result)
    return result


def _shortest(casadi: Any, plant: CartPole, start: State, guess: Any) -> float:
    """The time found from one guess [s]; infinite if IPOPT does not converge."""
    field = _field(casadi, plant)
    problem = casadi.Opti()
    n, m = INTERVALS, HOLD_INTERVALS
    S, U = problem.variable(4, n + m + 1), problem.variable(1, n + m + 1)
    duration = problem.variable()
    limit = float(plant.motor.voltage_limit)
    theta = np.asarray(guess.state.theta)
    end = 2.0 * math.pi * round(float(theta[-1]) / (2.0 * math.pi))
    problem.minimize(duration)
    for k in range(n + m):
        h = duration / n if k < n else HOLD / m
        a, b, u, v = S[:, k], S[:, k + 1], U[k], U[k + 1]
        fa, fb = field(a, u), field(b, v)
        middle = (a + b) / 2 + h / 8 * (fa - fb)
        problem.subject_to(b - a == h / 6 * (fa + 4 * field(middle, (u + v) / 2) + fb))
    problem.subject_to(problem.bounded(-limit, U, limit))
    problem.subject_to(problem.bounded(0.3, duration, 6.0))
    problem.subject_to(S[:, 0] == np.asarray(start.vector()))
    for k in range(n, n + m + 1):
        problem.subject_to(problem.bounded(end - BAND, S[2, k], end + BAND))
        problem.subject_to(problem.bounded(-BAND, S[0, k], BAND))
    time = np.asarray(guess.time)
    first = 2.2
    at = np.concatenate([np.linspace(0.0, first, n + 1), first + np.linspace(0.0, HOLD, m + 1)[1:]])
    for row, name in enumerate(NAMES):
        problem.set_initial(S[row, :], np.interp(at, time, np.asarray(getattr(guess.state, name))))
    problem.set_initial(U, np.interp(at, time, np.asarray(guess.voltage))[None])
    problem.set_initial(duration, first)
    problem.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 400})
    try:
        solved = problem.solve()
        return float(solved.value(duration))
    except RuntimeError:
        return math.inf


def _field(casadi: Any, plant: CartPole) -> Any:
    """The appendix's plant in CasADi, written out once more: a point bob on a massless pole."""
    M, m, l, g = (float(x) for x in (plant.moving_mass, plant.pole_mass, plant.pole_length, plant.gravity))
    per_volt, damping = float(plant.motor.force_per_voltage), float(plant.motor.damping)

    def field(s: Any, u: Any) -> Any:
        sin, cos = casadi.sin(s[2]), casadi.cos(s[2])
        force = per_volt * u - damping * s[1] - m * l * sin * s[3] ** 2
        x = (force + m * g * sin * cos) / (M + m * sin**2)
        return casadi.vertcat(s[1], x, s[3], (cos * x + g * sin) / l)

    return field


if __name__ == "__main__":
    run(main, __doc__ or "")
