"""Estimators: the state from measured positions, once per control period.

An estimator that knows the plant predicts its state over a control period by cpjax's own equations, at any angle, and
corrects the prediction by the errors of the predicted positions. Everything is written in scalars: products of small
matrices would keep a loop from becoming one function on a CPU.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cpjax.backend.single_kernel import outline
from cpjax.controllers.feedback import PoleFactors
from cpjax.errors import InputError
from cpjax.linear.discretization import discretize
from cpjax.linear.estimation import dlqe
from cpjax.numeric.selection import where
from cpjax.plant import CartPole, linearize
from cpjax.plant.state import NAMES, State
from cpjax.pytree import JaxOrNumpy, Number, Scalar, choice, matrix, number, part, pytree

PREDICTIONS = ("midpoint", "runge-kutta")
"""How an estimator integrates the plant over a control period."""


class DerivativeMemory(NamedTuple):
    """Memory of a `FilteredDerivative`."""

    x: Float[Array, ""]
    """Last measured cart position [m]."""
    theta: Float[Array, ""]
    """Last measured angle [rad]."""
    x_dot: Float[Array, ""]
    """Last estimate of its rate [m/s]."""
    theta_dot: Float[Array, ""]
    """Last estimate of its rate [rad/s]."""


@pytree
class FilteredDerivative:
    """Estimator of rates by differences of positions, smoothed by a first-order low-pass filter.

    v_k = a v_(k-1) + (1 - a) (y_k - y_(k-1)) / T with a = exp(-cutoff T) and v_0 = 0; positions are as measured.
    """

    cutoff: Scalar = number("rad/s", "corner frequency of the low-pass filter", above=0.0, infinite=True)
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""

    def at_period(self, period: Scalar) -> "FilteredDerivative":
        """Returns the filter for a control period [s]."""
        return dataclasses.replace(self, period=period)

    def init(self, measurement: Any) -> DerivativeMemory:
        """Returns the memory at the first measurement, with both rates zero."""
        x, theta = jnp.asarray(measurement.x), jnp.asarray(measurement.theta)
        return DerivativeMemory(x, theta, jnp.zeros_like(x), jnp.zeros_like(theta))

    def update(self, memory: DerivativeMemory, measurement: Any, command: Scalar) -> tuple[DerivativeMemory, State]:
        """Returns the new memory and the estimate."""
        period = _known("FilteredDerivative", self.period)
        kept = jnp.exp(-self.cutoff * period)
        x_dot = kept * memory.x_dot + (1.0 - kept) * (measurement.x - memory.x) / period
        theta_dot = kept * memory.theta_dot + (1.0 - kept) * (measurement.theta - memory.theta) / period
        memory = DerivativeMemory(measurement.x, measurement.theta, x_dot, theta_dot)
        return memory, State(measurement.x, x_dot, measurement.theta, theta_dot)


class Estimate(NamedTuple):
    """Memory of an `Observer`."""

    state: State
    """Estimate at the last control instant."""
    started: Float[Array, ""]
    """0 before the first update, then 1."""


@pytree
class Observer:
    """Estimator that predicts by cpjax's own plant and corrects by a constant gain (Luenberger, 1971).

    The estimate is the prediction plus `gain` times the error of the predicted positions. Instead of the gain, four
    poles of the error may be given [1/s]: stable, complex ones in pairs. They are those of the plant linearised
    upright, where the errors of x and of theta each follow an equation of second order of their own, with the first
    pair of poles for x and the second for theta (pairs as in `cpjax.QuadraticFactors.from_poles`).

    The prediction is one step of the plant under the last command, clipped: "midpoint", of second order, with one sine
    and cosine, or "runge-kutta", of fourth, with four.
    """

    model: CartPole = part("plant model of the prediction, a CartPole", "vector_field", "accelerations", "saturate")
    gain: Float[JaxOrNumpy, "*batch 4 2"] | None = matrix(
        (4, 2), "1 and 1/s", "correction per error of (x, theta)", default=None
    )
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""
    poles: PoleFactors | Sequence[complex] | None = None
    """Poles of the error [1/s]; kept as `PoleFactors`."""
    prediction: str = choice("how the plant is integrated over a period", PREDICTIONS, default="midpoint")

    def __post_init__(self) -> None:
        if (self.gain is None) == (self.poles is None):
            raise InputError("Observer.gain", self.gain, "given, or else the poles of the error")
        if self.poles is not None and not isinstance(self.poles, PoleFactors):
            object.__setattr__(self, "poles", PoleFactors.from_poles(self.poles))

    def at_period(self, period: Scalar) -> "Observer":
        """Returns the observer for a control period [s], with the gain that its poles need."""
        if not isinstance(self.poles, PoleFactors):
            return dataclasses.replace(self, period=period)
        gain = observer_gain(self.model, self.poles, period)
        return dataclasses.replace(self, gain=gain, poles=None, period=period)

    def init(self, measurement: Any) -> Estimate:
        """Returns the memory at the first measurement, with both rates zero."""
        return Estimate(_at_rest(measurement), jnp.zeros_like(jnp.asarray(measurement.x)))

    def update(self, memory: Estimate, measurement: Any, command: Scalar) -> tuple[Estimate, State]:
        """Returns the new memory and the estimate."""
        memory = self.correct(self.advance(memory, command), measurement)
        return memory, memory.state

    def advance(self, memory: Estimate, command: Scalar) -> Estimate:
        """Returns the memory a control period on, under a command [V]; before the first measurement as it is."""
        period = _known("Observer", self.period) * memory.started
        return memory._replace(state=_predicted(self.model, self.prediction, memory.state, command, period))

    def correct(self, memory: Estimate, measurement: Any) -> Estimate:
        """Returns the memory after a measurement."""
        before, gain = memory.state, jnp.asarray(self.gain)
        errors = measurement.x - before.x, measurement.theta - before.theta
        numbers = (
            getattr(before, name) + gain[i, 0] * errors[0] + gain[i, 1] * errors[1] for i, name in enumerate(NAMES)
        )
        return Estimate(State(*numbers), jnp.ones_like(memory.started))

    def predict(self, state: State, command: Scalar) -> State:
        """Returns the state after a control period under a command [V]."""
        return _predicted(self.model, self.prediction, state, command, _known("Observer", self.period))


_Covariance: TypeAlias = tuple[jax.Array, ...]
"""Upper triangle of a symmetric 4 x 4 matrix, row by row, in the order of the state."""

_UPPER = [(i, j) for i in range(4) for j in range(i, 4)]
_PLACE = {(i, j): _UPPER.index((min(i, j), max(i, j))) for i in range(4) for j in range(4)}


class Belief(NamedTuple):
    """Memory of a `KalmanFilter` whose gain is not constant."""

    state: State
    """Estimate at the last control instant."""
    covariance: tuple[Float[Array, ""], ...]
    """Covariance of its error: the ten numbers of the upper triangle, row by row."""
    started: Float[Array, ""]
    """0 before the first update, then 1."""


@pytree
class KalmanFilter:
    """Estimator that predicts by cpjax's own plant and corrects by the gain of the least mean squared error.

    The measured positions have independent errors; unknown accelerations of cart and pole, constant over a control
    period, disturb the plant. Three kinds of gain:

    - steady: constant, that of the plant linearised upright after a long time; in the loop an `Observer`.
    - time-varying: that of the same linear plant from a start with unknown rates.
    - extended: from the same start, of the prediction linearised at the estimate, at any angle.
    """

    model: CartPole = part("plant model of the prediction, a CartPole", "vector_field", "accelerations", "saturate")
    x_deviation: Scalar = number("m", "standard deviation of the measured x; of an encoder, step / sqrt(12)", above=0.0)
    theta_deviation: Scalar = number("rad", "standard deviation of the measured theta", above=0.0)
    acceleration_deviation: Scalar = number(
        "m/s^2", "standard deviation of an unknown cart acceleration", default=0.3, above=0.0
    )
    angular_acceleration_deviation: Scalar = number(
        "rad/s^2", "standard deviation of an unknown acceleration of the pole", default=1.0, above=0.0
    )
    x_dot_deviation: Scalar = number(
        "m/s", "standard deviation of the cart's velocity at the start, about 0", default=1.0, above=0.0
    )
    theta_dot_deviation: Scalar = number(
        "rad/s", "standard deviation of the pole's velocity at the start, about 0", default=3.0, above=0.0
    )
    kind: str = choice("how the gain is computed", ("steady", "time-varying", "extended"), default="steady")
    prediction: str = choice("how the plant is integrated over a period", PREDICTIONS, default="midpoint")
    period: Scalar | None = None
    """Control period of the loop [s], set by the rollout."""
    transition: Float[JaxOrNumpy, "*batch 4 4"] | None = None
    """State matrix of the plant linearised upright, over a control period, set by the rollout."""

    def at_period(self, period: Scalar) -> "KalmanFilter | Observer":
        """Returns the filter for a control period [s]; a steady one as an `Observer`."""
        if self.kind == "steady":
            return Observer(self.model, self.steady_gain(period), period, prediction=self.prediction)
        transition = None if self.kind == "extended" else discretize(*linearize(self.model), period).A
        return dataclasses.replace(self, period=period, transition=transition)

    def steady_gain(self, period: Scalar) -> Float[Array, "4 2"]:
        """Returns the gain after a long time, of the plant linearised upright, for a control period [s]."""
        A, _ = discretize(*linearize(self.model), period)
        T, none = jnp.asarray(period, A.dtype), jnp.zeros((), A.dtype)
        G = jnp.stack([0.5 * T * T, none, T, none, none, 0.5 * T * T, none, T]).reshape(4, 2)
        C = jnp.asarray([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]], A.dtype)
        QN = _diagonal(A.dtype, self.acceleration_deviation, self.angular_acceleration_deviation)
        RN = _diagonal(A.dtype, self.x_deviation, self.theta_deviation)
        return dlqe(A, G, C, QN, RN).filter

    def init(self, measurement: Any) -> Belief:
        """Returns the memory at the first measurement, with both rates zero and unknown."""
        x = jnp.asarray(measurement.x)
        deviations = self.x_deviation, self.x_dot_deviation, self.theta_deviation, self.theta_dot_deviation
        numbers = [jnp.asarray(deviations[i] ** 2 if i == j else 0.0, x.dtype) for i, j in _UPPER]
        return Belief(_at_rest(measurement), tuple(numbers), jnp.zeros_like(x))

    def update(self, memory: Belief, measurement: Any, command: Scalar) -> tuple[Belief, State]:
        """Returns the new memory and the estimate."""
        memory = self.correct(self.advance(memory, command), measurement)
        return memory, memory.state

    def advance(self, memory: Belief, command: Scalar) -> Belief:
        """Returns the memory a control period on, under a command [V]; before the first measurement as it is."""
        T = _known("KalmanFilter", self.period) * memory.started
        P = _propagated(self._transition(memory, command, T), memory.covariance)
        for at, deviation in ((0, self.acceleration_deviation), (2, self.angular_acceleration_deviation)):
            P = _disturbed(P, at, deviation * deviation * T * T, T)
        return memory._replace(state=self._predicted(memory.state, command, T), covariance=P)

    def correct(self, memory: Belief, measurement: Any) -> Belief:
        """Returns the memory after a measurement; the first one is in the memory already."""
        values, P = [getattr(memory.state, name) for name in NAMES], memory.covariance
        for at, measured, deviation in (
            (0, measurement.x, self.x_deviation),
            (2, measurement.theta, self.theta_deviation),
        ):
            values, P = _corrected(values, P, at, measured, deviation * deviation)
        found, before = (State(*values), P), (memory.state, memory.covariance)
        state, P = jax.tree.map(lambda new, old: where(memory.started > 0.0, new, old), found, before)
        return Belief(state, P, jnp.ones_like(memory.started))

    def predict(self, state: State, command: Scalar) -> State:
        """Returns the state after a control period under a command [V]."""
        return self._predicted(state, command, _known("KalmanFilter", self.period))

    def _predicted(self, state: State, command: Scalar, T: Scalar) -> State:
        return _predicted(self.model, self.prediction, state, command, T)

    def _transition(self, memory: Belief, command: Scalar, T: Scalar) -> list[list[Any]]:
        """Returns the derivative of the prediction by the state: rows of four."""
        if self.kind != "extended":
            A, on = jnp.asarray(self.transition), memory.started
            return [[on * A[i, j] + (1.0 - on if i == j else 0.0) for j in range(4)] for i in range(4)]

        def column(name: str) -> State:
            def along(one: Scalar) -> State:
                return self._predicted(dataclasses.replace(memory.state, **{name: one}), command, T)

            value = jnp.asarray(getattr(memory.state, name))
            return jax.jvp(along, (value,), (jnp.ones_like(value),))[1]

        columns = [column(name) for name in NAMES]
        return [[getattr(one, name) for one in columns] for name in NAMES]


def kalman_observer(
    model: CartPole,
    *,
    period: float,
    x_deviation: float,
    theta_deviation: float,
    acceleration_deviation: float = 0.3,
    angular_acceleration_deviation: float = 1.0,
) -> Observer:
    """Designs an `Observer` whose gain is that of a steady Kalman filter upright.

    A `KalmanFilter` of the steady kind has the same gain, and computes it where it is used.

    Args:
      model: plant model of the prediction.
      period: control period [s].
      x_deviation: standard deviation of the measured x [m]; of an encoder, step / sqrt(12).
      theta_deviation: standard deviation of the measured theta [rad].
      acceleration_deviation: standard deviation of an unknown cart acceleration, constant over a period [m/s^2].
      angular_acceleration_deviation: the same for the pole [rad/s^2].

    Raises:
      InputError: a period or deviation that is not above 0.
    """
    Number("s", "control period", above=0.0).normalise("period", period)
    steady = KalmanFilter(model, x_deviation, theta_deviation, acceleration_deviation, angular_acceleration_deviation)
    return Observer(model, np.asarray(steady.steady_gain(period)))


def observer_gain(model: CartPole, poles: PoleFactors, period: Scalar) -> Float[Array, "4 2"]:
    """Returns the gain with which an observer's error has these poles [1/s], upright; differentiable.

    With y = (x, theta), v their rates, and the error's matrix over a period in blocks [[F_y, A_yv], [F_v, A_vv]], whose
    left blocks the gain sets freely, an eigenvalue z and the part y of its eigenvector satisfy

        (z^2 - z (W + F_y) + W F_y - A_yv F_v) y = 0    with W = A_yv A_vv A_yv^-1

    which is diagonal, z^2 - (sum of a pair) z + (product of a pair), for one choice of F_y and F_v.

    Args:
      model: plant model.
      poles: of x first, then of theta.
      period: control period [s].
    """
    A, _ = discretize(*linearize(model), period)
    a, b = (jnp.asarray(part, A.dtype) for part in (poles.a, poles.b))
    zero = jnp.zeros((2, 2), A.dtype)
    pairs = [jnp.asarray([[0.0, 1.0], [0.0, 0.0]], A.dtype).at[1].set(jnp.stack([-b[i], -a[i]])) for i in range(2)]
    E, _ = discretize(jnp.block([[pairs[0], zero], [zero, pairs[1]]]), jnp.zeros((4, 1), A.dtype), period)
    sums, products = jnp.stack([E[0, 0] + E[1, 1], E[2, 2] + E[3, 3]]), jnp.exp(-a * period)
    y, v = np.array([0, 2]), np.array([1, 3])
    A_yv = A[y][:, v]
    W = A_yv @ A[v][:, v] @ jnp.linalg.inv(A_yv)
    F_y = jnp.diag(sums) - W
    F_v = jnp.linalg.solve(A_yv, W @ F_y - jnp.diag(products))
    L = jnp.zeros((4, 2), A.dtype).at[y].set(A[y][:, y] - F_y).at[v].set(A[v][:, y] - F_v)
    return jnp.linalg.solve(A, L)


def _known(owner: str, period: Scalar | None) -> Scalar:
    if period is None:
        raise InputError(f"{owner}.period", None, "known: use the estimator in a rollout, or at_period(...)")
    return period


def _at_rest(measurement: Any) -> State:
    x, theta = jnp.asarray(measurement.x), jnp.asarray(measurement.theta)
    return State(x, jnp.zeros_like(x), theta, jnp.zeros_like(theta))


def _diagonal(dtype: Any, *deviations: Scalar) -> jax.Array:
    return jnp.diag(jnp.stack([jnp.asarray(one, dtype) ** 2 for one in deviations]))


def _accelerations(model: CartPole, geometry: Any, v: Any, voltage: Scalar) -> Any:
    return model.accelerations(geometry, v, voltage)


def _predicted(model: CartPole, prediction: str, state: State, command: Scalar, T: Scalar) -> State:
    """Returns the state after a time T [s] under a command [V], which the drive clips."""
    voltage = model.saturate(command)

    def moved(tree: Any, rates: Any, time: Scalar) -> Any:
        return jax.tree.map(lambda value, rate: value + time * rate, tree, rates)

    if prediction == "runge-kutta":
        k1 = model.vector_field(state, voltage)
        k2 = model.vector_field(moved(state, k1, 0.5 * T), voltage)
        k3 = model.vector_field(moved(state, k2, 0.5 * T), voltage)
        k4 = model.vector_field(moved(state, k3, T), voltage)
        slope = jax.tree.map(lambda a, b, c, d: (a + 2.0 * b + 2.0 * c + d) / 6.0, k1, k2, k3, k4)
        return moved(state, slope, T)
    # Both accelerations are at the positions half a period on: one sine and cosine, and one division.
    q, v = model.coordinates(state)
    geometry = model.geometry(moved(q, v, 0.5 * T))
    first = outline(_accelerations)(model, geometry, v, voltage)
    second = outline(_accelerations)(model, geometry, moved(v, first, 0.5 * T), voltage)
    after = moved(v, second, T)
    return model.state(moved(moved(q, v, 0.5 * T), after, 0.5 * T), after)


def _propagated(A: list[list[Any]], P: _Covariance) -> _Covariance:
    """Returns A P A'."""
    AP = [[sum(A[i][k] * P[_PLACE[k, j]] for k in range(4)) for j in range(4)] for i in range(4)]
    return tuple(sum(AP[i][k] * A[j][k] for k in range(4)) for i, j in _UPPER)


