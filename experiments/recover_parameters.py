"""Parameters recovered from printed gains: the paper's, and those of made-up rigs, where the truth is known.

    python experiments/recover_parameters.py

The paper: which changes of its appendix explain its eight printed gains. The rigs: random plants whose gains are
printed with two decimals; the audit is given a plant with some parameters wrong, and what it finds is held against the
rig.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from _common import run

from cpjax import files, paper
from cpjax.paper.gain_identification import GainAudit, audit_gains, document
from cpjax.paper.plant_fit import PARAMETERS
from cpjax.paper.printed_gains import PrintedGain
from cpjax.paper.printed_gains import printed_in_the_paper as papers_prints
from cpjax.plant import CartPole, Motor, linearize, with_parameters
from cpjax.show.figures import save_figure
from cpjax.show.gain_identification import (
    DIRECTION_HEADER,
    FIT_HEADER,
    direction_cells,
    findings,
    fit_cells,
    picture,
    shown_fits,
)

IDENTIFIABLE = ("pole_length", "cart_friction", "torque_constant")
"""Three that the gains tell apart."""

INSEPARABLE = ("torque_constant", "resistance")
"""Two that the equations of motion hold only as a ratio."""

Q, R, POLES = (100.0, 1.0, 500.0, 1.0), 1e-3, (-2.0, -3.0, -4.0, -5.0)


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the tables and writes recover_parameters.json and recover_parameters.png."""
    names = ("cart_friction", "torque_constant") if quick else PARAMETERS
    plant, starts, count = paper.appendix_plant(), 8 if quick else 128, 2 if quick else 16
    print(f"The paper's gains, {starts} random starts for each set of parameters\n")
    audit = audit_gains(papers_prints(), plant, parameters=names, starts=starts, seed=seed)
    print_audit(audit, plant)
    numbers = linear_numbers(audit.plant)
    print(
        f"\nThe best has a force per volt of {numbers['force_per_voltage']:.5f} N/V and a total damping of "
        f"{numbers['damping']:.5f} N s/m. Of each explanation's {starts} random starts, at least "
        f"{round(starts * min((fit.reached for fit in audit.simplest), default=0.0))} end in it.\n"
    )
    result = {
        "versions": files.versions(),
        "seed": seed,
        "paper": {**document(audit, papers_prints(), plant, starts=starts, parameters=names), "numbers": numbers},
        "rigs": recovered_rigs(IDENTIFIABLE[: 2 if quick else 3], count, starts=8 if quick else 32, seed=seed),
        "ratio": recovered_ratio(starts=8 if quick else 32, seed=seed),
    }
    files.write_json(out / "recover_parameters.json", result)
    save_figure(out / "recover_parameters.png", picture(audit))
    return result


def recovered_rigs(names: Sequence[str], count: int, *, starts: int, seed: int) -> list[dict[str, Any]]:
    """Rigs of which the named parameters are wrong, and known to be: what errors remain, beside `known_to`."""
    print(f"Made-up rigs: {', '.join(names)} wrong by up to a factor of 1.5, gains with two decimals\n")
    rows: list[dict[str, Any]] = []
    for number in range(count):
        rig, wrong = random_rig(np.random.default_rng([seed, number]), names)
        audit = audit_gains(prints_of(rig), wrong, parameters=names, most=len(names), starts=starts, seed=seed)
        fit = audit.simplest[0] if audit.simplest else audit.best(len(names))
        error = {n: math.log(value_of(audit.plant, n) / value_of(rig, n)) for n in names}
        rows.append(
            {
                "truth": {name: value_of(rig, name) for name in names},
                "before": {name: value_of(wrong, name) for name in names},
                "found": {name: value_of(audit.plant, name) for name in names},
                "reached": fit.reached,
                "worst_residual": fit.worst,
                "known_to": [d.known_to for d in audit.directions],
                "error": [sum(w * error[n] for n, w in d.weights.items()) for d in audit.directions],
                "linear_model_error": linear_model_error(audit.plant, rig),
            }
        )
    header = ("rig", "worst error before", "after", "along each combination, in units of `known to`", "agree")
    body = []
    for number, row in enumerate(rows):
        before, after = (max(abs(row[k][n] / row["truth"][n] - 1.0) for n in names) for k in ("before", "found"))
        units = [abs(e) / k for e, k in zip(row["error"], row["known_to"], strict=True)]
        shares = " ".join(f"{u:5.2f}" for u in units)
        body.append(
            [str(number), f"{100 * before:.1f} %", f"{100 * after:.2g} %", shares, f"{100 * row['reached']:.0f} %"]
        )
    print_table(header, body)
    units = [abs(e) / k for row in rows for e, k in zip(row["error"], row["known_to"], strict=True)]
    print(
        f"\n{sum(u <= 1.0 for u in units)} of {len(units)} errors are within `known to`; the largest is "
        f"{max(units):.2f} times as large (rounding of eight numbers allows {math.sqrt(8):.2f} times). The linear "
        f"model is recovered to {max(row['linear_model_error'] for row in rows):.1e} of its largest entry.\n"
    )
    return rows


