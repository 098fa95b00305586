"""What a rollout is judged by, computed while it runs.

A metric is a fold over the rollout's samples: `init` with the first sample, `update` with each sample (the first one
included, at `elapsed = 0`), `finish` with the last. Nothing of the trajectory needs to be stored for it, so a million
starts fit in memory.
"""

import math
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from cpjax.backend.extremes import fast_maximum, fast_minimum
from cpjax.backend.trigonometry import sin_cos
from cpjax.numeric.angles import wrap_angle
from cpjax.pytree import Scalar, number, pytree
from cpjax.sim.flags import STOPPED


class Sample(NamedTuple):
    """The closed loop at one instant."""

    time: jax.Array
    """[s]."""
    elapsed: jax.Array
    """Since the sample before [s]; 0 at the first, and after a flag has stopped the run."""
    state: Any
    """The plant's state."""
    voltage: jax.Array
    """The input applied from now on, clipped [V]."""
    voltage_since: jax.Array
    """Applied right after the sample before [V]; at the first sample `voltage`."""
    voltage_until: jax.Array | None
    """Applied right before this sample [V]: the law of the mode until now at this state. None on the sampled clock: a
    held voltage is still what it was."""
    mode: jax.Array
    """From now on."""
    mode_before: jax.Array
    """Until now, since the sample before."""
    outputs: dict[str, jax.Array]
    """What the plant wants kept beside state and input, from now on; of a `CartPole`, `cart_acceleration` [m/s^2]."""
    plant_mode: Any
    """The plant's own mode from now on; () for a plant without modes."""
    flag: jax.Array
    """Bits of `Flag`."""
    crossing: jax.Array
    """What was located here, int32: 0 nothing, 1 and 2 the upper and the lower end of the supply, 3 the gate; events of
    the plant's own from 4 on."""
    crossing_speed: jax.Array
    """How fast that guard fell [1/s]: of the voltage relative to the limit, or of the gate's margin. 0 elsewhere."""

    @property
    def voltage_before(self) -> jax.Array:
        """Applied right before this sample [V], on either clock."""
        return self.voltage_since if self.voltage_until is None else self.voltage_until

    @property
    def cart_acceleration(self) -> jax.Array:
        """x'' of a cart-pole from now on [m/s^2]."""
        return self.outputs["cart_acceleration"]


class Fold(Protocol):
    """A metric as a fold over samples. A pytree: its numbers may be traced."""

    def init(self, sample: Sample) -> Any:
        """The memory before the first update."""
        ...

    def update(self, memory: Any, sample: Sample) -> Any:
        """The memory after `sample`."""
        ...

    def finish(self, memory: Any, last: Sample) -> Any:
        """The result."""
        ...


@pytree
class NoMetrics:
    """The metric that keeps nothing; its result is None."""

    def init(self, sample: Sample) -> tuple[()]:
        return ()

    def update(self, memory: tuple[()], sample: Sample) -> tuple[()]:
        return ()

    def finish(self, memory: tuple[()], last: Sample) -> None:
        return None


