"""Linear state feedback."""

from cpjax.numeric.trigonometry import wrap_angle
from cpjax.pytree import Array, Number, Scalar, matrix, part, pytree
from cpjax.state import NAMES, UNITS, UPRIGHT, State


@pytree
class StateFeedback:
    """u = -K (s - s_ref), with the angle's error taken modulo a turn. A controller on its own, or Hybrid's regulator.

    A plain sequence of four gains is accepted for K.
    """

    K: Array = matrix((1, 4), "V per unit of state", "gain, u = -K (s - s_ref)")
    reference: State = part("the state to hold, a State", *NAMES, default=UPRIGHT)

    def __post_init__(self) -> None:
        # A State is not checked when it is constructed; as a parameter of a law it has to be.
        values = (
            Number(unit, name).normalise(f"StateFeedback.reference.{name}", getattr(self.reference, name))
            for name, unit in zip(NAMES, UNITS, strict=True)
        )
        object.__setattr__(self, "reference", State(*values))

    def voltage(self, state: State) -> Scalar:
        """Demanded voltage [V]."""
        k = self.K
        return -(
            k[0, 0] * (state.x - self.reference.x)
            + k[0, 1] * (state.x_dot - self.reference.x_dot)
            + k[0, 2] * wrap_angle(state.theta - self.reference.theta)
            + k[0, 3] * (state.theta_dot - self.reference.theta_dot)
        )
