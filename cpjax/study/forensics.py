"""Where printed gains come from: the plant parameters that explain them, and what the gains say about a plant at all.

Given gains with the digits they were printed with, and the weights or poles they were designed for, the audit takes a
plant, lets one parameter change, then each pair of parameters, and so on, and asks whether the gains follow. The fits
are Gauss and Newton's, damped by Levenberg and Marquardt, on derivatives through `linearize`, `lqr` and
`place_polynomial`, from many random starts at once. Residuals are in units of the last printed digit: rounding alone
leaves at most 0.5.
"""

import dataclasses
import itertools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from cpjax import io, paper
from cpjax.design.lqr import lqr
from cpjax.design.placement import place_polynomial, polynomial_from_poles
from cpjax.errors import InputError
from cpjax.numeric.small_matrices import linear_solve
from cpjax.plant import CartPole, Motor, linearize
from cpjax.pytree import Number, cast, check, rules

PARAMETERS = tuple(
    name
    for cls in (CartPole, Motor)
    for name, rule in rules(cls).items()
    if isinstance(rule, Number) and name != "voltage_limit"
)
"""Every number of a plant that its linear model may depend on."""

EXPLAINED = 1.0
"""Worst residual, in units of the last digit, up to which gains count as explained: rounding twice is 1.0."""

_STEPS = 40
_LANES = 512  # fits that run side by side
_START_FACTOR = 3.0
_NUMBER = re.compile(r"[-+]?(?=\.?\d)\d*(\.(?P<decimals>\d*))?([eE](?P<exponent>[-+]?\d{1,9}))?", re.ASCII)
Progress: TypeAlias = Callable[[int, int, str], None]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PrintedGain:
    """A gain as printed, and what it was designed for: weights or poles.

    Attributes:
      gain: four numbers, K of u = -K s.
      unit: the size of the last printed digit of each.
      poles: what it places, or None.
      Q: diagonal of the state weight, or None.
      R: weight of the voltage, or None.
    """

    gain: tuple[float, ...]
    unit: tuple[float, ...]
    poles: tuple[complex, ...] | None = None
    Q: tuple[float, ...] | None = None
    R: float | None = None

    @classmethod
    def placement(cls, texts: Sequence[str], poles: Sequence[complex]) -> "PrintedGain":
        """A gain of pole placement, from its numbers as printed: the digits say how precise they are."""
        gain, unit = _parsed("placement gain", texts)
        if polynomial_from_poles(poles).shape != (4,):
            raise InputError("poles", poles, "four of them")
        return cls(gain, unit, poles=tuple(complex(p) for p in poles))

    @classmethod
    def lqr(cls, texts: Sequence[str], Q: Sequence[float], R: float) -> "PrintedGain":
        """A gain of a linear quadratic regulator with Q = diag(...), from its numbers as printed."""
        gain, unit = _parsed("lqr gain", texts)
        try:
            diagonal, weight = tuple(float(q) for q in Q), float(R)
        except (TypeError, ValueError) as problem:
            raise InputError("Q, R", (Q, R), "numbers: the diagonal of Q, and R") from problem
        if len(diagonal) != 4 or not all(math.isfinite(q) and q >= 0.0 for q in diagonal):
            raise InputError("Q", Q, "four finite numbers, at least 0: the diagonal")
        if not (math.isfinite(weight) and weight > 0.0):
            raise InputError("R", R, "a finite number above 0")
        return cls(gain, unit, Q=diagonal, R=weight)

    @property
    def design(self) -> str:
        """Which of the two."""
        return "placement" if self.poles is not None else "lqr"

    def computed(self, plant: CartPole) -> jax.Array:
        """The gain (4,) that the poles or weights give on `plant`."""
        A, B = linearize(plant)
        if self.poles is not None:
            return place_polynomial(A, B, polynomial_from_poles(self.poles).astype(A.dtype))[0]
        assert self.Q is not None
        return lqr(A, B, jnp.diag(jnp.asarray(self.Q, dtype=A.dtype)), jnp.asarray([[self.R]], dtype=A.dtype)).K[0]


def printed_in_the_paper() -> list[PrintedGain]:
    """The paper's two gains, with two decimals each (sections IV-A and IV-B)."""

    def texts(design: paper.Design) -> list[str]:
        return [f"{k:.2f}" for k in paper.PRINTED_GAINS[design]]

    return [PrintedGain.placement(texts("placement"), paper.POLES), PrintedGain.lqr(texts("lqr"), paper.Q, paper.R)]


