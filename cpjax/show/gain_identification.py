"""An audit of printed gains as tables, a figure and sentences."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from cpjax.paper.gain_identification import Direction, GainAudit
from cpjax.paper.plant_fit import EXPLAINED, Fit
from cpjax.plant import CartPole, parameters_of, with_parameters

FIT_HEADER = (
    "changed",
    "to",
    "worst residual",
    "force per volt [N/V]",
    "total damping [N s/m]",
    "initial states that agree",
)
DIRECTION_HEADER = ("combination of relative changes", "sensitivity", "known to")

_ROUGHLY = 5.0  # sensitivity at which a change of 10 % moves the gains by half a last digit


def fit_cells(fit: Fit, plant: CartPole) -> list[str]:
    """Returns one fit as a row of `FIT_HEADER`, with force per volt and total damping of the fitted plant.

    The motor enters the linear model only through these two and the reflected mass of its rotor.
    """
    units = {name: rule.unit for name, rule in parameters_of(plant).items()}
    with_it = with_parameters(plant, dict(zip(fit.parameters, fit.values, strict=True)))
    return [
        ", ".join(fit.parameters),
        ", ".join(f"{v:.5g} {units[n]}".removesuffix(" 1") for n, v in zip(fit.parameters, fit.values, strict=True)),
        f"{fit.worst:.3g}",
        f"{float(with_it.motor.force_per_voltage):.5f}",
        f"{float(with_it.motor.damping + with_it.cart_friction):.5f}",
        f"{100 * fit.reached:.0f} %",
    ]


def direction_cells(direction: Direction) -> list[str]:
    """Returns one combination as a row of `DIRECTION_HEADER`, with weights of at least 0.1 only."""
    strong = sorted(direction.weights.items(), key=lambda item: -abs(item[1]))
    words = " ".join(f"{w:+.2f} {name}" for name, w in strong if abs(w) >= 0.1)
    known = "not at all" if math.isinf(direction.known_to) else f"{100 * direction.known_to:.2g} %"
    return [words, f"{direction.sensitivity:.3g}", known]


def shown_fits(audit: GainAudit) -> list[Fit]:
    """Returns the fits for the table: all that explain the gains with the fewest changes, after the best of each size
    below; the best of each size if none explains them.
    """
    sizes = sorted({len(fit.parameters) for fit in audit.fits})
    best = [audit.best(size) for size in sizes if not audit.simplest or size < len(audit.simplest[0].parameters)]
    return [*best, *audit.simplest] if audit.simplest else best


def findings(audit: GainAudit) -> list[str]:
    """Returns the results of the audit as sentences with figures."""
    worst = max(abs(r) for r in audit.unchanged)
    within = sum(abs(r) <= EXPLAINED for r in audit.unchanged)
    sentences = [
        f"On the plant as given, {within} of {len(audit.unchanged)} printed gains come out to within one unit of their "
        f"last digit; the worst is {worst:.3g} units off."
    ]
    for size in sorted({len(fit.parameters) for fit in audit.fits}):
        fits = [fit for fit in audit.fits if len(fit.parameters) == size]
        best, good = audit.best(size), sum(fit.explains for fit in fits)
        kind = "Single parameters" if size == 1 else f"Sets of {size} parameters"
        sentences.append(
            f"{kind} that may change: {good or 'none'} of {len(fits)} explain every gain. The best, "
            f"{' and '.join(best.parameters)}, leaves {best.worst:.3g} units"
            + (" (rounding alone leaves up to 0.5)." if good else ".")
        )
    known = [d for d in audit.directions if d.identified]
    unknown = sum(d.sensitivity == 0.0 for d in audit.directions)
    sentences.append(
        f"About the plant found: of {len(audit.directions)} independent combinations of parameters, the gains fix "
        f"{len(known)} to better than 10 %"
        + (f" (the least known of them to {100 * known[-1].known_to:.2g} %)" if known else "")
        + f", {len(audit.directions) - len(known) - unknown} less well and {unknown} not at all."
    )
    return sentences


def picture(audit: GainAudit) -> Figure:
    """Draws the worst residual for each parameter and pair that may change, and the singular values."""
    names = [fit.parameters[0] for fit in audit.fits if len(fit.parameters) == 1]
    pairs = any(len(fit.parameters) == 2 for fit in audit.fits)
    figure = Figure(figsize=(12.5, 7.2) if pairs else (12.5, 5), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1) if pairs else (1, 1))
    _residual_map(figure, left, audit, names) if pairs else _residual_bars(left, audit, names)
    values = [d.sensitivity for d in audit.directions]
    shown = [v if v > 0 else math.nan for v in values]
    right.semilogy(range(1, len(values) + 1), shown, "o", color="#0072B2", label="known by the gains")
    zeros = [i + 1 for i, v in enumerate(values) if v == 0]
    if zeros:  # at the bottom, below all other points: a logarithmic axis cannot show zero
        foot = right.get_xaxis_transform()
        right.plot(zeros, [0.04] * len(zeros), "v", color="#D55E00", transform=foot, label="0: not known at all")
        right.set_ylim(bottom=min([_ROUGHLY, *(v for v in values if v > 0)]) / 20)
    right.axhline(_ROUGHLY, color="#999999", linestyle="--", label="a change of 10 % is half a last digit")
    right.set_xlabel("combination of parameters, best known first")
    right.set_ylabel("units of the last digit per relative change by 1")
    right.set_title("Sensitivity of the gains to the plant", loc="left")
    right.set_xlim(0.5, len(values) + 0.5)
    right.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    right.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.1))  # the points may be anywhere inside
    right.grid(alpha=0.3)
    return figure


def _residual_map(figure: Figure, axes: Axes, audit: GainAudit, names: Sequence[str]) -> None:
    worst = np.full((len(names), len(names)), np.nan)
    for fit in audit.fits:
        if len(fit.parameters) <= 2:
            i, j = (names.index(n) for n in (fit.parameters * 2)[:2])
            worst[i, j] = worst[j, i] = fit.worst
    top = np.max(worst, where=np.isfinite(worst), initial=EXPLAINED)
    # Cells need not be square: with a fixed aspect, the layout ignores the space that the labels need.
    image = axes.imshow(np.maximum(worst, 1e-3), norm=LogNorm(0.1, top), cmap="cividis_r", aspect="auto")
    for (i, j), value in np.ndenumerate(worst):
        if value <= EXPLAINED:
            axes.plot(j, i, "o", color="white", markersize=7, markeredgecolor="black")
    axes.set_xticks(range(len(names)), names, rotation=60, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(names)), names)
    axes.set_title(
        "Worst residual when two parameters (diagonal: one) may change;\ncircles: every gain is explained", loc="left"
    )
    figure.colorbar(image, ax=axes, label="units of the last printed digit")


def _residual_bars(axes: Axes, audit: GainAudit, names: Sequence[str]) -> None:
    worst = [fit.worst for fit in audit.fits if len(fit.parameters) == 1]
    axes.barh(names, worst, color="#0072B2")
    axes.axvline(EXPLAINED, color="#D55E00", label="explained")
    axes.set_xscale("log")
    axes.invert_yaxis()
    axes.set_xlabel("worst residual [units of the last printed digit]")
    axes.set_title("When one parameter may change", loc="left")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(0.0, -0.1))
