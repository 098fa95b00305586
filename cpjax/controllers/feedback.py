"""Linear state feedback."""

from cpjax.pytree import Array, Scalar, matrix, part, pytree
from cpjax.state import NAMES, UPRIGHT, State, checked_reference, deviation


@pytree
class StateFeedback:
    """u = -K (s - s_ref), with the angle's error taken modulo a turn. A controller on its own, or Hybrid's regulator.

    A plain sequence of four gains is accepted for K.
    """

    K: Array = matrix((1, 4), "V per unit of state", "gain, u = -K (s - s_ref)")
    reference: State = part("the state to hold, a State", *NAMES, default=UPRIGHT)

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", checked_reference("StateFeedback.reference", self.reference))

    def voltage(self, state: State) -> Scalar:
        """Demanded voltage [V]."""
        s = deviation(state, self.reference)
        return -(self.K[0, 0] * s[0] + self.K[0, 1] * s[1] + self.K[0, 2] * s[2] + self.K[0, 3] * s[3])
