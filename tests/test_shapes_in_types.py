"""Shapes and dtypes in public signatures, held against calls: jaxtyping and beartype check them in another process.

This file is also that process: with the name of a package it checks the package's types while everything public in it
is called, traced by `jit` and `vmap` where JAX can.
"""

import contextlib
import functools
import importlib
import inspect
import os
import pkgutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

PACKAGES = ("linear", "numeric", "plant", "controllers")


def public_things():
    """Dotted names, below cpjax, of all public functions, methods and properties that have an implementation."""
    for package in PACKAGES:
        for info in pkgutil.iter_modules(importlib.import_module(f"cpjax.{package}").__path__):
            if info.name.startswith("_"):
                continue
            module = importlib.import_module(f"cpjax.{package}.{info.name}")
            for name, thing in vars(module).items():
                if name.startswith("_") or getattr(thing, "__module__", None) != module.__name__:
                    continue
                if getattr(thing, "__name__", name) != name:  # an old name of another thing
                    continue
                if not inspect.isclass(thing):
                    yield from [f"{package}.{info.name}.{name}"] if callable(thing) else []
                elif not getattr(thing, "_is_protocol", False):
                    own = [c for c in reversed(thing.__mro__) if c is thing or c.__name__.startswith("_")]
                    members = {member: value for one in own for member, value in vars(one).items()}
                    for member, value in members.items():
                        if not member.startswith("_") and isinstance(
                            value, (type(public_things), property, classmethod)
                        ):
                            yield f"{package}.{info.name}.{name}.{member}"


def call(*arguments, **options):
    return arguments, options


def reference_file():
    path = Path(tempfile.mkdtemp()) / "reference.csv"
    path.write_text("time,x\n0.0,0.1\n")
    return path


