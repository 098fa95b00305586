"""Metrics of a rollout, computed while it runs.

A metric is a streaming reduction over the rollout's samples: `init` with the first sample, `update` with each sample
(the first one included, at `elapsed = 0`), `finalize` with the last. The trajectory need not be stored for it, so a
million initial states fit in state.
"""

import math
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cpjax.backend.trigonometry import sin_cos
from cpjax.errors import InputError
from cpjax.numeric.angles import wrap_angle
from cpjax.numeric.selection import where
from cpjax.pytree import Scalar, number, pytree
from cpjax.sim.flags import STOPPED
from cpjax.sim.plants import PlantState, Tree

MetricState: TypeAlias = Any
"""State of a metric between two samples: any pytree of arrays."""


class Sample(NamedTuple):
    """The closed loop at one instant."""

    time: Float[Array, ""]
    """Time since the start of the rollout [s]."""
    elapsed: Float[Array, ""]
    """Time since the previous sample [s]; 0 at the first, and after a flag has stopped the run."""
    state: PlantState
    """State of the plant."""
    voltage: Float[Array, ""]
    """Input applied from this sample on, clipped [V]."""
    voltage_since: Float[Array, ""]
    """Input applied right after the previous sample [V]; at the first sample equal to `voltage`."""
    voltage_until: Float[Array, ""] | None
    """Input applied right before this sample [V]: the law of the mode until now at this state. None on the sampled
    clock, where a held voltage has not changed since the previous sample."""
    mode: Int[Array, ""]
    """Mode from this sample on."""
    mode_before: Int[Array, ""]
    """Mode from the previous sample until this one."""
    outputs: dict[str, Float[Array, ""]]
    """Further outputs of the plant from this sample on, by name; for a `CartPole`, `cart_acceleration` [m/s^2]."""
    plant_mode: Tree
    """The plant's own mode from this sample on; () for a plant without modes."""
    flag: Int[Array, ""]
    """Bits of `Flag`."""
    crossing: Int[Array, ""]
    """Event located at this sample, int32: 0 none, 1 and 2 the upper and the lower voltage limit, 3 the gate; from 4 on
    the plant's own events, in the order of its guards."""
    crossing_speed: Float[Array, ""]
    """Rate at which that guard (relative voltage, gate margin, plant's guard) fell [its unit/s]; 0 without an event."""

    @property
    def voltage_before(self) -> Float[Array, ""]:
        """Input applied right before this sample [V], on either clock."""
        return self.voltage_since if self.voltage_until is None else self.voltage_until

    @property
    def cart_acceleration(self) -> Float[Array, ""]:
        """x'' of a cart-pole from this sample on [m/s^2]."""
        if "cart_acceleration" not in self.outputs:
            names = ", ".join(self.outputs) or "none"
            raise InputError("plant.outputs", names, "with cart_acceleration, for this metric")
        return self.outputs["cart_acceleration"]


@runtime_checkable
class Metric(Protocol):
    """Interface of a metric, a streaming reduction over samples. A pytree: its numbers may be traced."""

    def init(self, sample: Sample) -> MetricState:
        """Returns the metric state before the first update: any pytree of arrays."""
        ...

    def update(self, state: MetricState, sample: Sample) -> MetricState:
        """Returns the metric state after `sample`, of the same structure, shapes and dtypes."""
        ...

    def finalize(self, state: MetricState, last: Sample) -> Any:
        """Returns the result from the final metric state and the last sample."""
        ...


Fold = Metric
"""The name until version 0.1."""


def finalize(metric: Metric, state: MetricState, last: Sample) -> Any:
    """Returns a metric's result from its final state and the last sample."""
    return getattr(metric, finalize_name(metric))(state, last)


def finalize_name(metric: Metric) -> str:
    """Returns the name of the method that gives a metric's result, which was `finish` until version 0.1."""
    return "finalize" if hasattr(metric, "finalize") else "finish"


Integral: TypeAlias = tuple[Float[Array, ""], Float[Array, ""]]
"""State of a metric that integrates by the trapezoidal rule: the integral so far, and the integrand now."""


@pytree
class NoMetrics:
    """Empty metric; its result is None."""

    def init(self, sample: Sample) -> tuple[()]:
        return ()

    def update(self, state: tuple[()], sample: Sample) -> tuple[()]:
        return ()

    def finalize(self, state: tuple[()], last: Sample) -> None:
        return None


@pytree
class Metrics:
    """Metrics of the evaluation protocol for one rollout; after a sweep, those of all its initial states.

    Attributes:
      success: settled at least `hold` before the end, |x| never beyond `track_limit`, and not stopped by a flag.
      settling_time: first time from which |theta| (wrapped) and |x - reference_x| stay in their bands to the end [s];
        inf if never.
      cart_travel: max |x| [m].
      effort: integral of u^2 dt [V^2 s], exact for a held voltage, by the trapezoidal rule for a continuous one.
      voltage_variation: total variation of u [V].
      peak_voltage: max |u|, after the clip [V].
      peak_cart_acceleration: max |x''| at the samples [m/s^2].
      switches: number of mode changes.
      flag: bits of `Flag`.
    """

    success: Bool[Array, "*batch"]
    settling_time: Float[Array, "*batch"]
    cart_travel: Float[Array, "*batch"]
    effort: Float[Array, "*batch"]
    voltage_variation: Float[Array, "*batch"]
    peak_voltage: Float[Array, "*batch"]
    peak_cart_acceleration: Float[Array, "*batch"]
    switches: Int[Array, "*batch"]
    flag: Int[Array, "*batch"]


