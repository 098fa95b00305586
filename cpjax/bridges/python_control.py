"""Conversion of plant, closed loop and gain to objects of python-control, and of its gains to laws.

Signals have cpjax's names and units: states x, x_dot, theta, theta_dot, input voltage. The equations of motion are
`CartPole.acceleration`, evaluated in Python floats: python-control's simulations take one state at a time, for which
that costs a fraction of a call into JAX. Linear models, laws and gates are computed by JAX, in its default dtype: turn
on float64.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeAlias

import control
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Real

from cpjax.bridges.known import UNTRACEABLE, concrete_plant, require_concrete, unexpressed
from cpjax.controllers.feedback import StateFeedback
from cpjax.controllers.hybrid import Hybrid
from cpjax.controllers.protocol import Law, ModalController, SingleLaw, as_controller
from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor, linearize
from cpjax.plant.state import NAMES, State
from cpjax.pytree import Number, cast, is_traced
from cpjax.sim.integrators import rk4
from cpjax.sim.settings import check_settings
from cpjax.sim.stepper import applied_voltage, step_held

Vector: TypeAlias = Float[np.ndarray, " states"]
"""State of a system of python-control."""

Gain: TypeAlias = Real[ArrayLike, "1 4"] | Real[ArrayLike, "4"] | control.StateSpace
"""A gain that python-control computed, or its static system."""

MEASURED = ("x", "theta")
"""The paper's measurements, cart position and angle: `outputs` of `state_space` for the design of an observer."""

_PERIOD = Number("s", "control period", above=0.0)


def state_space(
    plant: CartPole,
    equilibrium: Literal["upright", "hanging"] | State = "upright",
    outputs: Sequence[str] = NAMES,
) -> control.StateSpace:
    """Returns the model of `cpjax.linearize` as a continuous-time `control.StateSpace` with the voltage [V] as input.

    Args:
      plant: a plant with concrete numbers.
      equilibrium: as for `cpjax.linearize`; the states are deviations from it.
      outputs: names of the states that are outputs, in order; `MEASURED` are the paper's.

    Raises:
      InputError: as for `cpjax.linearize`; a plant or equilibrium that JAX is tracing; an output that is not a state,
        or is named twice.
    """
    model = linearize(concrete_plant(plant), equilibrium)
    if is_traced(model.A):
        raise InputError("equilibrium", equilibrium, f"known; {UNTRACEABLE}")
    A, B = (np.asarray(M, dtype=np.float64) for M in model)
    chosen = [outputs] if isinstance(outputs, str) else outputs
    known = isinstance(chosen, (list, tuple)) and len(chosen) > 0 and all(name in NAMES for name in chosen)
    if not known or len(set(chosen)) < len(chosen):
        raise InputError("outputs", outputs, "different names out of " + ", ".join(NAMES))
    C = np.eye(4)[[NAMES.index(name) for name in chosen]]
    D = np.zeros((len(chosen), 1))
    return control.StateSpace(A, B, C, D, states=list(NAMES), inputs=["voltage"], outputs=list(chosen))


def plant_system(plant: CartPole) -> control.NonlinearIOSystem:
    """Returns the plant as a system with input voltage [V], outputs and states x, x_dot, theta, theta_dot.

    The motor clips the voltage, as everywhere in cpjax; python-control reports the demanded one.

    Args:
      plant: a plant with concrete numbers.

    Raises:
      InputError: `plant` is not a CartPole with concrete numbers.
    """
    plant = concrete_plant(plant)
    saturate = _saturation(plant.motor)

    def update(
        t: float, state: Vector, inputs: Float[np.ndarray, " inputs"], params: Any
    ) -> tuple[float, float, float, float]:
        return _derivative(plant, state, saturate(float(inputs[0])))

    return control.NonlinearIOSystem(
        update, None, states=list(NAMES), inputs=["voltage"], outputs=list(NAMES), name="cart_pole"
    )


