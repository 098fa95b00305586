"""Free parameters of a hybrid controller, as an unconstrained vector for an optimiser.

Positive parameters enter by their logarithm, those between two bounds by a logit, others as they are. The regulator's
gain is always computed by its design for the swing-up law's model of the plant: gradients pass through the Riccati
equation, or through the pole placement.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.controllers import EnergySwingUp, Hybrid, LqrWeights, LyapunovGate, PoleFactors, StateFeedback
from cpjax.errors import InputError
from cpjax.plant import AccelerationActuator, CartPole, linearize
from cpjax.pytree import Number, rules

Vector: TypeAlias = Float[Array, " parameters"]
"""Free parameters, unconstrained."""

FROZEN = ("R", "hysteresis", "kick", "kick_radius")
"""Names that are not free by default: K depends on Q / R alone, and the others are small corrections."""

_LEAST = 1e-3
"""Initial value of a parameter that is zero, in its natural unit: the logarithm of zero is not finite."""


class _Slot(NamedTuple):
    """Position of a parameter in the vector, and its transformation."""

    name: str
    part: str
    """Part of the controller: swing_up, design or gate."""
    kind: str
    """Transformation: log, logit, plain, or full (a Cholesky factor)."""
    begin: int
    size: int
    low: float
    high: float
    """`low` and `high` bound the range from which `draw` draws the parameter."""


@dataclasses.dataclass(frozen=True)
class FreeParameters:
    """Free parameters of `controller`, and the maps between an unconstrained vector and a controller.

    Built by `free_parameters`.
    """

    controller: Hybrid
    slots: tuple[_Slot, ...]

    @property
    def model(self) -> CartPole:
        """Plant model used by the swing-up law, for which the regulator is designed."""
        return _law(self.controller).model

    @property
    def labels(self) -> tuple[str, ...]:
        """Name of each element of a physical vector, such as "Q[0]"."""
        return tuple(
            slot.name if slot.size == 1 else f"{slot.name}[{i}]" for slot in self.slots for i in range(slot.size)
        )

    def start(self) -> Vector:
        """Returns the vector of `controller` itself; zeros become small numbers where a logarithm is taken."""
        parts = []
        for slot in self.slots:
            value = np.asarray(_read(self.controller, slot), dtype=np.float64).reshape(-1)
            if slot.kind == "full":
                value = _from_full(np.asarray(_weights(self.controller).Q, dtype=np.float64))
            elif slot.kind == "log":
                unit = _scales(self.controller) if slot.name == "Q" else 1.0
                value = np.log(np.where(value > 0.0, value, _LEAST * slot.high * unit))
            elif slot.kind == "logit":
                low, high = self._ends(slot, _first(self.controller, "hysteresis"))
                share = np.clip((value - low) / (high - low), 1e-6, 1.0 - 1e-6)
                value = np.log(share) - np.log1p(-share)
            parts.append(value)
        return jnp.asarray(np.concatenate(parts), dtype=jnp.result_type(float))

    def physical(self, vector: Vector) -> Float[Array, " parameters"]:
        """Returns the parameters of a vector in SI units; for a full Q the rows of its lower triangle."""
        values = (self._value(slot, vector) for slot in self.slots)
        return jnp.concatenate([v if v.ndim == 1 else v[jnp.tril_indices(4)] for v in values])

    def build(self, vector: Vector) -> Hybrid:
        """Returns the controller of a vector. Differentiable, also under jit and vmap."""
        given: dict[str, dict[str, Any]] = {"swing_up": {}, "design": {}, "gate": {}}
        for slot in self.slots:
            value = self._value(slot, vector)
            if slot.name == "Q" and slot.kind == "log":
                value = jnp.diag(value)
            given[slot.part][slot.name] = value if slot.name in ("Q", "a", "b") else value[0]
        regulator: Any = self.controller.regulator
        gate: Any = self.controller.gate  # a dataclass, which the protocol that annotates it does not say
        swing_up = dataclasses.replace(_law(self.controller), **given["swing_up"])
        gate = dataclasses.replace(gate, **given["gate"])
        if given["design"]:
            design = dataclasses.replace(regulator.design, **given["design"])
            found = design.solve(*linearize(swing_up.model))
            regulator = StateFeedback(found.K, regulator.reference, design)
            if isinstance(gate, LyapunovGate):
                gate = dataclasses.replace(gate, P=found.P)
        return Hybrid(swing_up, regulator, gate)

    def draw(
        self, random: np.random.Generator, count: int, *, short_track: bool = False
    ) -> Float[np.ndarray, "vectors parameters"]:
        """Draws random vectors from the slots' ranges, uniform in the logarithm, or in the angle itself.

        Args:
          random: generator of the random numbers.
          count: number of vectors.
          short_track: extend the energy gains' range down to a fifth: a short track needs lower gains and more swings.
        """
        columns = []
        for slot in self.slots:
            low, high = slot.low, slot.high
            if short_track and slot.name == "energy_gain":
                low = 0.2 * low
            for i in range(slot.size):
                if slot.kind == "logit":
                    bottom, top = self._ends(slot, _first(self.controller, "hysteresis"))
                    share = (random.uniform(low, min(high, 0.98 * top), count) - bottom) / (top - bottom)
                    columns.append(np.log(share) - np.log1p(-share))
                elif slot.kind == "full" and i >= 4:
                    columns.append(random.uniform(-0.5, 0.5, count))
                elif slot.name == "Q":
                    drawn = math.log(_scales(self.controller)[i]) + random.uniform(math.log(low), math.log(high), count)
                    columns.append(0.5 * drawn if slot.kind == "full" else drawn)
                elif slot.kind == "log":
                    columns.append(random.uniform(math.log(low), math.log(high), count))
                else:
                    columns.append(random.uniform(low, high, count))
        return np.stack(columns, axis=1)

    def _value(self, slot: _Slot, vector: Vector) -> Float[Array, " slot"] | Float[Array, "4 4"]:
        x = vector[slot.begin : slot.begin + slot.size]
        if slot.kind == "log":
            return jnp.exp(x)
        if slot.kind == "logit":
            hysteresis = next((self._value(s, vector)[0] for s in self.slots if s.name == "hysteresis"), None)
            low, high = self._ends(slot, _first(self.controller, "hysteresis") if hysteresis is None else hysteresis)
            return low + (high - low) * jax.nn.sigmoid(x)
        return _full(x) if slot.kind == "full" else x

    def _ends(self, slot: _Slot, hysteresis: Any) -> tuple[float, Any]:
        """Returns the bounds of a parameter with a logit."""
        if slot.name == "half_angle":  # the exit region must not exceed pi on either side
            return 0.0, math.pi / (1.0 + hysteresis)
        rule = rules(EnergySwingUp)[slot.name]
        assert isinstance(rule, Number)
        return rule.at_least, rule.at_most


def free_parameters(
    controller: Hybrid, free: Sequence[str] | None = None, *, frozen: Sequence[str] = (), full_q: bool = False
) -> FreeParameters:
    """Returns the free parameters of a hybrid controller with an energy law and a regulator with a design.

    Args:
      controller: a `Hybrid` of an `EnergySwingUp`, a `StateFeedback` with its `design`, and any gate.
      free: names such as "energy_gain", "Q", "a", "half_angle"; by default all but `FROZEN`.
      frozen: names that are not free even if in `free`.
      full_q: whether the free Q is full instead of diagonal.

    Raises:
      InputError: another kind of controller, a name that it does not have, no name left, `full_q` where no Q is free,
        or a free Q that is not diagonal without `full_q`.
    """
    if not isinstance(controller, Hybrid) or not isinstance(controller.swing_up, EnergySwingUp):
        raise InputError("controller", controller, "a cpjax.Hybrid with a cpjax.EnergySwingUp")
    regulator = controller.regulator
    if not isinstance(regulator, StateFeedback) or not isinstance(regulator.design, (LqrWeights, PoleFactors)):
        raise InputError("regulator", regulator, "a StateFeedback whose design is LqrWeights or PoleFactors")
    ranges = _ranges(controller)
    places = {name: "swing_up" for name, rule in rules(EnergySwingUp).items() if isinstance(rule, Number)}
    places |= dict.fromkeys(("Q", "R") if isinstance(regulator.design, LqrWeights) else ("a", "b"), "design")
    places |= {name: "gate" for name, rule in rules(type(controller.gate)).items() if isinstance(rule, Number)}
    for field, names in (("free", free or ()), ("frozen", frozen)):
        for name in names:
            if name not in places:
                raise InputError(field, name, "one of " + ", ".join(places))
    chosen = [name for name in places if (name not in FROZEN if free is None else name in free) and name not in frozen]
    if not chosen:
        raise InputError("free", free, "at least one name that is not frozen")
    if full_q and "Q" not in chosen:
        raise InputError("full_q", full_q, "False: there is no Q among the free parameters")
    if "Q" in chosen and not full_q:
        Q = np.asarray(_weights(controller).Q)
        if np.count_nonzero(Q - np.diag(np.diagonal(Q))):
            raise InputError("full_q", full_q, "True: the controller's Q is not diagonal")
    sizes = {"Q": 10 if full_q else 4, "a": 2, "b": 2}
    slots, begin = [], 0
    for name in chosen:
        kind = "log"
        if name in ("half_angle", "kick_radius"):
            kind = "logit"
        elif name == "kick":
            kind = "plain"
        elif name == "Q" and full_q:
            kind = "full"
        size = sizes.get(name, 1)
        slots.append(_Slot(name, places[name], kind, begin, size, *ranges[name]))
        begin += size
    return FreeParameters(controller, tuple(slots))


class _Natural(NamedTuple):
    """Natural units of the plant, for ranges that suit any rig."""

    rate: float
    """Angular frequency of small oscillations about hanging, sqrt(m g l / J), J about the pivot [1/s]."""
    energy_gain: float
    """Cart acceleration at full voltage over 4 m g l times `rate`: over energy times rate of a swing-up [m/(J s)]."""
    weights: tuple[float, ...]
    """Diagonal of Q / R at which one pole length or one radian (of a rate, times `rate`) costs as full voltage does."""
    level: float
    """Typical cost of a return to upright, in the unit of the design's s' P s."""


def _natural(controller: Hybrid) -> _Natural:
    plant, regulator = _law(controller).model, controller.regulator
    assert isinstance(regulator, StateFeedback)
    weight = float(plant.pole_mass) * float(plant.gravity) * float(plant.pole_length)
    rate = math.sqrt(weight / float(plant.pivot_inertia))
    limit = float(plant.motor.voltage_limit)
    voltage = limit if math.isfinite(limit) else 12.0
    mass = 1.0 if isinstance(plant.motor, AccelerationActuator) else float(plant.moving_mass)
    push = abs(float(plant.motor.force_per_voltage)) * voltage / mass
    length = float(plant.pole_length)
    per = (voltage / length, voltage / (length * rate), voltage, voltage / rate)
    design = regulator.design
    level = float(design.R) * voltage * voltage / rate if isinstance(design, LqrWeights) else 1.0 / rate
    return _Natural(rate, push / (4.0 * weight * rate), tuple(v * v for v in per), level)


def _ranges(controller: Hybrid) -> Mapping[str, tuple[float, float]]:
    """Returns the ranges from which parameters are drawn, in SI units; of Q in natural units."""
    natural = _natural(controller)
    w = natural.rate
    return {
        "energy_gain": (2.5 * natural.energy_gain, 40.0 * natural.energy_gain),
        "cart_stiffness": (0.07 * w * w, 1.1 * w * w),
        "cart_damping": (0.25 * w, 2.2 * w),
        "kick": (0.2, 5.0),
        "kick_radius": (0.02, 1.0),
        "Q": (0.02, 10.0),
        "R": (1e-4, 1.0),
        "a": (0.8 * w, 5.0 * w),
        "b": (0.5 * w * w, 4.5 * w * w),
        "half_angle": (0.3, math.pi),
        "rate": (0.5 * w, 4.0 * w),
        "level": (0.1 * natural.level, 30.0 * natural.level),
        "hysteresis": (0.01, 0.3),
    }


def _law(controller: Hybrid) -> EnergySwingUp:
    law = controller.swing_up
    assert isinstance(law, EnergySwingUp)  # checked by `free_parameters`
    return law


def _weights(controller: Hybrid) -> LqrWeights:
    regulator = controller.regulator
    assert isinstance(regulator, StateFeedback)
    assert isinstance(regulator.design, LqrWeights)
    return regulator.design


def _scales(controller: Hybrid) -> Float[np.ndarray, "4"]:
    """Returns the natural units of the elements of Q's diagonal."""
    return np.asarray(_natural(controller).weights) * float(_weights(controller).R)