@pytree
class TimeOutside:
    """Metric whose result is a smooth, bounded surrogate of the settling time [s].

    The integral of 1 - exp(-(1 - cos theta) / angle_width^2 - ((x - reference_x) / position_width)^2 / 2) by the
    trapezoidal rule: roughly the time spent farther than the widths from upright at `reference_x`. The cosine makes it
    smooth also at theta = pi, where theta modulo a turn, and a sum over samples of it, has a kink.
    """

    angle_width: Scalar = number("rad", "of the target", default=0.2, above=0.0)
    position_width: Scalar = number("m", "of the target", default=0.2, above=0.0)
    reference_x: Scalar = number("m", "where the cart is to settle", default=0.0)

    def init(self, sample: Sample) -> Integral:
        return jnp.zeros_like(sample.time), self._outside(sample)

    def update(self, state: Integral, sample: Sample) -> Integral:
        total, before = state
        now = self._outside(sample)
        return total + 0.5 * sample.elapsed * (before + now), now

    def finalize(self, state: Integral, last: Sample) -> Float[Array, ""]:
        return state[0]

    def _outside(self, sample: Sample) -> Float[Array, ""]:
        _, cos = sin_cos(sample.state.theta)
        away = (sample.state.x - self.reference_x) / self.position_width
        return 1.0 - jnp.exp(-(1.0 - cos) / (self.angle_width * self.angle_width) - 0.5 * away * away)


class _State(NamedTuple):
    entered: Float[Array, ""]
    cart_travel: Float[Array, ""]
    effort: Float[Array, ""]
    voltage_variation: Float[Array, ""]
    peak_voltage: Float[Array, ""]
    peak_cart_acceleration: Float[Array, ""]
    switches: Int[Array, ""]


@pytree
class ProtocolMetrics:
    """Metric whose result is `Metrics`. Not smooth: settling time and success are piecewise constant in parameters."""

    angle_band: Scalar = number("rad", "settled: |theta| within", default=0.05, above=0.0)
    position_band: Scalar = number("m", "settled: |x - reference_x| within", default=0.05, above=0.0)
    hold: Scalar = number("s", "success: settled at least so long before the end", default=1.0, at_least=0.0)
    reference_x: Scalar = number("m", "where the cart is to settle", default=0.0)
    track_limit: Scalar = number("m", "success: |x| never beyond", default=math.inf, above=0.0, infinite=True)

    def init(self, sample: Sample) -> _State:
        nothing = jnp.zeros_like(sample.voltage)
        return _State(
            entered=jnp.full_like(sample.voltage, math.inf),
            cart_travel=nothing,
            effort=nothing,
            voltage_variation=nothing,
            peak_voltage=nothing,
            peak_cart_acceleration=nothing,
            switches=jnp.zeros_like(sample.mode),
        )

    def update(self, state: _State, sample: Sample) -> _State:
        travel = jnp.abs(sample.state.x)
        away = jnp.abs(sample.state.x - self.reference_x)
        inside = (jnp.abs(wrap_angle(sample.state.theta)) <= self.angle_band) & (away <= self.position_band)
        first, last = sample.voltage_since, sample.voltage_until
        variation = jnp.abs(sample.voltage - sample.voltage_before)
        # The factors are ordered so that 0 s of a huge voltage gives 0 and not 0 times infinity.
        effort = sample.elapsed * first * first
        if last is not None:
            variation = variation + jnp.abs(last - first)
            effort = 0.5 * (effort + sample.elapsed * last * last)
        return _State(
            entered=where(inside, jnp.minimum(sample.time, state.entered), math.inf),
            cart_travel=jnp.maximum(state.cart_travel, travel),
            effort=state.effort + effort,
            voltage_variation=state.voltage_variation + variation,
            peak_voltage=jnp.maximum(state.peak_voltage, jnp.abs(sample.voltage)),
            peak_cart_acceleration=jnp.maximum(state.peak_cart_acceleration, jnp.abs(sample.cart_acceleration)),
            switches=state.switches + (sample.mode != sample.mode_before).astype(state.switches.dtype),
        )

    def finalize(self, state: _State, last: Sample) -> Metrics:
        stopped = (last.flag & STOPPED) != 0
        settling_time = where(stopped, math.inf, state.entered)
        rounding = 64.0 * float(np.finfo(last.time.dtype).eps) * last.time
        in_time = settling_time <= last.time - self.hold + rounding
        return Metrics(
            success=in_time & (state.cart_travel <= self.track_limit),
            settling_time=settling_time,
            cart_travel=state.cart_travel,
            effort=state.effort,
            voltage_variation=state.voltage_variation,
            peak_voltage=state.peak_voltage,
            peak_cart_acceleration=state.peak_cart_acceleration,
            switches=state.switches,
            flag=last.flag,
        )