def closed_loop_system(
    plant: CartPole, controller: ModalController | Law, control_period: float | None = None, *, dt: float | None = None
) -> control.NonlinearIOSystem:
    """Returns plant and controller as one system without inputs; outputs are the four states, applied voltage and mode.

    Without a control period the plant and the controller are continuous in time; the mode changes at the boundary
    itself, not at the end of a step as in `cpjax.rollout`. The states are the plant's four.

    With a control period the system is discrete, the sampled clock of `cpjax.rollout`: one update is one period, of
    `control_period / dt` steps of the classical Runge-Kutta method under a held voltage. The states are the plant's
    four and `mode`, the mode until now, whose initial value is `controller.start_mode`, or 0 for a law or a
    `cpjax.Hybrid`. A run that a rollout would flag and stop is not stopped.

    Args:
      plant: a plant with concrete numbers.
      controller: a law, or a controller whose only memory is its mode.
      control_period: [s]; None for continuous time.
      dt: the integrator's step [s], a whole fraction of `control_period`; by default all of it.

    Raises:
      InputError: an argument outside its range; or, without a control period, a `controller` that may remember its
        mode: laws do not, nor does a `cpjax.Hybrid` whose gate has hysteresis 0.
    """
    plant, controller = concrete_plant(plant), as_controller(controller)
    if not isinstance(controller, ModalController):
        raise InputError("controller", controller, "a law, or a controller whose only memory is its mode")
    require_concrete("controller", controller)
    if control_period is not None:
        return _sampled_loop(plant, controller, control_period, dt)
    if dt is not None:
        raise InputError("dt", dt, "absent unless there is a control period")
    if _may_remember(controller):
        allowed = (
            "a law, or a cpjax.Hybrid whose gate has hysteresis 0; one that remembers its mode needs a control_period"
        )
        raise InputError("controller", controller, allowed)
    return _continuous_loop(plant, controller)


def gain_array(law: StateFeedback) -> Float[np.ndarray, "1 4"]:
    """Returns K of u = -K s as python-control writes it [V per unit of state].

    The law takes the angle modulo a turn, which a gain cannot: the two agree within half a turn of upright.

    Args:
      law: a law with concrete numbers whose reference is the origin.

    Raises:
      InputError: `law` is not a StateFeedback with concrete numbers, or its reference is not the origin:
        -K (s - s_ref) is then affine, which no gain represents.
    """
    if not isinstance(law, StateFeedback):
        raise InputError("law", law, "a cpjax.StateFeedback")
    require_concrete("law", law)
    reference = [float(getattr(law.reference, name)) for name in NAMES]
    if any(reference):
        raise InputError("law.reference", law.reference, "the origin; no gain represents another")
    return np.array(law.K, dtype=np.float64)


def feedback_system(law: StateFeedback) -> control.StateSpace:
    """Returns the law as a static system from states to voltage, D = -K; arguments and errors as for `gain_array`."""
    return control.StateSpace([], [], [], -gain_array(law), inputs=list(NAMES), outputs=["voltage"])


def state_feedback(gain: Gain) -> StateFeedback:
    """Returns the law u = -K s of a gain that python-control computed.

    Args:
      gain: K (1, 4) or (4,) [V per unit of state], such as the first result of `control.lqr` or the result of
        `control.place`; or a static `control.StateSpace` from the four states to one voltage, D = -K, whose inputs
        may be in any order if they have the states' names.

    Raises:
      InputError: another type or shape, or a gain that is not finite.
    """
    if isinstance(gain, control.StateSpace):
        if gain.nstates or gain.D.shape != (1, 4):
            raise InputError("gain", gain, "static, from four states to one voltage")
        named = set(gain.input_labels) == set(NAMES)
        return StateFeedback(-np.asarray(gain.D)[:, [gain.input_labels.index(n) for n in NAMES] if named else range(4)])
    allowed = "an array of shape (1, 4) of known real numbers [V per unit of state]"
    try:
        K = np.asarray(gain)
    except (TypeError, ValueError) as problem:  # traced, or uneven, such as the whole result of control.lqr
        raise InputError("gain", gain, allowed) from problem
    if K.shape not in ((1, 4), (4,)) or K.dtype.kind not in "fiu":
        raise InputError("gain", gain, allowed)
    return StateFeedback(K.astype(np.float64))


