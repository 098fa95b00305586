"""The controller in the loop: its memory, and the input that the drive applies for its command."""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from cpjax.checks import arrays, call, integer, like, pair, real
from cpjax.controllers.protocol import ModeMemory, as_sampled, modes_in, start_memory
from cpjax.pytree import cast
from cpjax.sim import plants
from cpjax.sim.derivatives import difference, holding, shift_of, shifted, tracked, with_zeros
from cpjax.sim.plants import Plant, PlantState
from cpjax.sim.settings import Settings
from cpjax.sim.stepper import applied_voltage, dtype_of

Memory: TypeAlias = Any
"""A controller's memory: any pytree of arrays."""


class Blend(NamedTuple):
    """Quantities of one control period that the derivative of the mean needs; see `derivatives.py`."""

    held: Float[Array, ""]
    """Voltage that would be applied, had the controller's mode not changed."""
    shift: Float[Array, ""]
    """Shift of that change of mode, as a fraction of the period: value 0, with a derivative."""
    voltage_echo: Float[Array, ""]
    """Contribution to the voltage of the change of mode in the previous period: value 0, with a derivative."""
    memory_echo: tuple[Float[Array, "..."], ...]
    """Contribution of this period's change of mode to the memory in the next one: zeros, with a derivative."""
    mode: Int[Array, ""]
    """Mode until this period, int32."""


class Control(NamedTuple):
    """Memory and voltage of the controller from a control instant on."""

    memory: Memory
    voltage: Float[Array, ""]
    """Input that the drive applies [V]."""
    blend: Blend | None = None
    """None unless the derivative of the mean is requested."""

    @property
    def applied(self) -> Float[Array, ""]:
        """Voltage with the derivative that the plant receives [V]."""
        if self.blend is None:
            return self.voltage
        return shifted(self.voltage, self.blend.held, 1.5 * self.blend.shift) + self.blend.voltage_echo

    @property
    def mode(self) -> Int[Array, ""]:
        """Mode that a trajectory records: the first one in the memory, 0 if there is none."""
        modes = modes_in(self.memory)
        return modes[0].mode if modes else jnp.asarray(0, dtype=jnp.int32)


def start_control(plant: Plant, controller: Any, start: PlantState, settings: Settings) -> Control:
    """Returns the memory before the controller's first update, and the voltage after it."""
    if settings.clock == "continuous":
        memory: Memory = start_memory(controller, start)
    else:
        firmware = as_sampled(tracked(controller) if settings.derivative == "mean" else controller)
        memory = cast(arrays("controller.init: memory", call("controller", firmware, "init", start)), dtype_of(start))
        memory = jax.tree.map(jnp.asarray, memory)
    first = update_control(plant, controller, Control(memory, jnp.zeros((), dtype_of(start))), start, settings)
    if first.blend is None:
        return Control(memory, first.voltage)
    nothing = jax.tree.map(jnp.zeros_like, first.blend)
    mode = Control(memory, first.voltage).mode
    return Control(memory, first.voltage, nothing._replace(held=first.voltage, mode=mode))


def update_control(plant: Plant, controller: Any, before: Control, state: PlantState, settings: Settings) -> Control:
    """Runs the controller at a control instant."""
    memory = before.memory
    if settings.clock == "continuous":
        mode = integer("controller.next_mode", call("controller", controller, "next_mode", state, memory.mode))
        return Control(ModeMemory(mode), applied_voltage(plant, controller, state, mode))
    if settings.derivative != "mean":
        memory, command = _updated(as_sampled(controller), memory, state)
        return Control(memory, plants.saturate(plant, command))
    updated, command = _updated(as_sampled(tracked(controller)), memory, state)
    unchanged, other = _updated(as_sampled(holding(controller)), memory, state)
    # The derivative uses only the value of the other command, so the command's own derivative is dropped.
    voltage, held = plants.saturate(plant, command), lax.stop_gradient(plants.saturate(plant, other))
    shift = shift_of(updated).astype(voltage.dtype)
    nothing = jnp.zeros_like(voltage)
    echo = nothing
    if before.blend is not None:
        updated = with_zeros(updated, before.blend.memory_echo)
        echo = shifted(nothing, lax.stop_gradient(before.blend.held - before.voltage), -0.5 * before.blend.shift)
    gap = lax.stop_gradient(difference(unchanged, updated))
    zeros = jax.tree.map(jnp.zeros_like, gap)
    memory = with_zeros(updated, shifted(zeros, gap, 1.5 * shift))
    return Control(memory, voltage, Blend(held, shift, echo, shifted(zeros, gap, -0.5 * shift), before.mode))


def _updated(controller: Any, memory: Memory, state: PlantState) -> tuple[Memory, Float[Array, ""]]:
    returned = call("controller", controller, "update", memory, state)
    updated, command = pair("controller.update", returned, "the new memory and the command")
    dtype = dtype_of(state)
    updated = arrays("controller.update: memory", updated)
    return like("controller.update: memory", cast(updated, dtype), memory), real("controller.update", command, dtype)
