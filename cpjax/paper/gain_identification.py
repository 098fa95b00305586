"""Identification of plant parameters from printed gains, and of the combinations that the gains determine.

For gains with the digits they were printed with, and the weights or poles they were designed for, the audit changes one
parameter of a plant, then each pair of parameters, and so on, and checks whether the computed gains match (see
`plant_fit`). Residuals are in units of the last printed digit: rounding alone leaves at most 0.5.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cpjax import files, io
from cpjax.errors import InputError
from cpjax.paper.plant_fit import PARAMETERS, Fit, Progress, fit_all, linearised, random_starts, scale_of
from cpjax.paper.printed_gains import PrintedGain
from cpjax.plant import CartPole, with_parameters
from cpjax.pytree import check


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of parameters, and how well the gains determine it.

    Attributes:
      sensitivity: singular value: units of the last digit by which the gains move, for a relative change by 1.
      weights: the relative change of each parameter, by name; their squares sum to 1. For one that is zero in the
        plant, the change relative to a size typical of the plant.
    """

    sensitivity: float
    weights: Mapping[str, float]

    @property
    def known_to(self) -> float:
        """Relative change that moves the gains by half a unit of the last digit, the least that is detectable [1]."""
        return 0.5 / self.sensitivity if self.sensitivity > 0.0 else math.inf

    @property
    def identified(self) -> bool:
        """Whether the gains determine the combination to better than 10 %."""
        return self.known_to < 0.1


@dataclasses.dataclass(frozen=True)
class GainAudit:
    """Result of `audit_gains`.

    Attributes:
      unchanged: residuals with the unchanged plant, in units of the last digit, all gains in a row.
      fits: best fit for each set of parameters that may change, smallest sets first.
      directions: combinations of all parameters, best determined first, at the best fit of the smallest sets that
        explain the gains (or at the best fit, if none does).
      plant: the plant of that fit.
    """

    unchanged: tuple[float, ...]
    fits: tuple[Fit, ...]
    directions: tuple[Direction, ...]
    plant: CartPole

    def best(self, size: int) -> Fit:
        """Returns the best fit among the sets of `size` parameters."""
        return min((fit for fit in self.fits if len(fit.parameters) == size), key=lambda fit: fit.worst)

    @property
    def simplest(self) -> tuple[Fit, ...]:
        """Fits that explain the gains with the fewest parameters changed, best first; empty if none does."""
        explaining = [fit for fit in self.fits if fit.explains]
        fewest = min((len(fit.parameters) for fit in explaining), default=0)
        return tuple(sorted((f for f in explaining if len(f.parameters) == fewest), key=lambda fit: fit.worst))


def audit_gains(
    prints: Sequence[PrintedGain],
    plant: CartPole,
    *,
    parameters: Sequence[str] = PARAMETERS,
    most: int = 2,
    starts: int = 32,
    seed: int = 1,
    progress: Progress | None = None,
) -> GainAudit:
    """Finds changes of `plant` that explain the gains, and the combinations of parameters that the gains determine.

    Args:
      prints: the gains.
      plant: the plant to change.
      parameters: those that may change, by name (of `PARAMETERS`).
      most: number of parameters that may change at once; every set of up to so many is tried.
      starts: random initial points of the fit of each set, each parameter within a factor of 3 of the plant's value, or
        of a size typical of the plant if that is zero.
      seed: of the initial points.
      progress: called with the sets done, their number, and the current work in words.

    Raises:
      InputError: no gain, a gain of a design that cannot be computed for `plant`, an unknown or repeated parameter, a
        count out of range or a negative seed.
    """
    if not isinstance(plant, CartPole):
        raise InputError("plant", plant, "a cpjax.CartPole")
    check("plant", plant)
    if not isinstance(prints, Sequence) or not prints or not all(isinstance(p, PrintedGain) for p in prints):
        raise InputError("prints", prints, "a list of one PrintedGain or more")
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown or len(set(parameters)) < len(parameters) or not parameters:
        raise InputError("parameters", unknown or parameters, "different ones of " + ", ".join(PARAMETERS))
    for field, value, top in (("most", most, len(parameters)), ("starts", starts, 100_000)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= top:
            raise InputError(field, value, f"a whole number from 1 to {top}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError("seed", seed, "a whole number, at least 0")
    names, given = tuple(parameters), tuple(prints)
    unchanged, _ = linearised(given, plant)
    for printed, rest in zip(given, unchanged.reshape(-1, 4), strict=True):
        if not np.all(np.isfinite(rest)):
            allowed = "of a design for which the plant, before any change, has a gain"
            raise InputError(f"{printed.design} gain", printed.gain, allowed)
    sets = [chosen for size in range(1, most + 1) for chosen in itertools.combinations(names, size)]
    fits = fit_all(given, plant, sets, random_starts(sets, most, starts, seed), progress)
    if progress is not None:
        progress(len(sets), len(sets), "singular values")
    audit = GainAudit(tuple(unchanged.tolist()), tuple(fits), (), plant)
    chosen = audit.simplest[0] if audit.simplest else min(fits, key=lambda fit: fit.worst)
    found = with_parameters(plant, dict(zip(chosen.parameters, chosen.values, strict=True)))
    return dataclasses.replace(audit, directions=_directions(given, found, names), plant=found)


def document(audit: GainAudit, prints: Sequence[PrintedGain], plant: CartPole, **setting: Any) -> dict[str, Any]:
    """Returns the audit as plain values, for JSON, beside the entries of `setting`."""

    def row(fit: Fit) -> dict[str, Any]:
        return {**dataclasses.asdict(fit), "worst": fit.worst, "explains": fit.explains}

    return {
        "what": "which changes of a plant explain printed gains; residuals in units of the last printed digit",
        "versions": files.versions(),
        "setting": setting,
        "printed": [{key: _plain(value) for key, value in dataclasses.asdict(p).items()} for p in prints],
        "plant": io.encode(plant),
        "unchanged": audit.unchanged,
        "fits": [row(fit) for fit in audit.fits],
        "simplest": [row(fit) for fit in audit.simplest],
        "found": io.encode(audit.plant),
        "directions": [
            {**dataclasses.asdict(d), "known_to": d.known_to, "identified": d.identified} for d in audit.directions
        ],
    }


def write(path: Path, audit: GainAudit, prints: Sequence[PrintedGain], plant: CartPole, **setting: Any) -> None:
    """Writes `document` as JSON, atomically."""
    files.write_json(path, document(audit, prints, plant, **setting))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, complex) else value


def _directions(prints: tuple[PrintedGain, ...], plant: CartPole, names: tuple[str, ...]) -> tuple[Direction, ...]:
    """Returns singular values and vectors of the gains' derivative by relative changes of parameters, at `plant`."""
    _, J = linearised(prints, plant)
    relative = J[:, [PARAMETERS.index(name) for name in names]] * [scale_of(plant, name) for name in names]
    _, values, vectors = np.linalg.svd(relative, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(names))])[: len(names)]
    values = np.where(values < 1e-9 * values[0], 0.0, values)  # rounding
    return tuple(
        Direction(float(s), {name: float(w) for name, w in zip(names, v, strict=True)})
        for s, v in zip(values, vectors, strict=True)
    )