def recovered_ratio(*, starts: int, seed: int) -> dict[str, Any]:
    """A rig with two wrong parameters of which the gains know the ratio only."""
    rig, wrong = random_rig(np.random.default_rng([seed, 1000]), INSEPARABLE)
    audit = audit_gains(prints_of(rig), wrong, parameters=INSEPARABLE, starts=starts, seed=seed)
    print(f"A made-up rig with {' and '.join(INSEPARABLE)} wrong\n")
    print_audit(audit, wrong)

    def ratio(plant: CartPole) -> float:
        return value_of(plant, INSEPARABLE[0]) / value_of(plant, INSEPARABLE[1])

    pairs = [fit for fit in audit.fits if len(fit.parameters) == 2]
    found = [with_parameters(wrong, dict(zip(f.parameters, f.values, strict=True))) for f in audit.fits]
    row: dict[str, Any] = {
        "truth": {name: value_of(rig, name) for name in INSEPARABLE},
        "before": {name: value_of(wrong, name) for name in INSEPARABLE},
        "found": [dict(zip(fit.parameters, fit.values, strict=True)) for fit in (*pairs, *audit.simplest)],
        "ratio": {"truth": ratio(rig), "before": ratio(wrong), "found": [ratio(plant) for plant in found]},
        "sensitivities": [d.sensitivity for d in audit.directions],
        "closest": min(abs(value_of(plant, n) / value_of(rig, n) - 1.0) for plant in found for n in INSEPARABLE),
        "linear_model_error": max(linear_model_error(plant, rig) for plant in found),
    }
    print(
        f"\nratio {ratio(wrong):.4f} before, {', '.join(f'{r:.4f}' for r in row['ratio']['found'])} found, "
        f"{ratio(rig):.4f} in truth. Neither is found by itself: no fit has either nearer than "
        f"{100 * row['closest']:.1f} % to the truth. All have the linear model, to {row['linear_model_error']:.1e} of "
        "its largest entry."
    )
    return row


def random_rig(generator: np.random.Generator, names: Sequence[str]) -> tuple[CartPole, CartPole]:
    """A rig in which nothing vanishes, and the same with the named parameters wrong by a factor from 1.1 to 1.5."""

    def between(low: float, high: float) -> float:
        return float(math.exp(generator.uniform(math.log(low), math.log(high))))

    motor = Motor(
        torque_constant=between(0.5, 2.0),
        back_emf_constant=between(0.5, 2.0),
        resistance=between(0.6, 2.5),
        rotor_inertia=between(1e-3, 1e-1),
        viscous_friction=between(1e-2, 0.2),
        wheel_radius=between(0.7, 1.4),
        gear_ratio=between(0.7, 1.4),
    )
    rig = CartPole(
        cart_mass=between(0.5, 2.0),
        pole_mass=between(0.2, 0.8),
        pole_length=between(0.3, 1.0),
        pole_inertia=between(1e-3, 3e-2),
        cart_friction=between(0.1, 1.0),
        pivot_friction=between(1e-3, 2e-2),
        motor=motor,
    )
    wrong = {n: value_of(rig, n) * between(1.1, 1.5) ** generator.choice([-1, 1]) for n in names}
    return rig, with_parameters(rig, wrong)


def prints_of(rig: CartPole) -> list[PrintedGain]:
    """The rig's own gains, with two decimals each."""
    prints = PrintedGain.placement(["0"] * 4, POLES), PrintedGain.lqr(["0"] * 4, Q, R)
    return [dataclasses.replace(p, gain=rounded(p, rig), unit=(0.01,) * 4) for p in prints]


def rounded(design: PrintedGain, rig: CartPole) -> tuple[float, ...]:
    """What the design gives on the rig, with two decimals."""
    return tuple(round(float(k), 2) for k in np.asarray(design.computed(rig)))


def value_of(plant: CartPole, name: str) -> float:
    """A parameter of the plant or of its motor."""
    return float(getattr(plant if hasattr(plant, name) else plant.motor, name))


def linear_numbers(plant: CartPole) -> Mapping[str, float]:
    """The two numbers of the linear model that the motor's parameters enter through."""
    motor = plant.motor
    return {
        "force_per_voltage": float(motor.force_per_voltage),
        "damping": float(motor.damping + plant.cart_friction),
    }


def linear_model_error(plant: CartPole, rig: CartPole) -> float:
    """Largest difference of an entry of A or B, relative to the largest entry of the matrix."""
    pairs = zip(linearize(plant), linearize(rig), strict=True)
    return max(float(np.max(np.abs(found - true)) / np.max(np.abs(true))) for found, true in pairs)


def print_audit(audit: GainAudit, plant: CartPole) -> None:
    """Fits, combinations and sentences."""
    print_table(FIT_HEADER, [fit_cells(fit, plant) for fit in shown_fits(audit)])
    print()
    print_table(DIRECTION_HEADER, [direction_cells(d) for d in audit.directions])
    print("", *findings(audit), sep="\n")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Columns as wide as they must be."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    for row in (header, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip(), flush=True)


if __name__ == "__main__":
    run(main, __doc__ or "")