def calls():
    """Valid arguments by dotted name; a method's first one is its object, if any."""
    import jax.numpy as jnp
    import numpy as np

    from cpjax import controllers as c
    from cpjax.controllers.signal import SignalMemory
    from cpjax.linear.placement import QuadraticFactors
    from cpjax.linear.structure import Structure
    from cpjax.numeric.double_word import DoubleWord
    from cpjax.plant import AccelerationActuator, CartPole, ForceActuator, LumpedMotor, Motor, State
    from cpjax.plant.contact import ContactMode, in_contact
    from cpjax.rig import Disturbance, Rig, Wind

    # Five states and two inputs, so that no two axes of a matrix are equally long by chance.
    A = jnp.diag(-jnp.arange(1.0, 6.0)) + jnp.diag(jnp.full(4, 0.3), 1)
    B, Q, R, N = jnp.ones((5, 2)).at[1, 0].set(3.0), jnp.eye(5), jnp.eye(2), jnp.zeros((5, 2))
    C, K, b, k = jnp.ones((3, 5)), jnp.full((2, 5), 0.1), jnp.ones(5), jnp.full((1, 5), 0.1)
    P, gain, one = jnp.eye(4), jnp.ones((1, 4)), jnp.asarray(1.0)
    poles, factors = jnp.asarray([-1.0, -2.0, -3.0, -4.0, -5.0]), QuadraticFactors(b[:2], b[:2], b[:1])
    batch, right = jnp.stack([A, A], axis=-1), jnp.ones((5, 3, 2))
    wide, word = DoubleWord(batch, 0.0 * batch), DoubleWord(b, 0.0 * b)
    plant, motor, state = CartPole(), Motor(), State(0.1, 0.2, 0.3, 0.4)
    mode, period = jnp.asarray(0, dtype=jnp.int32), 0.01
    touching, contact = (
        in_contact(CartPole(coulomb_friction=1.0, pivot_coulomb_friction=0.1), 0.4),
        ContactMode(mode, mode),
    )
    weights, pair = c.LqrWeights(np.eye(4), 1.0), c.PoleFactors(np.ones(2), np.ones(2))
    law, swing_up = c.StateFeedback(np.ones((1, 4)), design=weights), c.EnergySwingUp(plant, 2.0)
    gate = c.AngleGate(0.3)
    hybrid = c.Hybrid(swing_up, law, gate)
    memory, single, sampled = c.ModeMemory(mode), c.SingleLaw(law), c.Sampled(hybrid)
    signal = c.VoltageSignal(np.arange(3.0), np.ones(3), period)
    words, seen = jnp.arange(3, dtype=jnp.uint32), State(one, one, one, one)
    lumped, actuator, servo = LumpedMotor(2.0), ForceActuator(), AccelerationActuator()
    filtered, observer = c.FilteredDerivative(10.0, period), c.Observer(plant, np.ones((4, 2)), period)
    kinds = ("time-varying", "extended")
    filters = {kind: c.KalmanFilter(plant, 1e-4, 1e-3, kind=kind, period=period) for kind in kinds}
    digital = c.Digital(law, filtered)
    integral, following = c.IntegralAction(law, 1.0, period=period), c.MovingReference(law, signal)
    pushed = Rig(CartPole(coulomb_friction=1.0), disturbance=Disturbance(wind=Wind(1.0)))
    moving = pushed.moving(np.uint32(0), np.uint32(0))
    square = {"function": lambda h: (np.array([h, h * h]), np.array([-h, h * h])), "steps": np.array([0.4, 0.2, 0.1])}
    costs = np.array([[1.0, 3.0], [2.0, 2.0], [3.0, 3.0]])
    return {
        "linear.arguments.matrices": call(A=A, B=B),
        "linear.arguments.square": call("A", A),
        "linear.arguments.shaped": call("B", B, (5, 2)),
        "linear.arguments.columns": call("B", b, 5),
        "linear.arguments.rows": call("C", C, 5),
        "linear.arguments.gain_matrix": call("K", K, 2, 5),
        "linear.arguments.input_weight": call("R", R, 2),
        "linear.arguments.column": call("B", b, 5),
        "linear.discretization.discretize": call(A, B, period),
        "linear.discretization.discretize_cost": call(A, b, Q, one, period),
        "linear.estimation.dlqe": call(0.1 * A, B, C, R, jnp.eye(3)),
        "linear.limits.demanded_voltage": call(gain, jnp.ones(3)),
        "linear.limits.saturation_angle": call(gain[0], 12.0),
        "linear.limits.lyapunov_function": call(A, B, K, Q),
        "linear.limits.level_within_voltage": call(Q, k, 12.0),
        "linear.limits.level_within_angle": call(P, 0.3),
        "linear.limits.level_within_angle_and_rate": call(P, 0.3, one),
        "linear.limits.level_within_form": call(Q, Q, one),
        "linear.lqr.lqr": call(A, B, Q, R),
        "linear.lqr.dlqr": call(0.1 * A, B, Q, R),
        "linear.lyapunov.lyapunov": call(A, Q),
        "linear.lyapunov.stein": call(0.1 * A, Q),
        "linear.lyapunov.lyapunov_equation": call(A, Q),
        "linear.lyapunov.stein_equation": call(0.1 * A, Q),
        "linear.lyapunov.sum_continuous": call(batch, batch),
        "linear.lyapunov.sum_discrete": call(0.1 * batch, batch),
        "linear.lyapunov.cayley_shift": call(batch),
        "linear.margins.closed_loop_poles": call(A, B, K),
        "linear.margins.characteristic_polynomial": call(A),
        "linear.margins.loop_polynomials": call(A, b, k),
        "linear.margins.stability_margins": call(A, b[:, None], k[0]),
        "linear.placement.place": call(A, b, poles),
        "linear.placement.place_polynomial": call(A, b, b),
        "linear.placement.polynomial_from_poles": call(poles),
        "linear.placement.QuadraticFactors.from_poles": call(QuadraticFactors, poles),
        "linear.placement.QuadraticFactors.from_unconstrained": call(QuadraticFactors, b),
        "linear.placement.QuadraticFactors.unconstrained": call(factors),
        "linear.placement.QuadraticFactors.polynomial": call(factors),
        "linear.placement.QuadraticFactors.poles": call(factors),
        "linear.riccati.care": call(A, B, Q, R, N),
        "linear.riccati.dare": call(0.1 * A, B, Q, R),
        "linear.riccati.solve_care": call(A, B, Q, R, N),
        "linear.riccati.solve_dare": call(0.1 * A, B, Q, R, N),
        "linear.several_inputs.robust_gain": call(A, B, poles),
        "linear.several_inputs.pole_directions": call(A, B, poles),
        "linear.several_inputs.gain_by_directions": call(A, B, 2.0 * poles, jnp.ones((2, 5))),
        "linear.structure.Structure.full": call(Structure(A, mode, b, one)),
        "linear.structure.controllability_matrix": call(A, B),
        "linear.structure.observability_matrix": call(A, C),
        "linear.structure.controllability": call(A, b),
        "linear.structure.observability": call(A, C),
        "linear.structure.controllability_gramian": call(A, B),
        "linear.structure.observability_gramian": call(A, C, one),
        "numeric.angles.wrap_angle": call(jnp.ones((2, 3))),
        "numeric.differences.central_differences": call(**square),
        "numeric.double_word.double_word": call(b),
        "numeric.double_word.two_sum": call(b, b),
        "numeric.double_word.two_product": call(b, b),
        "numeric.double_word.add": call(word, word),
        "numeric.double_word.negative": call(word),
        "numeric.double_word.multiply": call(word, word),
        "numeric.double_word.divide": call(word, word),
        "numeric.noise.random_bits": call((words, words), (words, words)),
        "numeric.noise.standard_normals": call((words, words), (words, words), np.dtype(float)),
        "numeric.pareto.nondominated": call(costs),
        "numeric.pareto.hypervolume": call(costs, np.array([4.0, 4.0])),
        "numeric.quantisation.quantize": call(jnp.ones((2, 3)), 0.1, derivative="straight_through"),
        "numeric.roots.crossing_fraction": call(one, -one, -one, -one),
        "numeric.roots.newton_correction": call(one, -one, one),
        "numeric.selection.where": call(jnp.asarray([True, False]), jnp.ones(2), 0),
        "numeric.small_matrices.transpose": call(wide),
        "numeric.small_matrices.identity_like": call(batch),
        "numeric.small_matrices.symmetric": call(batch),
        "numeric.small_matrices.diagonal": call(batch),
        "numeric.small_matrices.largest": call(right),
        "numeric.small_matrices.product": call(batch, right),
        "numeric.small_matrices.solve": call(batch, right),
        "numeric.small_matrices.inverse": call(batch),
        "numeric.small_matrices.log_abs_determinant": call(batch),
        "numeric.small_matrices.is_positive_definite": call(batch),
        "numeric.small_matrices.accurate_product": call(wide, wide),
        "numeric.small_matrices.accurate_solve": call(wide, wide),
        "numeric.small_matrices.batch_last": call(jnp.negative),
        "numeric.small_matrices.linear_solve": call(A, B),
        "numeric.statistics.wilson_interval": call(3, 4),
        "numeric.statistics.two_proportion_p_value": call(3, 4, 2, 4),
        "numeric.statistics.mcnemar_p_value": call(3, 4),
        "numeric.transforms.positive": call(b),
        "numeric.transforms.from_positive": call(b),
        "numeric.transforms.semidefinite": call(jnp.ones(6)),
        "numeric.transforms.from_semidefinite": call(Q),
        "plant.cartpole.CartPole.rod": call(CartPole, mass=0.3, length=1.0),
        "plant.cartpole.CartPole.limits": call(plant),
        "plant.cartpole.CartPole.units": call(plant),
        "plant.cartpole.CartPole.input_limit": call(plant),
        "plant.cartpole.CartPole.coordinates": call(plant, state),
        "plant.cartpole.CartPole.state": call(plant, (0.1, 0.2), (0.3, 0.4)),
        "plant.cartpole.CartPole.saturate": call(plant, 20.0),
        "plant.cartpole.CartPole.geometry": call(plant, (0.1, 0.2)),
        "plant.cartpole.CartPole.geometry_near": call(plant, (0.6, 0.8), (0.01, 0.01)),
        "plant.cartpole.CartPole.accelerations": call(plant, (0.6, 0.8), (0.1, 0.2), 1.0),
        "plant.cartpole.CartPole.loads": call(plant, (0.6, 0.8), (0.1, 0.2), 1.0),
        "plant.cartpole.CartPole.outputs": call(plant, state, (0.1, 0.2), 1.0),
        "plant.cartpole.CartPole.moving_mass": call(plant),
        "plant.cartpole.CartPole.pivot_inertia": call(plant),
        "plant.cartpole.CartPole.natural_frequency": call(plant),
        "plant.cartpole.CartPole.acceleration": call(plant, 0.6, 0.8, (0.1, 0.2), 1.0),
        "plant.cartpole.CartPole.solved": call(plant, 0.6, 0.8, 0.1, 0.2),
        "plant.cartpole.CartPole.vector_field": call(plant, state, 1.0),
        "plant.contact.in_contact": call(plant, 0.4, 0.5),
        "plant.contact.InContact.limits": call(touching),
        "plant.contact.InContact.start_limits": call(touching),
        "plant.contact.InContact.input_limit": call(touching),
        "plant.contact.InContact.units": call(touching),
        "plant.contact.InContact.coordinates": call(touching, state),
        "plant.contact.InContact.state": call(touching, (0.1, 0.2), (0.3, 0.4)),
        "plant.contact.InContact.saturate": call(touching, 20.0),
        "plant.contact.InContact.geometry": call(touching, (0.1, 0.2)),
        "plant.contact.InContact.geometry_near": call(touching, (0.6, 0.8), (0.01, 0.01)),
        "plant.contact.InContact.accelerations": call(touching, (0.6, 0.8), (0.1, 0.2), 1.0, contact),
        "plant.contact.InContact.outputs": call(touching, state, (0.1, 0.2), 1.0),
        "plant.contact.InContact.start_mode": call(touching, (0.1, 0.2), (0.3, 0.4)),
        "plant.contact.InContact.guards": call(touching, (0.1, 0.2), (0.3, 0.4), 1.0, contact),
        "plant.contact.InContact.jump": call(touching, (0.1, 0.2), (0.3, 0.4), contact, jnp.asarray(0, jnp.int32)),
        "plant.contact.InContact.during": call(moving, moving.start_drive(state), mode, 0.01, state, 1.0),
        "controllers.tracking.IntegralAction.designed": call(
            c.IntegralAction, hybrid, plant, np.eye(4), 1.0, integral_weight=1.0
        ),
        "controllers.tracking.IntegralAction.at_period": call(integral, period),
        "controllers.tracking.IntegralAction.init": call(integral, seen),
        "controllers.tracking.IntegralAction.update": call(integral, integral.init(seen), seen),
        "controllers.tracking.MovingReference.steps": call(c.MovingReference, law, np.arange(3.0), np.ones(3)),
        "controllers.tracking.MovingReference.square_wave": call(
            c.MovingReference, law, amplitude=0.1, period=1.0, duration=2.0
        ),
        "controllers.tracking.MovingReference.from_file": call(c.MovingReference, law, reference_file()),
        "controllers.tracking.MovingReference.init": call(following, seen),
        "controllers.tracking.MovingReference.update": call(following, following.init(seen), seen),
        "plant.contact.InContact.release": call(touching, (0.1, 0.2), (0.3, 0.4), 1.0, contact),
        "plant.cartpole.CartPole.force_for_acceleration": call(plant, state, 1.0),
        "plant.cartpole.CartPole.kinetic_energy": call(plant, state),
        "plant.cartpole.CartPole.potential_energy": call(plant, state),
        "plant.cartpole.CartPole.total_energy": call(plant, state),
        "plant.cartpole.CartPole.pendulum_energy": call(plant, state),
        "plant.cartpole.CartPole.dissipated_power": call(plant, state),
        "plant.initial_states.sample_starts": call("anywhere", 3, seed=1),
        "plant.initial_states.check_starts": call("anywhere", 3, 1),
        "plant.linearization.linearize": call(plant),
        "plant.motor.Motor.saturate": call(motor, jnp.ones(3)),
        "plant.motor.Motor.current": call(motor, jnp.ones(3), jnp.ones(3)),
        "plant.motor.Motor.force": call(motor, jnp.ones(3), jnp.ones(3)),
        "plant.motor.Motor.voltage_for_force": call(motor, 1.0, 0.1),
        "plant.motor.Motor.force_per_voltage": call(motor),
        "plant.motor.Motor.damping": call(motor),
        "plant.motor.Motor.reflected_mass": call(motor),
        "plant.motor.LumpedMotor.saturate": call(lumped, jnp.ones(3)),
        "plant.motor.LumpedMotor.force": call(lumped, jnp.ones(3), jnp.ones(3)),
        "plant.motor.LumpedMotor.voltage_for_force": call(lumped, 1.0, 0.1),
        "plant.motor.ForceActuator.saturate": call(actuator, jnp.ones(3)),
        "plant.motor.ForceActuator.force": call(actuator, jnp.ones(3), jnp.ones(3)),
        "plant.motor.ForceActuator.voltage_for_force": call(actuator, 1.0, 0.1),
        "plant.motor.ForceActuator.force_per_voltage": call(actuator),
        "plant.motor.ForceActuator.damping": call(actuator),
        "plant.motor.ForceActuator.reflected_mass": call(actuator),
        "plant.motor.ForceActuator.voltage_limit": call(actuator),
        "plant.motor.AccelerationActuator.saturate": call(servo, jnp.ones(3)),
        "plant.motor.AccelerationActuator.force": call(servo, jnp.ones(3), jnp.ones(3)),
        "plant.motor.AccelerationActuator.voltage_for_force": call(servo, 1.0, 0.1),
        "plant.motor.AccelerationActuator.force_per_voltage": call(servo),
        "plant.motor.AccelerationActuator.damping": call(servo),
        "plant.motor.AccelerationActuator.reflected_mass": call(servo),
        "plant.motor.AccelerationActuator.voltage_limit": call(servo),
        "plant.parameters.parameters_of": call(plant),
        "plant.parameters.parameter": call(plant, "gear_ratio"),
        "plant.parameters.with_parameters": call(plant, {"cart_mass": 1.1, "resistance": 2.0}),
        "plant.state.State.vector": call(state),
        "plant.state.State.from_vector": call(State, jnp.ones((3, 4))),
        "plant.state.deviation": call(state, state),
        "plant.state.checked_reference": call("reference", state),
        "controllers.estimators.FilteredDerivative.at_period": call(filtered, period),
        "controllers.estimators.FilteredDerivative.init": call(filtered, state),
        "controllers.estimators.FilteredDerivative.update": call(filtered, filtered.init(seen), seen, one),
        "controllers.estimators.Observer.at_period": call(observer, period),
        "controllers.estimators.Observer.init": call(observer, state),
        "controllers.estimators.Observer.update": call(observer, observer.init(seen), seen, one),
        "controllers.estimators.Observer.advance": call(observer, observer.init(seen), one),
        "controllers.estimators.Observer.correct": call(observer, observer.init(seen), seen),
        "controllers.estimators.Observer.predict": call(observer, seen, one),
        "controllers.estimators.KalmanFilter.at_period": call(filters["time-varying"], period),
        "controllers.estimators.KalmanFilter.steady_gain": call(filters["extended"], period),
        "controllers.estimators.KalmanFilter.init": call(filters["extended"], state),
        "controllers.estimators.KalmanFilter.update": call(
            filters["extended"], filters["extended"].init(seen), seen, one
        ),
        "controllers.estimators.KalmanFilter.advance": call(filters["extended"], filters["extended"].init(seen), one),
        "controllers.estimators.KalmanFilter.correct": call(filters["extended"], filters["extended"].init(seen), seen),
        "controllers.estimators.KalmanFilter.predict": call(filters["extended"], seen, one),
        "controllers.estimators.observer_gain": call(plant, pair, period),
        "controllers.digital.Digital.init": call(digital, state),
        "controllers.digital.Digital.update": call(digital, digital.init(seen), seen),
        "controllers.estimators.kalman_observer": call(plant, period=0.01, x_deviation=1e-4, theta_deviation=1e-3),
        "controllers.energy.EnergySwingUp.acceleration": call(swing_up, state),
        "controllers.energy.EnergySwingUp.voltage": call(swing_up, state),
        "controllers.feedback.LqrWeights.solve": call(weights, P, jnp.ones((4, 1))),
        "controllers.feedback.PoleFactors.from_poles": call(c.PoleFactors, poles[:4]),
        "controllers.feedback.PoleFactors.poles": call(pair),
        "controllers.feedback.PoleFactors.polynomial": call(pair),
        "controllers.feedback.PoleFactors.solve": call(pair, -A[:4, :4], jnp.ones((4, 1))),
        "controllers.feedback.StateFeedback.from_convention": call(
            c.StateFeedback, np.ones(4), ("x", "theta", "x_dot", "theta_dot")
        ),
        "controllers.feedback.StateFeedback.voltage": call(law, state),
        "controllers.feedback.without_design": call(hybrid),
        "controllers.gates.AngleGate.margin": call(gate, state, mode),
        "controllers.gates.AngleRateGate.margin": call(c.AngleRateGate(0.3, 2.0), state, mode),
        "controllers.gates.LyapunovGate.margin": call(c.LyapunovGate(np.eye(4), 1.0), state, mode),
        "controllers.hybrid.Hybrid.init": call(hybrid, state),
        "controllers.hybrid.Hybrid.update": call(hybrid, memory, state),
        "controllers.hybrid.Hybrid.start_mode": call(hybrid, state),
        "controllers.hybrid.Hybrid.next_mode": call(hybrid, state, mode),
        "controllers.hybrid.Hybrid.mode_voltage": call(hybrid, state, mode),
        "controllers.hybrid.Hybrid.margin": call(hybrid, state, mode),
        "controllers.hybrid.Hybrid.successor": call(hybrid, mode),
        "controllers.protocol.modes_in": call((memory, one)),
        "controllers.protocol.update_mode": call(hybrid, memory, state),
        "controllers.protocol.start_memory": call(hybrid, state),
        "controllers.protocol.demand": call(hybrid, state, mode),
        "controllers.protocol.SingleLaw.init": call(single, state),
        "controllers.protocol.SingleLaw.update": call(single, (), state),
        "controllers.protocol.SingleLaw.start_mode": call(single, state),
        "controllers.protocol.SingleLaw.next_mode": call(single, state, mode),
        "controllers.protocol.SingleLaw.mode_voltage": call(single, state, mode),
        "controllers.protocol.SingleLaw.margin": call(single, state, mode),
        "controllers.protocol.SingleLaw.successor": call(single, mode),
        "controllers.protocol.Sampled.init": call(sampled, state),
        "controllers.protocol.Sampled.update": call(sampled, memory, state),
        "controllers.protocol.as_controller": call(law),
        "controllers.protocol.as_sampled": call(hybrid),
        "controllers.protocol.at_period": call(signal, period),
        "controllers.protocol.is_clocked": call(signal),
        "controllers.signal.VoltageSignal.at_period": call(signal, period),
        "controllers.signal.VoltageSignal.init": call(signal, state),
        "controllers.signal.VoltageSignal.update": call(signal, SignalMemory(mode, mode), state),
        "controllers.smooth.SmoothHybrid.voltage": call(c.SmoothHybrid(swing_up, law, gate, 0.1), state),
        "controllers.smooth.SmoothClip.voltage": call(c.SmoothClip(law, 12.0, 1.0), state),
    }