def _first(controller: Hybrid, name: str) -> float:
    """Returns the gate's own value of a parameter, 0 where it has none."""
    return float(getattr(controller.gate, name, 0.0))


def _read(controller: Hybrid, slot: _Slot) -> Any:
    regulator: Any = controller.regulator
    if slot.part == "design":
        value = getattr(regulator.design, slot.name)
        return np.diagonal(np.asarray(value)) if slot.name == "Q" else value
    return getattr(getattr(controller, slot.part), slot.name)


_BELOW = np.tril_indices(4, -1)


def _full(x: Float[Array, "10"]) -> Float[Array, "4 4"]:
    """Returns Q = D U U' D: D diagonal, exp(x[:4]); U unit lower triangular, x[4:] below ones."""
    U = jnp.eye(4, dtype=x.dtype).at[_BELOW].set(x[4:])
    L = jnp.exp(x[:4])[:, None] * U
    return L @ L.T


def _from_full(Q: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "10"]:
    """Returns the x from which `_full` builds Q; a nearly singular Q gets a small multiple of I added."""
    floor = _LEAST**2 * np.max(np.diagonal(Q))
    L = np.linalg.cholesky(Q + floor * np.eye(4)) if np.min(np.linalg.eigvalsh(Q)) < floor else np.linalg.cholesky(Q)
    D = np.diagonal(L)
    return np.concatenate([np.log(D), (L / D[:, None])[_BELOW]])
