"""Linear state feedback and its two designs: linear quadratic regulator and pole placement."""

import copy
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Complex, Float, Num

from cpjax.errors import InputError
from cpjax.linear.lqr import lqr
from cpjax.linear.lyapunov import lyapunov
from cpjax.linear.placement import QuadraticFactors, place_polynomial
from cpjax.plant.state import NAMES, UPRIGHT, State, checked_reference, deviation
from cpjax.pytree import JaxOrNumpy, Scalars, is_traced, matrix, number, part, pytree, rules


class Designed(NamedTuple):
    """Result of a design for a linear model."""

    K: Float[Array, "1 4"]
    """Gain of u = -K s."""
    P: Float[Array, "4 4"]
    """s' P s falls along the linear closed loop."""


DesignName: TypeAlias = Literal["placement", "lqr"]
"""Names of the design methods."""


@runtime_checkable
class Design(Protocol):
    """Interface of a design method, which computes a gain from a linear model."""

    def solve(self, A: Float[JaxOrNumpy, "4 4"], B: Float[JaxOrNumpy, "4 1"]) -> Designed:
        """Returns gain and P for the linear model with state matrix A and input matrix B. Differentiable."""
        ...


@pytree
class LqrWeights:
    """Weights of a linear quadratic regulator."""

    Q: Float[JaxOrNumpy, "*batch 4 4"] = matrix(
        (4, 4), "per product of states", "state weight, positive semidefinite", symmetric=True
    )
    R: Scalars = number("1/V^2", "weight of the voltage", above=0.0)

    def solve(self, A: Float[JaxOrNumpy, "4 4"], B: Float[JaxOrNumpy, "4 1"]) -> Designed:
        """Solves the algebraic Riccati equation; P is its solution."""
        return Designed(*lqr(A, B, self.Q, jnp.reshape(jnp.asarray(self.R), (1, 1))))


@pytree
class PoleFactors:
    """Poles of a placement, as factors s^2 + a s + b of the characteristic polynomial; see `QuadraticFactors`."""

    a: Float[JaxOrNumpy, "*batch 2"] = matrix((2,), "1/s", "above 0: twice the mean rate of decay of each pair")
    b: Float[JaxOrNumpy, "*batch 2"] = matrix((2,), "1/s^2", "above 0: product of each pair")

    def __post_init__(self) -> None:
        for name in ("a", "b"):
            value = getattr(self, name)
            if not is_traced(value) and not np.all(np.asarray(value) > 0.0):
                raise InputError(f"PoleFactors.{name}", value, "two numbers above 0: the poles are to be stable")

    @classmethod
    def from_poles(cls, poles: Num[ArrayLike, "4"] | Sequence[complex]) -> "PoleFactors":
        """Builds the factors from four concrete poles [1/s]; see `QuadraticFactors.from_poles`.

        Raises:
          InputError: poles that are not four, not stable or not closed under conjugation.
        """
        factors = QuadraticFactors.from_poles(poles)
        if factors.a.shape != (2,):
            raise InputError("poles", poles, "four of them")
        return cls(np.asarray(factors.a), np.asarray(factors.b))

    @property
    def poles(self) -> Complex[Array, "4"]:
        """Returns the poles [1/s]; not differentiable where two of them coincide."""
        return self._factors().poles()

    @property
    def polynomial(self) -> Float[Array, "4"]:
        """Returns the characteristic polynomial in the form that `place_polynomial` takes."""
        return self._factors().polynomial()

    def solve(self, A: Float[JaxOrNumpy, "4 4"], B: Float[JaxOrNumpy, "4 1"]) -> Designed:
        """Places the poles by Ackermann's formula; P solves the closed loop's Lyapunov equation with right side -I."""
        K = place_polynomial(A, B, self.polynomial)
        A, B = jnp.asarray(A), jnp.asarray(B)
        return Designed(K, lyapunov(A - B @ K, jnp.eye(4, dtype=K.dtype)))

    def _factors(self) -> QuadraticFactors:
        a, b = jnp.asarray(self.a), jnp.asarray(self.b)
        return QuadraticFactors(a, b, jnp.zeros((0,), dtype=a.dtype))


