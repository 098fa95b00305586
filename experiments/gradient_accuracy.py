"""Are gradients through the switch right? 200 random pairs of parameters and start, both designs, four kinds of gate.

    python experiments/gradient_accuracy.py

For each pair the objective's derivatives by automatic differentiation with located switching, with switching per step,
and of smooth surrogates, are held against Ridders' extrapolated differences of the rollout with located switching. The
objective is the smooth time outside a wide target (1.5 rad, 0.5 m) over 4 s, at steps of 0.5 ms.

Pairs whose run is stopped (it slides along the gate) are not drawn; their share is reported. Left out, by a rule that
was fixed before any comparison and knows nothing of it: runs that cross the gate slower than 0.1 / s, or in which a
change of the start grows more than ten thousand times. Counted apart: differences next to a kink that are too uncertain
to decide, by their own estimate. A relative error is relative to the difference, or to a thousandth of the largest
derivative of that run, if that is more.
"""

from pathlib import Path
from typing import Any

import numpy as np
from _common import run
from _random_loops import GROUPS, draw

import cpjax
from cpjax import files
from cpjax.cli.progress import Report, progress
from cpjax.show.figures import save_figure
from cpjax.show.gradients import methods, picture
from cpjax.study.gradient_audit import GradientAudit, audit_gradients

DURATION, DT = 4.0, 0.5e-3
OBJECTIVE = cpjax.TimeOutside(angle_width=1.5, position_width=0.5)


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints a table for each parameter and writes gradient_accuracy.json and gradient_accuracy.png."""
    count = 2 if quick else 50
    setting: dict[str, Any] = {"duration": 2.4, "dt": 2e-3} if quick else {"duration": DURATION, "dt": DT}
    audits: dict[str, GradientAudit] = {}
    stopped: dict[str, float] = {}
    with progress("gradient accuracy") as report:
        for k, group in enumerate(GROUPS[2:3] if quick else GROUPS):
            parameters, starts, stopped[group.name] = draw(group, count, seed=seed + k, **setting)
            audits[group.name] = audit_gradients(
                group.build,
                parameters,
                starts,
                objective=OBJECTIVE,
                each=True,
                temperatures=() if quick else (0.1, 0.03, 0.01),
                scales={"cart_friction": 0.1, "pivot_friction": 0.01},
                progress=_named(report, group.name),
                **setting,
            )
    results = {name: {"stopped_share_of_draws": stopped[name], **_summary(audit)} for name, audit in audits.items()}
    total = _total(audits)
    _print(results, total)
    files.write_json(
        out / "gradient_accuracy.json",
        {
            "versions": files.versions(),
            "seed": seed,
            "count": count,
            **setting,
            "total": total,
            "groups": results,
        },
    )
    save_figure(out / "gradient_accuracy.png", picture(list(audits.values())))
    return total


def _named(report: Report, name: str) -> Report:
    return lambda done, total, text: report(done, total, f"{name}: {text}")


def _summary(audit: GradientAudit) -> dict[str, Any]:
    compared = audit.compared[:, -1]
    parameters = {}
    for i, name in enumerate(audit.names):
        chosen = compared[:, i]
        row: dict[str, Any] = {"compared": int(chosen.sum())}
        for method, gradient in methods(audit):
            errors = audit.errors(gradient)[chosen, -1, i]
            row[method] = {
                "median": float(np.median(errors)) if errors.size else np.nan,
                "worst": float(np.max(errors, initial=0.0)),
                "wrong_signs": int(np.sum(audit.wrong_signs(gradient)[chosen, -1, i])),
            }
        parameters[name] = row
    verdicts = [kind for kind, _ in audit.verdicts]
    return {
        "runs": len(verdicts),
        "left_out": {kind: verdicts.count(kind) for kind in ("grazing", "chaotic")},
        "undecided": audit.undecided,
        "crossings": np.bincount(np.minimum(audit.crossings[audit.trusted, -1], 3), minlength=4),
        "slowest_crossing": audit.speed[:, -1],
        "growth": audit.growth[:, -1],
        "parameters": parameters,
    }


def _total(audits: dict[str, GradientAudit]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "runs": sum(len(a.flag) for a in audits.values()),
        "left_out": sum(int(np.sum(~a.trusted)) for a in audits.values()),
        "undecided": sum(a.undecided for a in audits.values()),
        "compared": sum(int(a.compared[:, -1].sum()) for a in audits.values()),
    }
    for m, (method, _) in enumerate(methods(next(iter(audits.values())))):
        errors, wrong = [], 0
        for audit in audits.values():
            gradient = methods(audit)[m][1]
            errors.append(audit.errors(gradient)[:, -1][audit.compared[:, -1]])
            wrong += int(np.sum(audit.wrong_signs(gradient)[:, -1][audit.compared[:, -1]]))
        every = np.concatenate(errors)
        found[method] = {
            "median": float(np.median(every)),
            "worst": float(np.max(every)),
            "beyond_1e-6": int(np.sum(every > 1e-6)),
            "wrong_signs": wrong,
        }
    return found


def _print(results: dict[str, Any], total: dict[str, Any]) -> None:
    for group, result in results.items():
        crossings = ", ".join(f"{n} with {c}" for c, n in zip(("0", "1", "2", "3+"), result["crossings"], strict=True))
        print(
            f"{group}: {result['runs']} runs, crossings of those kept: {crossings}; left out {result['left_out']}; ",
            end="",
        )
        print(f"of all draws {result['stopped_share_of_draws']:.1%} slide and are stopped")
        print(f"  {'relative error':16} compared   located: median  worst   plain: median  worst  wrong signs")
        for name, row in result["parameters"].items():
            located, plain = row["located"], row["plain"]
            print(
                f"  {name:16} {row['compared']:8}            {located['median']:.1e} {located['worst']:.1e}"
                f"         {plain['median']:.1e} {plain['worst']:.1e}  {plain['wrong_signs']:6}"
            )
    print(
        f"all groups: {total['compared']} derivatives of {total['runs']} runs, {total['left_out']} runs left out, ",
        end="",
    )
    print(f"{total['undecided']} differences next to a kink, too uncertain to decide")
    for method, row in total.items():
        if isinstance(row, dict):
            print(f"  {method:12} " + ", ".join(f"{key} {value:.3g}" for key, value in row.items()))


if __name__ == "__main__":
    run(main, __doc__ or "")