@dataclasses.dataclass(frozen=True)
class Fit:
    """The best that changing some of a plant's parameters does for the gains.

    Attributes:
      parameters: which may change.
      values: what they become.
      residuals: computed less printed gain, in units of the last digit, all gains in a row.
      reached: share of the random starts that end there (in cost, within 1 % or 0.01 of the best).
    """

    parameters: tuple[str, ...]
    values: tuple[float, ...]
    residuals: tuple[float, ...]
    reached: float

    @property
    def worst(self) -> float:
        """The largest residual, in units of the last digit."""
        return max(abs(r) for r in self.residuals)

    @property
    def explains(self) -> bool:
        """Whether every gain follows."""
        return self.worst <= EXPLAINED


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of parameters, and how well the gains know it.

    Attributes:
      sensitivity: singular value: units of the last digit by which the gains move, for a relative change by 1.
      weights: the relative change of each parameter, by name; their squares sum to 1. Of one that is zero in the
        plant, the change relative to a size typical of the plant.
    """

    sensitivity: float
    weights: Mapping[str, float]

    @property
    def known_to(self) -> float:
        """The relative change that moves the gains by half a unit: less than that, nobody can tell."""
        return 0.5 / self.sensitivity if self.sensitivity > 0.0 else math.inf

    @property
    def identified(self) -> bool:
        """Whether the gains fix the combination at all, to better than 10 %."""
        return self.known_to < 0.1


@dataclasses.dataclass(frozen=True)
class GainAudit:
    """What `audit_gains` found.

    Attributes:
      unchanged: residuals with the plant as it is, in units of the last digit.
      fits: for each set of parameters that may change, smallest sets first.
      directions: combinations of all parameters at the best fit of the smallest sets that explain the gains (or of the
        best fit, if none does), best known first.
      plant: the plant of that fit.
    """

    unchanged: tuple[float, ...]
    fits: tuple[Fit, ...]
    directions: tuple[Direction, ...]
    plant: CartPole

    def best(self, size: int) -> Fit:
        """The best fit among the sets of `size` parameters."""
        return min((fit for fit in self.fits if len(fit.parameters) == size), key=lambda fit: fit.worst)

    @property
    def simplest(self) -> tuple[Fit, ...]:
        """The fits that explain the gains with the fewest changes, best first; empty if none does."""
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
    """Which changes of `plant` explain the gains, and which combinations of parameters the gains know.

    Args:
      parameters: those that may change, by name (of `PARAMETERS`).
      most: how many may change at once; every set of up to so many is tried.
      starts: random starts for each set, each parameter within a factor of 3 of the plant's value. A parameter that is
        zero in the plant starts within that factor of a size typical of the plant.
      seed: of the starts.
      progress: called with how much is done, of how much, and what comes next.

    Raises:
      InputError: no gain, one of a design that `plant` has no gain for, an unknown parameter, a count below 1 or a
        negative seed.
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
    unchanged, _ = _linearised(given, plant)
    for printed, rest in zip(given, unchanged.reshape(-1, 4), strict=True):
        if not np.all(np.isfinite(rest)):
            allowed = "of a design for which the plant, before any change, has a gain"
            raise InputError(f"{printed.design} gain", printed.gain, allowed)
    sets = [chosen for size in range(1, most + 1) for chosen in itertools.combinations(names, size)]
    fits = _fit_all(given, plant, sets, _random_starts(sets, most, starts, seed), progress)
    if progress is not None:
        progress(len(sets), len(sets), "singular values")
    audit = GainAudit(tuple(unchanged.tolist()), tuple(fits), (), plant)
    chosen = audit.simplest[0] if audit.simplest else min(fits, key=lambda fit: fit.worst)
    found = changed(plant, dict(zip(chosen.parameters, chosen.values, strict=True)))
    return dataclasses.replace(audit, directions=_directions(given, found, names), plant=found)


def changed(plant: CartPole, changes: Mapping[str, Any]) -> CartPole:
    """The plant with some of its or its motor's parameters changed."""
    motor = {key: value for key, value in changes.items() if key in rules(Motor)}
    own = {key: value for key, value in changes.items() if key not in motor}
    return dataclasses.replace(plant, **own, motor=dataclasses.replace(plant.motor, **motor))


def document(audit: GainAudit, prints: Sequence[PrintedGain], plant: CartPole, **setting: Any) -> dict[str, Any]:
    """The audit as plain values, for JSON."""

    def row(fit: Fit) -> dict[str, Any]:
        return {**dataclasses.asdict(fit), "worst": fit.worst, "explains": fit.explains}

    return {
        "what": "which changes of a plant explain printed gains; residuals in units of the last printed digit",
        "versions": io.versions(),
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
    io.write_json(path, document(audit, prints, plant, **setting))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, complex) else value