def _disturbed(P: _Covariance, at: int, growth: Any, T: Any) -> _Covariance:
    """Returns the covariance with that of an unknown acceleration added; `growth` is of the rate, at `at` + 1."""
    added = {(at, at): 0.25 * T * T * growth, (at, at + 1): 0.5 * T * growth, (at + 1, at + 1): growth}
    return tuple(p + added[place] if place in added else p for p, place in zip(P, _UPPER, strict=True))


def _corrected(values: list[Any], P: _Covariance, at: int, measured: Any, noise: Any) -> tuple[list[Any], _Covariance]:
    """Returns estimate and covariance after a measurement of the number `at` with noise of this variance.

    Errors of the two positions are independent, so that they are taken one after the other, without a matrix to invert.
    """
    column = [P[_PLACE[i, at]] for i in range(4)]
    inverse = 1.0 / (column[at] + noise)
    share = (measured - values[at]) * inverse
    kept = noise * inverse  # 1 - gain of the measured number itself, without its cancellation
    # The measured row from `kept`: there the difference would lose the digits, or the sign.
    less = [
        kept * p if at in place else p - column[place[0]] * column[place[1]] * inverse
        for p, place in zip(P, _UPPER, strict=True)
    ]
    return [value + p * share for value, p in zip(values, column, strict=True)], tuple(less)