def _derivative(plant: CartPole, state: Vector, voltage: float) -> tuple[float, float, float, float]:
    """Computes `vector_field` of any plant of Python floats under the applied voltage [V], as Python floats."""
    _, x_dot, theta, theta_dot = state.tolist()
    # A plant or motor that uses JAX's functions returns arrays; without float64 they would be float32.
    with jax.enable_x64(True):
        force = float(plant.motor.force(voltage, x_dot))
        x_ddot, theta_ddot = plant.acceleration(math.sin(theta), math.cos(theta), (x_dot, theta_dot), force)
        return x_dot, float(x_ddot), theta_dot, float(theta_ddot)


def _saturation(motor: Motor) -> Callable[[float], float]:
    """Returns `motor.saturate` for Python floats, for cpjax's own motor without a call into JAX; NaN stays NaN."""
    if type(motor) is not Motor or unexpressed(motor):

        def saturate(voltage: float) -> float:
            with jax.enable_x64(True):
                return float(motor.saturate(voltage))

        return saturate
    limit = float(motor.voltage_limit)
    return lambda voltage: max(min(voltage, limit), -limit)


def _continuous_loop(plant: CartPole, controller: ModalController) -> control.NonlinearIOSystem:
    dtype = jnp.result_type(float)
    arrays, controller = cast((plant, controller), dtype)

    @jax.jit
    def act(vector: Float[Array, " states"]) -> Float[Array, "2"]:
        state = State.from_vector(vector.astype(dtype))
        mode = controller.start_mode(state)
        return jnp.stack([applied_voltage(arrays, controller, state, mode), mode.astype(dtype)])

    def update(
        t: float, state: Vector, inputs: Float[np.ndarray, " inputs"], params: Any
    ) -> tuple[float, float, float, float]:
        return _derivative(plant, state, np.asarray(act(state))[0].item())

    return _loop_system(update, act, NAMES, 0)


def _sampled_loop(plant: CartPole, controller: ModalController, period: Any, dt: Any) -> control.NonlinearIOSystem:
    if is_traced(period) or np.ndim(period):
        raise InputError("control_period", period, _PERIOD.allowed())
    period = float(_PERIOD.normalise("control_period", period))
    dt = period if dt is None else dt
    steps = check_settings(duration=dt, dt=dt, control_period=period).steps_per_control
    dtype = jnp.result_type(float)
    plant, controller, step = cast((plant, controller, float(dt)), dtype)

    def observe(vector: Float[Array, "5"]) -> tuple[State, Float[Array, ""], Float[Array, ""]]:
        state = State.from_vector(vector[:4].astype(dtype))
        mode = controller.next_mode(state, vector[4].astype(jnp.int32))
        return state, applied_voltage(plant, controller, state, mode), mode.astype(dtype)

    @jax.jit
    def act(vector: Float[Array, " states"]) -> Float[Array, "2"]:
        return jnp.stack(observe(vector)[1:])

    @jax.jit
    def advance(vector: Float[Array, "5"]) -> Float[Array, "5"]:
        state, voltage, mode = observe(vector)
        state = lax.fori_loop(0, steps, lambda _, state: step_held(plant, rk4, state, voltage, step), state)
        return jnp.append(state.vector(), mode)

    def update(t: float, state: Vector, inputs: Float[np.ndarray, " inputs"], params: Any) -> Vector:
        return np.asarray(advance(state))

    return _loop_system(update, act, (*NAMES, "mode"), period)


def _loop_system(
    update: Callable[..., Any], act: Callable[[Vector], Float[Array, "2"]], states: Sequence[str], dt: float
) -> control.NonlinearIOSystem:
    """Builds the closed-loop system; `act` returns the applied voltage and the mode at a system's state."""

    def output(t: float, state: Vector, inputs: Float[np.ndarray, " inputs"], params: Any) -> Float[np.ndarray, "6"]:
        return np.concatenate([state[:4], act(state)])

    outputs = [*NAMES, "voltage", "mode"]
    return control.NonlinearIOSystem(
        update, output, states=list(states), inputs=[], outputs=outputs, dt=dt, name="closed_loop"
    )


def _may_remember(controller: ModalController) -> bool:
    """Returns whether `next_mode` may depend on the mode until now: unless a law, or a Hybrid with hysteresis 0."""
    if isinstance(controller, SingleLaw):
        return False
    hysteresis = getattr(controller.gate, "hysteresis", None) if isinstance(controller, Hybrid) else None
    return hysteresis is None or float(hysteresis) != 0.0