def _parsed(field: str, texts: Sequence[str]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Numbers as printed, and the sizes of their last digits."""
    if isinstance(texts, str) or len(texts) != 4:
        raise InputError(field, texts, "four numbers as printed")
    values, units = [], []
    for text in texts:
        match = _NUMBER.fullmatch(text.strip().replace("\u2212", "-")) if isinstance(text, str) else None
        if match is None:
            raise InputError(field, text, "a number as printed, such as '-24.70'")
        value = float(match[0])
        unit = float(f"1e{int(match['exponent'] or 0) - len(match['decimals'] or '')}")
        if not (math.isfinite(value) and 0.0 < unit < math.inf):
            raise InputError(field, text, "a number that fits a float, and its last digit too")
        values.append(value)
        units.append(unit)
    return tuple(values), tuple(units)


def _value(plant: CartPole, name: str) -> float:
    return float(getattr(plant.motor if name in rules(Motor) else plant, name))


def _scale(plant: CartPole, name: str) -> float:
    """The parameter's value; where it is zero, one at which it would matter on this plant."""
    swing = float(plant.pole_mass) * float(plant.pole_length) ** 2
    typical = {
        "pole_inertia": swing,
        "cart_friction": float(plant.motor.damping),
        "viscous_friction": float(plant.motor.damping) * (plant.motor.wheel_radius / plant.motor.gear_ratio) ** 2,
        "pivot_friction": swing * math.sqrt(float(plant.gravity) / float(plant.pole_length)),
        "rotor_inertia": float(plant.cart_mass) * (plant.motor.wheel_radius / plant.motor.gear_ratio) ** 2,
        "back_emf_constant": float(plant.motor.torque_constant),
    }
    return _value(plant, name) or float(typical[name]) or 1.0


def _residuals(prints: Sequence[PrintedGain], plant: CartPole) -> jax.Array:
    gains = jnp.concatenate([p.computed(plant) for p in prints])
    printed = jnp.asarray([k for p in prints for k in p.gain], dtype=gains.dtype)
    return (gains - printed) / jnp.asarray([u for p in prints for u in p.unit], dtype=gains.dtype)


def _with_derivatives(
    prints: tuple[PrintedGain, ...], plant: CartPole, values: Callable[[jax.Array], Mapping[str, Any]], x: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Residuals (4 gains), and their derivatives (4 gains, n) by x (n,), on the plant changed to `values(x)`."""

    def twice(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        r = _residuals(prints, changed(plant, values(x)))
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


# Compiled for all parameters, whichever are asked for: one program serves every audit of as many gains.


def _linearised(prints: tuple[PrintedGain, ...], plant: CartPole) -> tuple[Any, Any]:
    """Residuals on `plant`, and their derivatives by all `PARAMETERS`, as NumPy arrays."""
    r, J = _compiled_linearisation(prints, *_numbers(plant))
    return np.asarray(r), np.asarray(J)


@jax.jit
def _compiled_linearisation(
    prints: tuple[PrintedGain, ...], plant: CartPole, numbers: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return _with_derivatives(prints, plant, lambda x: dict(zip(PARAMETERS, x, strict=True)), numbers)


def _numbers(plant: CartPole) -> tuple[CartPole, jax.Array]:
    """The plant with arrays for numbers, and the values of all `PARAMETERS`, of one dtype."""
    numbers = jnp.asarray([_value(plant, name) for name in PARAMETERS])
    return cast(plant, numbers.dtype), numbers


def _random_starts(sets: Sequence[tuple[str, ...]], most: int, count: int, seed: int) -> np.ndarray[Any, Any]:
    """Logarithms of factors (sets, count, most); those beyond a set's size are not used."""
    generator, spread = np.random.default_rng(seed), math.log(_START_FACTOR)
    return generator.uniform(-spread, spread, (len(sets), count, most))


def _fit_all(
    prints: tuple[PrintedGain, ...],
    plant: CartPole,
    sets: Sequence[tuple[str, ...]],
    starts: np.ndarray[Any, Any],
    progress: Progress | None,
) -> list[Fit]:
    """The best of all starts (sets, count, most) for each set of parameters."""
    count, most = starts.shape[1:]
    # Sets of any size in one program: an index beyond the last parameter stands for one less.
    padded = [[*map(PARAMETERS.index, names), *[len(PARAMETERS)] * (most - len(names))] for names in sets]
    chosen, x = np.repeat(padded, count, axis=0), starts.reshape(-1, most)
    base = jnp.asarray([_scale(plant, name) for name in PARAMETERS])
    lanes = min(_LANES, len(x))
    ends = []
    for first in range(0, len(x), lanes):
        if progress is not None:
            text = f"sets of up to {most} parameters, {count} starts each"
            progress(first // count, len(sets), text)
        now = np.arange(first, first + lanes) % len(x)  # what the last round has too much is dropped below
        ends.append(_fitted(prints, *_numbers(plant), base, chosen[now], jnp.asarray(x[now])))
    found, rest = (np.concatenate(a)[: len(x)].reshape(len(sets), count, -1) for a in zip(*ends, strict=True))
    cost = np.sum(rest**2, axis=-1)
    fits = []
    for row, names in enumerate(sets):
        best = int(np.argmin(cost[row]))
        lowest = cost[row, best]
        agree = cost[row] <= lowest + max(0.01 * lowest, 0.01)
        fits.append(
            Fit(
                names,
                tuple(found[row, best, : len(names)].tolist()),
                tuple(rest[row, best].tolist()),
                float(np.mean(agree & np.isfinite(cost[row]))),
            )
        )
    return fits


@jax.jit
def _fitted(
    prints: tuple[PrintedGain, ...],
    plant: CartPole,
    own: jax.Array,
    base: jax.Array,
    chosen: jax.Array,
    starts: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The chosen parameters (lanes, most) and the residuals (lanes, 4 gains) where each start ends.

    Args:
      own: (parameters,) values of those that are not chosen.
      base: (parameters,) what the exponentials of `starts` are factors of.
      chosen: (lanes, most) indices into `PARAMETERS`, or their number for none.
      starts: (lanes, most).
    """
    own, base = jnp.append(own, 1.0), jnp.append(base, 1.0)

    def one(chosen: jax.Array, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def values(x: jax.Array) -> dict[str, jax.Array]:
            numbers = own.at[chosen].set(base[chosen] * jnp.exp(x))
            return dict(zip(PARAMETERS, numbers[:-1], strict=True))

        end, rest = _least_squares(lambda x: _with_derivatives(prints, plant, values, x), x, 4 * len(prints))
        return base[chosen] * jnp.exp(end), rest

    return jax.vmap(one)(chosen, starts)


def _least_squares(
    residuals: Callable[[jax.Array], tuple[jax.Array, jax.Array]], x: jax.Array, count: int
) -> tuple[jax.Array, jax.Array]:
    """Minimises the residuals' sum of squares by Levenberg and Marquardt's method, from x (n,).

    Args:
      residuals: gives residuals (count,) and their derivatives (count, n).

    Returns:
      Where it ends (n,), and the residuals there (count,); these are infinite if they are not finite at the start.
    """

    def step(carry: tuple[Any, ...], _: None) -> tuple[Any, None]:
        trial, best, damping = carry
        r, J = residuals(trial)
        tried = (jnp.sum(r * r), trial, r, J)
        better = tried[0] < best[0]  # False for NaN
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, best)
        damping = jnp.clip(jnp.where(better, damping / 5.0, damping * 4.0), 1e-12, 1e8)
        _, x, r, J = best
        H = J.T @ J
        scale = jnp.diagonal(H)
        damped = H + damping * jnp.diag(jnp.where(scale > 0.0, scale, 1.0))
        # A relative change by more than e in one step leaves the region where a derivative means something.
        return (x - jnp.clip(linear_solve(damped, (J.T @ r)[:, None])[:, 0], -1.0, 1.0), best, damping), None

    unknown = jnp.full((count,), jnp.inf, dtype=x.dtype)
    nowhere = (unknown[0], x, unknown, jnp.zeros((count, x.shape[0]), dtype=x.dtype))
    (_, (_, x, rest, _), _), _ = lax.scan(step, (x, nowhere, jnp.asarray(5e-2, dtype=x.dtype)), length=_STEPS + 1)
    return x, rest


def _directions(prints: tuple[PrintedGain, ...], plant: CartPole, names: tuple[str, ...]) -> tuple[Direction, ...]:
    """Singular values and vectors of the gains' dependence on relative changes of all parameters, at `plant`."""
    _, J = _linearised(prints, plant)
    relative = J[:, [PARAMETERS.index(name) for name in names]] * [_scale(plant, name) for name in names]
    _, values, vectors = np.linalg.svd(relative, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(names))])[: len(names)]
    values = np.where(values < 1e-9 * values[0], 0.0, values)  # rounding
    return tuple(
        Direction(float(s), {name: float(w) for name, w in zip(names, v, strict=True)})
        for s, v in zip(values, vectors, strict=True)
    )