@pytree
class StateFeedback:
    """State feedback u = -K (s - s_ref), with the angle error modulo a turn; a controller, or Hybrid's regulator.

    A plain sequence of four gains is accepted for K. `design` only records how K was designed, for files and tuning;
    the law depends on K alone.
    """

    K: Float[JaxOrNumpy, "*batch 1 4"] = matrix((1, 4), "V per unit of state", "gain, u = -K (s - s_ref)")
    reference: State = part("the state to hold, a State", *NAMES, default=UPRIGHT)
    design: Design | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", checked_reference("StateFeedback.reference", self.reference))
        if self.design is not None and not hasattr(self.design, "solve"):
            raise InputError("StateFeedback.design", self.design, "LqrWeights, PoleFactors, or None")

    @classmethod
    def from_convention(
        cls,
        K: Num[ArrayLike, "4"] | Num[ArrayLike, "1 4"] | Sequence[float],
        order: Sequence[str] = NAMES,
        *,
        theta_sign: int = 1,
        x_sign: int = 1,
        command_sign: int | None = None,
    ) -> "StateFeedback":
        """Builds the law of a gain that was made for another order or other signs of the state.

        Here theta = 0 is upright, a positive theta leans towards negative x, and u = -K s; a gain of u = K s changes
        sign first. Where a positive angle leans towards positive x, `theta_sign` is -1.

        Args:
          K: the gain of the other convention, u = -K s [its command per unit of its state], in SI units and radians.
          order: names of the states in the order of K's columns: x, x_dot, theta and theta_dot.
          theta_sign: 1, or -1 where its angle has the opposite sign.
          x_sign: 1, or -1 where its cart position has the opposite sign.
          command_sign: 1, or -1 where its command has the opposite sign; `x_sign` by default, so that a positive
            command pushes the cart towards its own positive x.

        Returns:
          The law, whose K has the order and the signs of `State`.

        Raises:
          InputError: a K that is not four finite numbers, an order that does not have each name once, another sign.
        """
        command_sign = x_sign if command_sign is None else command_sign
        for name, sign in (("theta_sign", theta_sign), ("x_sign", x_sign), ("command_sign", command_sign)):
            if isinstance(sign, bool) or not isinstance(sign, (int, float)) or sign not in (-1, 1):
                raise InputError(name, sign, "1 or -1")
        if not isinstance(order, (list, tuple)) or len(order) != 4 or any(name not in order for name in NAMES):
            raise InputError("order", order, "a list with each of " + ", ".join(NAMES) + " once")
        signs = {"x": x_sign, "x_dot": x_sign, "theta": theta_sign, "theta_dot": theta_sign}
        given: Any = rules(cls)["K"].normalise("K", K)  # an array of shape (1, 4)
        columns = [order.index(name) for name in NAMES]
        return cls(given[..., columns] * np.array([command_sign * signs[name] for name in NAMES], dtype=given.dtype))

    def voltage(self, state: State) -> Scalars:
        """Returns the demanded voltage [V]."""
        s = deviation(state, self.reference)
        return -(self.K[0, 0] * s[0] + self.K[0, 1] * s[1] + self.K[0, 2] * s[2] + self.K[0, 3] * s[3])


def without_design(controller: Any) -> Any:
    """Returns a controller without the designs of its regulators: gains with and without one share a compilation."""

    def bare(law: Any) -> Any:
        if not isinstance(law, StateFeedback) or law.design is None:
            return law
        law = copy.copy(law)  # not `replace`, whose checks the gain has already passed
        object.__setattr__(law, "design", None)
        return law

    return jax.tree.map(bare, controller, is_leaf=lambda part: isinstance(part, StateFeedback))
