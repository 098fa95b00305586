"""The reproduction of the paper as a table, figures and sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from cpjax import paper
from cpjax.numeric.statistics import two_proportion_p_value
from cpjax.paper.reproduction import EvaluationConfig, representative, trajectory
from cpjax.show.figures import DESIGN_NAMES, SIDE_BY_SIDE, paper_figures

SHOWN = (("as-printed", "appendix", 10.0), ("corrected-centred", "appendix", 10.0))
"""Law, plant and longest time shown [s] of the figures in the places of the paper's Figures 3 to 6."""

HEADER = (
    "law",
    "plant",
    "regulator",
    "gains",
    "success [%]",
    "95 % interval",
    "settling mean [s]",
    "median [s]",
    "travel mean [m]",
    "effort mean [V^2 s]",
    "variation mean [V]",
    "peak [V]",
)
"""Columns of `cells`; settling, travel, effort and variation are over the successful runs, the peak over all."""


def cells(row: Mapping[str, Any]) -> list[str]:
    """Returns one row of the reproduction as text, in the columns of `HEADER`."""
    good = row["over_successes"]
    low, high = row["success_interval"]

    def number(value: float, digits: int) -> str:
        return f"{value:.{digits}f}" if value == value else "-"  # NaN: there was no success

    return [
        row["law"],
        row["plant"],
        DESIGN_NAMES[row["design"]],
        row["gains"],
        f"{100 * row['success_rate']:.2f}",
        f"{100 * low:.2f}-{100 * high:.2f}",
        number(good["settling_time"]["mean"], 2),
        number(good["settling_time"]["median"], 2),
        number(good["cart_travel"]["mean"], 2),
        number(good["effort"]["mean"], 0),
        number(good["voltage_variation"]["mean"], 0),
        number(row["over_all"]["peak_voltage"]["max"], 1),
    ]


def pictures(setting: EvaluationConfig) -> list[tuple[str, Figure, str]]:
    """Returns our Figures 3 to 6: for each law of `SHOWN` a file name, the figure and its caption."""
    results = []
    for law, plant, until in SHOWN:
        words, start = representative(law, plant, setting)
        runs = {design: trajectory(law, design, plant, start, setting) for design in SIDE_BY_SIDE}
        limit = float(paper.PLANTS[plant]().motor.voltage_limit)
        title = f"law {law}, printed gains, {plant} plant"
        outcome = "; ".join(f"{DESIGN_NAMES[d]} {_outcome(run.metrics)}" for d, run in runs.items())
        caption = f"Our runs in the places of the paper's Figures 3 to 6 ({title}), from {words}. Result: {outcome}."
        results.append(
            (f"figures-3-6-{law}-{plant}", paper_figures(runs, title, min(until, setting.duration), limit), caption)
        )
    return results


def findings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns what the rows say about the paper's claims, as sentences with figures."""

    def rate(law: str, design: str) -> str:
        keys = {"law": law, "plant": "appendix", "design": design, "gains": "printed"}
        row = next(r for r in rows if all(r[k] == v for k, v in keys.items()))
        return f"{100 * row['success_rate']:.2f} %"

    pairs = {(r["law"], r["plant"]) for r in rows}
    ahead = {"placement": 0, "lqr": 0}
    for law, plant in pairs:
        ours = {r["design"]: r for r in rows if (r["law"], r["plant"], r["gains"]) == (law, plant, "printed")}
        a, b = ours["placement"], ours["lqr"]
        if two_proportion_p_value(a["successes"], a["count"], b["successes"], b["count"]) < 1e-3:
            ahead["placement" if a["successes"] > b["successes"] else "lqr"] += 1
    as_voltage = max(r["success_rate"] for r in rows if r["law"] == "corrected-as-voltage")

    def caught(law: str) -> str:
        return f"{rate(law, 'placement')} of the starts with pole placement and {rate(law, 'lqr')} with LQR"

    return [
        f"On the appendix's plant, the law and the gains as printed catch {caught('as-printed')}.",
        f"The energy law corrected, with the paper's k = 0.2, catches {caught('corrected')}; the same law read "
        f"as a voltage, {100 * as_voltage:.2f} % at most.",
        f"With a larger energy gain and the cart held near the middle (no longer the paper's law), the printed gains "
        f"catch {caught('corrected-centred')}.",
        f"The paper sees slightly better performance with LQR. In these {len(pairs)} comparisons on both plants, with "
        "the gains as printed and the clip at 12 V, pole placement catches more initial states in "
        f"{ahead['placement']}, LQR in {ahead['lqr']} (differences beyond a two-proportion test at 99.9 %).",
    ]


def _outcome(metrics: Any) -> str:
    if bool(metrics.success):
        return f"settles after {float(metrics.settling_time):.2f} s, at most {float(metrics.cart_travel):.2f} m away"
    return f"does not settle; the cart goes {float(metrics.cart_travel):.1f} m away"
