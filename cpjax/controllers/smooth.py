"""Optional smooth surrogates of the switch and of the clip; a rollout never inserts them by itself.

They are different controllers, not another form of the same one: their trajectories differ from those of the hard law,
by less the lower the temperature, and their derivatives are those of their own trajectories.
"""

import jax
import jax.numpy as jnp

from cpjax.controllers.gates import Gate
from cpjax.controllers.protocol import SWING_UP, Law
from cpjax.plant.state import State
from cpjax.pytree import Scalars, number, part, pytree


@pytree
class SmoothHybrid:
    """Mixture of both laws, the regulator's weight rising from 0 to 1 across the gate's boundary. A law without modes.

        u = w u_regulator + (1 - w) u_swing_up,     w = 1 / (1 + exp(-margin / temperature))

    The margin is that of the entry region: a mixture has no memory, so a gate's hysteresis has no effect.
    """

    swing_up: Law = part("a law", "voltage")
    regulator: Law = part("a law", "voltage")
    gate: Gate = part("a gate", "margin")
    temperature: Scalars = number("1", "margin over which the share rises from 1/2 to 3/4, almost", above=0.0)

    def voltage(self, state: State) -> Scalars:
        """Returns the demanded voltage [V]."""
        margin = self.gate.margin(state, jnp.asarray(SWING_UP, dtype=jnp.int32))
        share = jax.nn.sigmoid(margin / self.temperature)
        return share * self.regulator.voltage(state) + (1.0 - share) * self.swing_up.voltage(state)


@pytree
class SmoothClip:
    """Law whose demand approaches the supply's limits smoothly, instead of clipping at them, and never exceeds them.

        clip(v) = T log((1 + exp((v + L) / T)) / (1 + exp((v - L) / T))) - L

    with L the limit and T the temperature. If the motor has the same limit, its own clip has no effect.
    """

    law: Law = part("a law", "voltage")
    voltage_limit: Scalars = number("V", "supply, as of the motor", above=0.0)
    temperature: Scalars = number("V", "over which the demand bends", above=0.0)

    def voltage(self, state: State) -> Scalars:
        """Returns the demanded voltage [V]."""
        demand, limit, temperature = self.law.voltage(state), self.voltage_limit, self.temperature
        above, below = (demand - limit) / temperature, (demand + limit) / temperature
        return temperature * (jax.nn.softplus(below) - jax.nn.softplus(above)) - limit