@pytree
class Metrics:
    """The evaluation protocol's numbers for one rollout; after a sweep, an array of each.

    Attributes:
      success: settled, `hold` before the end at the latest, within the track, and not stopped by a flag.
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

    success: jax.Array
    settling_time: jax.Array
    cart_travel: jax.Array
    effort: jax.Array
    voltage_variation: jax.Array
    peak_voltage: jax.Array
    peak_cart_acceleration: jax.Array
    switches: jax.Array
    flag: jax.Array


@pytree
class TimeOutside:
    """The fold that yields a smooth and bounded stand-in for the settling time [s].

    The integral of 1 - exp(-(1 - cos theta) / angle_width^2 - ((x - reference_x) / position_width)^2 / 2): the time
    spent farther from upright in place than the widths, roughly. By the trapezoidal rule. The cosine makes it smooth at
    theta = pi too, where theta modulo a turn, and what a sum over samples makes of it, has a kink.
    """

    angle_width: Scalar = number("rad", "of the target", default=0.2, above=0.0)
    position_width: Scalar = number("m", "of the target", default=0.2, above=0.0)
    reference_x: Scalar = number("m", "where the cart is to settle", default=0.0)

    def init(self, sample: Sample) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros_like(sample.time), self._outside(sample)

    def update(self, memory: tuple[jax.Array, jax.Array], sample: Sample) -> tuple[jax.Array, jax.Array]:
        total, before = memory
        now = self._outside(sample)
        return total + 0.5 * sample.elapsed * (before + now), now

    def finish(self, memory: tuple[jax.Array, jax.Array], last: Sample) -> jax.Array:
        return memory[0]

    def _outside(self, sample: Sample) -> jax.Array:
        _, cos = sin_cos(sample.state.theta)
        away = (sample.state.x - self.reference_x) / self.position_width
        return 1.0 - jnp.exp(-(1.0 - cos) / (self.angle_width * self.angle_width) - 0.5 * away * away)


class _Memory(NamedTuple):
    entered: jax.Array
    cart_travel: jax.Array
    effort: jax.Array
    voltage_variation: jax.Array
    peak_voltage: jax.Array
    peak_cart_acceleration: jax.Array
    switches: jax.Array


@pytree
class ProtocolMetrics:
    """The fold that yields `Metrics`. Hard: settling time and success are piecewise constant in every parameter."""

    angle_band: Scalar = number("rad", "settled: |theta| within", default=0.05, above=0.0)
    position_band: Scalar = number("m", "settled: |x - reference_x| within", default=0.05, above=0.0)
    hold: Scalar = number("s", "success: settled at least so long before the end", default=1.0, at_least=0.0)
    reference_x: Scalar = number("m", "where the cart is to settle", default=0.0)
    track_limit: Scalar = number("m", "success: |x| never beyond", default=math.inf, above=0.0, infinite=True)

    def init(self, sample: Sample) -> _Memory:
        nothing = jnp.zeros_like(sample.voltage)
        return _Memory(
            entered=jnp.full_like(sample.voltage, math.inf),
            cart_travel=nothing,
            effort=nothing,
            voltage_variation=nothing,
            peak_voltage=nothing,
            peak_cart_acceleration=nothing,
            switches=jnp.zeros_like(sample.mode),
        )

    def update(self, memory: _Memory, sample: Sample) -> _Memory:
        travel = jnp.abs(sample.state.x)
        away = jnp.abs(sample.state.x - self.reference_x)
        inside = (jnp.abs(wrap_angle(sample.state.theta)) <= self.angle_band) & (away <= self.position_band)
        first, last = sample.voltage_since, sample.voltage_until
        variation = jnp.abs(sample.voltage - sample.voltage_before)
        # The factors stand so that 0 s of a huge voltage is 0 and not 0 times infinity.
        effort = sample.elapsed * first * first
        if last is not None:
            variation = variation + jnp.abs(last - first)
            effort = 0.5 * (effort + sample.elapsed * last * last)
        return _Memory(
            entered=jnp.where(inside, fast_minimum(sample.time, memory.entered), math.inf),
            cart_travel=fast_maximum(memory.cart_travel, travel),
            effort=memory.effort + effort,
            voltage_variation=memory.voltage_variation + variation,
            peak_voltage=fast_maximum(memory.peak_voltage, jnp.abs(sample.voltage)),
            peak_cart_acceleration=fast_maximum(memory.peak_cart_acceleration, jnp.abs(sample.cart_acceleration)),
            switches=memory.switches + (sample.mode != sample.mode_before).astype(memory.switches.dtype),
        )

    def finish(self, memory: _Memory, last: Sample) -> Metrics:
        stopped = (last.flag & STOPPED) != 0
        settling_time = jnp.where(stopped, math.inf, memory.entered)
        rounding = 64.0 * float(np.finfo(last.time.dtype).eps) * last.time
        in_time = settling_time <= last.time - self.hold + rounding
        return Metrics(
            success=in_time & (memory.cart_travel <= self.track_limit),
            settling_time=settling_time,
            cart_travel=memory.cart_travel,
            effort=memory.effort,
            voltage_variation=memory.voltage_variation,
            peak_voltage=memory.peak_voltage,
            peak_cart_acceleration=memory.peak_cart_acceleration,
            switches=memory.switches,
            flag=last.flag,
        )
