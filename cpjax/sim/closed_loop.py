"""Plant and controller as a `System` of smooth modes, in the form that located switching integrates.

On the continuous clock the guards are the voltage limit, the controller's margin and the plant's own guards; on the
sampled clock, on which the input is held, only the plant's own.
"""

from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from cpjax.backend.single_kernel import outline
from cpjax.checks import call, integer, real
from cpjax.controllers.protocol import SmoothController, demand
from cpjax.numeric.selection import where
from cpjax.sim import plants
from cpjax.sim.plants import Plant, Tree
from cpjax.sim.stepper import dtype_of
from cpjax.sim.switching import Observation

LIMIT, GATE = 0, 1
"""Indices of the guards on the continuous clock: the voltage limit, of either sign, and the controller's margin."""

GATE_CROSSING = 3
"""Value of `Sample.crossing` at a located change of the controller's mode; 1 and 2 are the voltage limits."""


class Mode(NamedTuple):
    """Mode in which the closed loop is smooth, on the continuous clock."""

    law: Int[Array, ""]
    """The controller's mode, int32."""
    clip: Int[Array, ""]
    """Saturation of the demanded voltage: 1 above the upper limit, -1 below the lower one, 0 inside, int32."""
    plant: Tree
    """The plant's own mode."""


class ContinuousLoop(NamedTuple):
    """Plant and controller on the continuous clock. Its output is the applied voltage.

    The plant's drive must clip at `plant.input_limit` and do nothing else, because the instant at which the demand
    reaches that limit is located by a guard.
    """

    plant: Any
    """A `Plant` that also has an `input_limit`."""
    controller: SmoothController

    def observe(self, q: Tree, v: Tree, mode: Mode) -> Observation:
        state = plants.state_of(self.plant, q, v)
        limit = self.plant.input_limit
        demanded = self._demand(state, mode.law)
        relative = demanded / limit  # 0 for an infinite supply
        margin = real("controller.margin", call("controller", self.controller, "margin", state, mode.law))
        u = self._applied(demanded, mode.clip)
        guards = (
            # Inside, one guard for both limits: its kink at 0 is far from where it falls.
            where(mode.clip == 0, 1.0 - jnp.abs(relative), where(mode.clip > 0, relative, -relative) - 1.0),
            margin.astype(dtype_of(state)),
            *plant_guards(self.plant, q, v, u, mode.plant),
        )
        return Observation(plant_accelerations(self.plant, q, v, u, mode.plant), guards, u)

    def jump(self, q: Tree, v: Tree, mode: Mode, guard: Int[Array, ""]) -> tuple[Tree, Tree, Mode]:
        successor = integer("controller.successor", call("controller", self.controller, "successor", mode.law))
        law = where(guard == GATE, successor, mode.law)
        of_plant, own = mode.plant, guard > GATE
        if plants.has_events(self.plant):
            after = outline(plants.jump)(self.plant, q, v, mode.plant, guard - (GATE + 1))
            q, v, of_plant = jax.tree.map(lambda new, old: where(own, new, old), after, (q, v, mode.plant))
        state = plants.state_of(self.plant, q, v)
        demanded = self._demand(state, law)
        now = self._clip(demanded)
        # On the limit itself the demand's excess is rounding error and is ignored. A demand that has jumped past the
        # other limit is clipped there.
        inside = where(now == -mode.clip, now, 0)
        clip = where(mode.clip == 0, where(demanded > 0.0, 1, -1), inside)
        clip = where((guard == GATE) | own, now, clip).astype(mode.clip.dtype)
        # A jump of the plant's state may have moved the demand beyond a limit, and one of the demand may release it.
        if plants.has_events(self.plant):
            of_plant = outline(plants.release)(self.plant, q, v, self._applied(demanded, clip), of_plant)
        return q, v, Mode(law, clip, of_plant)

    def start_mode(self, start: Tree) -> Mode:
        """Returns the mode at the start of a rollout."""
        law = integer("controller.start_mode", call("controller", self.controller, "start_mode", start))
        demanded = self._demand(start, law)
        clip = self._clip(demanded)
        q, v = plants.coordinates(self.plant, start)
        of_plant = plants.start_mode(self.plant, q, v)
        return Mode(law, clip, plants.release(self.plant, q, v, self._applied(demanded, clip), of_plant))

    def _clip(self, demanded: Float[Array, ""]) -> Int[Array, ""]:
        limit = self.plant.input_limit
        return (demanded > limit).astype(jnp.int32) - (demanded < -limit).astype(jnp.int32)

    def _applied(self, demanded: Float[Array, ""], clip: Int[Array, ""]) -> Float[Array, ""]:
        """Returns the applied voltage, with the demand clipped as `clip` says."""
        limit = self.plant.input_limit
        return where(clip == 0, demanded, where(clip > 0, limit, -limit))

    def _demand(self, state: Tree, law: Int[Array, ""]) -> Float[Array, ""]:
        return demand(self.controller, state, law)


class HeldMode(NamedTuple):
    """Mode in which the plant is smooth between two control instants."""

    u: Float[Array, ""]
    """The held input."""
    plant: Tree
    """The plant's own mode."""


class HeldLoop(NamedTuple):
    """A plant with events of its own, under a held input. Its output is the input."""

    plant: Plant

    def observe(self, q: Tree, v: Tree, mode: HeldMode) -> Observation:
        guards = plant_guards(self.plant, q, v, mode.u, mode.plant)
        return Observation(plant_accelerations(self.plant, q, v, mode.u, mode.plant), guards, mode.u)

    def jump(self, q: Tree, v: Tree, mode: HeldMode, guard: Int[Array, ""]) -> tuple[Tree, Tree, HeldMode]:
        q, v, of_plant = outline(plants.jump)(self.plant, q, v, mode.plant, guard)
        return q, v, mode._replace(plant=outline(plants.release)(self.plant, q, v, mode.u, of_plant))


System: TypeAlias = ContinuousLoop | HeldLoop


def plant_accelerations(plant: Plant, q: Tree, v: Tree, u: Float[Array, ""], mode: Tree) -> Tree:
    """Returns the accelerations q'' under the input `u`, in the plant's own mode."""
    geometry = plants.geometry(plant, q)
    return outline(plants.accelerations)(plant, geometry, v, u, mode)


def plant_guards(plant: Plant, q: Tree, v: Tree, u: Float[Array, ""], mode: Tree) -> tuple[Any, ...]:
    """Returns the plant's own guards, () for a plant without events."""
    return outline(plants.guards)(plant, q, v, u, mode) if plants.has_events(plant) else ()
