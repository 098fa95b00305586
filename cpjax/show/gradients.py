"""An audit of gradients as a table, a figure and sentences."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from cpjax.study.gradient_audit import GradientAudit

Numbers: TypeAlias = np.ndarray[Any, Any]

_COLOURS: Mapping[str, str] = {"located": "#0072B2", "plain": "#D55E00"}
TITLE = "Median relative error of derivatives, against finite differences (and how many have the wrong sign)"
_LEAST = 1e-13  # smaller errors are drawn at this value


def methods(audit: GradientAudit) -> list[tuple[str, Numbers]]:
    """Returns each method of differentiation by name, with its derivatives (starts, horizons, parameters)."""
    smooth = [(f"smooth {t:g}", g) for t, g in zip(audit.temperatures, audit.smooth, strict=True)]
    return [("located", audit.located), ("plain", audit.plain), *smooth]


def header(audit: GradientAudit) -> list[str]:
    """Returns the column titles of `cells`."""
    return ["parameter", "compared", *(name for name, _ in methods(audit))]


def cells(audit: GradientAudit) -> list[list[str]]:
    """Returns for each parameter the median error of each method and, in brackets, the number of wrong signs.

    They are over the trustworthy initial states, at the last horizon. A zero in place of a derivative counts as wrong.
    """
    lines = []
    for i, name in enumerate(audit.names):
        chosen = audit.compared[:, -1, i]
        found = [(audit.errors(g)[chosen, -1, i], audit.wrong_signs(g)[chosen, -1, i]) for _, g in methods(audit)]
        texts = [f"{np.median(errors):.1e} ({int(wrong.sum())})" if chosen.any() else "-" for errors, wrong in found]
        lines.append([name, str(int(chosen.sum())), *texts])
    return lines


def findings(audit: GradientAudit) -> list[str]:
    """Returns the results of the audit as sentences with figures."""
    kinds = [kind for kind, _ in audit.verdicts]
    counts = ", ".join(f"{kinds.count(k)} {k}" for k in ("trustworthy", "grazing", "chaotic", "stopped"))
    sentences = [f"Of {len(kinds)} initial states: {counts}."]
    chosen = audit.compared[:, -1]
    if not chosen.any():
        return [*sentences, "No initial state is left for a comparison."]
    for name, gradient in methods(audit):
        errors, wrong = audit.errors(gradient)[:, -1][chosen], audit.wrong_signs(gradient)[:, -1][chosen]
        sentences.append(
            f"{name.capitalize()}: relative errors of {np.median(errors):.1e} in the median and {np.max(errors):.1e} "
            f"at worst, {int(wrong.sum())} of {errors.size} derivatives with the wrong sign."
        )
    if audit.undecided:
        sentences.append(
            f"{audit.undecided} derivatives were not compared: next to a kink no difference is certain enough."
        )
    return sentences


def picture(audits: Sequence[GradientAudit]) -> Figure:
    """Draws errors over the horizon and over the slowest crossing, and the growth of sensitivity with time.

    Args:
      audits: all with the same horizons.
    """
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    by_horizon, by_speed, growth = figure.subplots(1, 3)
    for method, colour in _COLOURS.items():
        errors = [np.where(a.resolved, a.errors(getattr(a, method)), np.nan) for a in audits]
        _by_horizon(by_horizon, audits, errors, method, colour)
        speeds, worst = [], []
        for audit, error in zip(audits, errors, strict=True):
            crossed = audit.trusted & (audit.crossings[:, -1] > 0) & audit.resolved[:, -1].any(axis=-1)
            speeds.append(audit.speed[crossed, -1])
            worst.append(np.nanmax(error[crossed, -1], axis=-1, initial=0.0))
        by_speed.loglog(
            np.concatenate(speeds),
            np.maximum(np.concatenate(worst), _LEAST),
            "o",
            color=colour,
            markersize=4,
            alpha=0.6,
        )
    by_horizon.set_xlabel("horizon of the objective [s]")
    by_horizon.set_ylabel("relative error of a derivative")
    by_horizon.set_title("median, and 95th percentile (dashed)", loc="left")
    by_horizon.legend()
    by_speed.set_xlabel("slowest crossing of the gate [1/s]")
    by_speed.set_title("worst derivative of each run", loc="left")
    by_speed.sharey(by_horizon)
    by_speed.xaxis.set_minor_formatter(NullFormatter())
    growths = np.concatenate([a.growth for a in audits])
    growth.semilogy(audits[0].horizons, growths.T, color="#009E73", alpha=min(1.0, 8.0 / len(growths)))
    growth.semilogy(audits[0].horizons, np.nanmedian(growths, axis=0), "o-", color="#000000", label="median")
    growth.set_xlabel("time [s]")
    growth.set_ylabel("norm of d state / d initial state")
    growth.set_title("growth of a change of the initial state", loc="left")
    growth.legend()
    for axes in (by_horizon, by_speed, growth):
        axes.grid(alpha=0.3)
    return figure


def _by_horizon(
    axes: Axes, audits: Sequence[GradientAudit], errors: Sequence[Numbers], method: str, colour: str
) -> None:
    horizons = audits[0].horizons
    middle, high = [], []
    for k in range(len(horizons)):
        every = np.concatenate([e[a.trusted, k].ravel() for a, e in zip(audits, errors, strict=True)])
        every = every[np.isfinite(every)]
        middle.append(max(float(np.median(every)), _LEAST) if every.size else np.nan)
        high.append(max(float(np.quantile(every, 0.95)), _LEAST) if every.size else np.nan)
    axes.semilogy(horizons, middle, "o-", color=colour, label=method)
    axes.semilogy(horizons, high, "^--", color=colour)