NOT_TRACED = (
    "IntegralAction.designed",
    "MovingReference.square_wave",
    "MovingReference.from_file",
    "kalman_observer",
    "robust_gain",
    "pole_directions",
    "standard_normals",
    "numeric.differences",
    "numeric.pareto",
    "numeric.statistics",
    "plant.initial_states",
    "from_poles",
)
"""Names of what takes and returns NumPy arrays or Python numbers, or needs known numbers."""


def find(name):
    """The function of a dotted name; of a property its getter."""
    package, module, *path = name.split(".")
    thing = importlib.import_module(f"cpjax.{package}.{module}")
    for part in path:
        thing = inspect.getattr_static(thing, part)
    return thing.fget if isinstance(thing, property) else getattr(thing, "__func__", thing)


def checked(value):
    """The value, with the fields of every NamedTuple in it checked; the hook checks functions and dataclasses alone."""
    import jaxtyping
    from beartype import beartype

    if hasattr(value, "_fields"):
        jaxtyping.jaxtyped(type(value).__new__, typechecker=beartype)(type(value), *value)
    for part in value if isinstance(value, (tuple, list)) else ():
        checked(part)
    return value


def traced(function, arguments, options):
    """Checks a function inside `jit` and `vmap`, with a batch of every number in its arguments; compiles nothing."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    leaves, structure = jax.tree.flatten((arguments, options))
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, (float, np.ndarray, jax.Array))]

    def run(*numbers):
        arguments, options = structure.unflatten(
            [numbers[places.index(i)] if i in places else leaf for i, leaf in enumerate(leaves)]
        )
        found = checked(function(*arguments, **options))
        return [leaf for leaf in jax.tree.leaves(found) if isinstance(leaf, jax.Array)]

    jax.eval_shape(jax.jit(jax.vmap(run)), *(jnp.stack([jnp.asarray(leaves[i])] * 2) for i in places))


def check_package(package):
    for name, (arguments, options) in calls().items():
        if name.startswith(package):
            try:
                if any(part in name for part in NOT_TRACED) or name.endswith("batch_last"):
                    checked(find(name)(*arguments, **options))
                else:
                    traced(find(name), arguments, options)
            except Exception as problem:
                problem.add_note(f"in the call of {name}")
                raise


def check_runs():
    """Runs a sweep, and traces a batch of rollouts and of gradients."""
    import jax
    import jax.numpy as jnp

    import cpjax

    plant, times = cpjax.CartPole(), {"duration": 0.05, "dt": 0.01}

    def controller(gain):
        regulator = cpjax.StateFeedback(jnp.asarray([[-3.0, -6.0, 70.0, 18.0]]))
        return cpjax.Hybrid(cpjax.EnergySwingUp(plant, gain), regulator, cpjax.AngleGate(0.3, 0.1))

    def last(gain, start, switching):
        return cpjax.rollout(plant, controller(gain), start, switching=switching, **times).state.theta[-1]

    starts = cpjax.sample_starts("anywhere", 3, seed=1)
    cpjax.sweep(plant, controller(2.0), starts, **times)
    for function, switching in ((last, "per_step"), (jax.grad(last), "located")):
        one = functools.partial(function, 2.0, switching=switching)
        jax.eval_shape(jax.jit(jax.vmap(one)), jax.tree.map(jnp.asarray, starts))


def check_refusals():
    """Wrong shapes and dtypes are refused: in arguments, in results, in fields of dataclasses and of NamedTuples."""
    import jax.numpy as jnp
    import numpy as np
    from jaxtyping import TypeCheckError

    from cpjax import UPRIGHT, State, controllers, lqr
    from cpjax.linear import structure
    from cpjax.linear.lqr import LinearQuadratic

    structure.controllability_matrix = lambda A, B: A[0]  # the mistake in a result: a vector
    for mistake, wrong in {
        "an argument's shape": lambda: lqr(jnp.eye(4), jnp.ones((3, 1)), jnp.eye(4), jnp.eye(1)),
        "an argument's dtype": lambda: lqr(jnp.eye(4), jnp.ones((4, 1), dtype=complex), jnp.eye(4), jnp.eye(1)),
        "a mode's dtype": lambda: controllers.AngleGate(0.3).margin(UPRIGHT, jnp.asarray(0.0)),
        "a field of a dataclass": lambda: State(np.ones(2), np.ones(3), 0.0, 0.0),
        "a field of a NamedTuple": lambda: checked(LinearQuadratic(jnp.ones((1, 4)), jnp.ones((4, 3)))),
        "a result": lambda: structure.observability_matrix(jnp.eye(4), jnp.ones((2, 4))),
    }.items():
        with contextlib.suppress(TypeCheckError):
            wrong()
            raise AssertionError(f"{mistake} passed")


def check(part):
    import jaxtyping

    jaxtyping.install_import_hook([f"cpjax.{name}" for name in (*PACKAGES, "fields")], "beartype.beartype")
    {"runs": check_runs, "refusals": check_refusals}.get(part, lambda: check_package(part))()


def test_everything_public_is_called_with_its_types_checked():
    assert sorted(calls()) == sorted(public_things())


SLOW = ("linear", "controllers", "runs")


@pytest.mark.parametrize(
    "part",
    [pytest.param(one, marks=[pytest.mark.slow] * (one in SLOW)) for one in (*PACKAGES, "runs", "refusals")],
)
def test_types_state_the_shapes_that_calls_have(part):
    faster = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    command = [sys.executable, __file__, part]
    done = subprocess.run(command, env=faster, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


if __name__ == "__main__":
    check(sys.argv[1])
