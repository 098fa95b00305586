"""Drive: what stands between the firmware's command and the motor's terminals."""

import jax.numpy as jnp

from cpjax.pytree import Scalar, number, pytree


@pytree
class Drive:
    """Imperfections of amplifier and motor, acting on the command after its clip."""

    delay: Scalar = number(
        "s", "a command takes effect so long after its measurement; a whole number of steps", default=0.0, at_least=0.0
    )
    dead_band: Scalar = number("V", "commands of at most this magnitude give 0 V", default=0.0, at_least=0.0)

    def apply(self, voltage: Scalar) -> Scalar:
        """Returns the terminal voltage [V] for a clipped command [V]; its derivative is 0 inside the dead band."""
        return jnp.where(jnp.abs(voltage) <= self.dead_band, 0.0 * voltage, voltage)
