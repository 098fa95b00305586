"""Every public type under every JAX transform. The types are JAX pytrees: what JAX rebuilds may hold anything."""

import copy
import dataclasses
import math
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from tables import rows

from cpjax import (
    AngleGate,
    AngleRateGate,
    CartPole,
    EnergySwingUp,
    Hybrid,
    InputError,
    LyapunovGate,
    Motor,
    ProtocolMetrics,
    State,
    StateFeedback,
    measure,
    paper,
    rollout,
)
from cpjax.fields import choice, config, count, number, renamed
from cpjax.pytree import pytree

PLANT = CartPole(
    pole_inertia=0.02, cart_friction=0.1, pivot_friction=0.01, motor=Motor(resistance=1.5, voltage_limit=math.inf)
)
GAIN = (-30.0, -25.0, 110.0, 28.0)
FEEDBACK = StateFeedback(GAIN, reference=State(0.1, 0.0, 0.0, 0.0))
WEIGHT = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.5
HYBRID = Hybrid(EnergySwingUp(PLANT, energy_gain=3.0, cart_stiffness=2.0), FEEDBACK, AngleGate(0.5, hysteresis=0.1))
START = State(0.1, -0.2, 2.5, 0.3)
RUN = {"duration": 0.2, "dt": 0.01, "clock": "sampled"}

THINGS = [
    START,
    PLANT.motor,
    PLANT,
    FEEDBACK,
    HYBRID.swing_up,
    paper.PrintedSwingUp(PLANT),
    paper.CorrectedSwingUpAsVoltage(PLANT, energy_gain=0.3),
    HYBRID.gate,
    AngleRateGate(0.5, rate=3.0, hysteresis=0.2),
    LyapunovGate(WEIGHT, level=2.0),
    HYBRID,
    ProtocolMetrics(track_limit=2.0),
]
every_type = rows("thing", THINGS, ids=lambda thing: type(thing).__name__)


def assert_same(got, expected):
    """Same types all the way down, and the same bits in every leaf."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def assert_close(got, expected, rtol, atol=0.0):
    """Same structure, every leaf within a tolerance."""
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=rtol, atol=atol)


class TestEveryType:
    @every_type
    def test_the_identity_map_keeps_type_and_leaves(self, thing):
        mapped = jax.tree.map(lambda leaf: leaf, thing)
        assert type(mapped) is type(thing)
        assert all(a is b for a, b in zip(jax.tree.leaves(mapped), jax.tree.leaves(thing), strict=True))

    @every_type
    def test_a_map_to_none_builds_the_type_without_checking_it(self, thing):
        mapped = jax.tree.map(lambda leaf: None, thing)
        assert type(mapped) is type(thing)
        assert jax.tree.leaves(mapped) == []

    @every_type
    def test_a_map_to_objects_builds_the_type_without_checking_it(self, thing):
        marker = object()
        mapped = jax.tree.map(lambda leaf: marker, thing)
        assert type(mapped) is type(thing)
        assert set(jax.tree.leaves(mapped)) == {marker}

    @every_type
    def test_a_map_to_values_outside_their_range_builds_the_type_without_checking_it(self, thing):
        mapped = jax.tree.map(lambda leaf: -math.inf * np.ones(np.shape(leaf)), thing)
        assert jax.tree.structure(mapped) == jax.tree.structure(thing)

    @every_type
    def test_a_map_to_float32_makes_every_leaf_a_float32_array_of_its_shape(self, thing):
        mapped = jax.tree.map(jnp.float32, thing)
        assert jax.tree.structure(mapped) == jax.tree.structure(thing)
        assert {leaf.dtype for leaf in jax.tree.leaves(mapped)} == {jnp.dtype("float32")}
        assert_close(mapped, thing, rtol=1e-7)

    @every_type
    def test_flattening_and_unflattening_gives_the_same_thing(self, thing):
        leaves, structure = jax.tree.flatten(thing)
        again = jax.tree.unflatten(structure, leaves)
        assert type(again) is type(thing)
        assert_same(again, thing)

    @every_type
    def test_paths_are_attribute_names_that_lead_to_their_leaf(self, thing):
        pairs, _ = jax.tree_util.tree_flatten_with_path(thing)
        for path, leaf in pairs:
            value = thing
            for key in path:
                assert isinstance(key, jax.tree_util.GetAttrKey)
                value = getattr(value, key.name)
            assert value is leaf
        given = [f.name for f in dataclasses.fields(thing) if getattr(thing, f.name) is not None]  # None is no leaf
        assert list(dict.fromkeys(path[0].name for path, _ in pairs)) == given

    @every_type
    def test_two_things_that_differ_in_numbers_only_have_one_structure_and_one_hash(self, thing):
        other = jax.tree.map(lambda leaf: 2.0 * np.asarray(leaf), thing)
        assert jax.tree.structure(other) == jax.tree.structure(thing)
        assert hash(jax.tree.structure(other)) == hash(jax.tree.structure(thing))

    @every_type
    def test_jit_takes_and_returns_it(self, thing):
        assert_close(jax.jit(lambda tree: jax.tree.map(lambda leaf: leaf * 1.0, tree))(thing), thing, rtol=0)

    @every_type
    def test_eval_shape_gives_a_thing_of_shapes(self, thing):
        shapes = jax.eval_shape(lambda tree: tree, jax.tree.map(jnp.asarray, thing))
        assert type(shapes) is type(thing)
        for shape, leaf in zip(jax.tree.leaves(shapes), jax.tree.leaves(thing), strict=True):
            assert shape.shape == np.shape(leaf)

    @every_type
    def test_adam_steps_every_leaf_against_its_gradient(self, thing):
        parameters = jax.tree.map(jnp.asarray, thing)
        optimiser = optax.adam(1e-3)
        moments = optimiser.init(parameters)
        gradient = jax.tree.map(jnp.ones_like, parameters)
        with jax.numpy_dtype_promotion("standard"):  # optax multiplies float64 leaves by float32 scalars
            updates, moments = optimiser.update(gradient, moments, parameters)
        stepped = optax.apply_updates(parameters, updates)
        assert type(stepped) is type(thing)
        assert type(moments[0].mu) is type(thing)
        assert_close(stepped, jax.tree.map(lambda leaf: leaf - 1e-3, parameters), rtol=0, atol=1e-9)

    @every_type
    def test_fields_cannot_be_set_or_deleted_or_added(self, thing):
        for name in (dataclasses.fields(thing)[0].name, "colour"):
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(thing, name, 1.0)
        with pytest.raises(dataclasses.FrozenInstanceError):
            delattr(thing, dataclasses.fields(thing)[0].name)

    @every_type
    def test_what_jax_rebuilt_is_immutable_too(self, thing):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(jax.tree.map(lambda leaf: leaf, thing), dataclasses.fields(thing)[0].name, 1.0)

    @every_type
    def test_a_pickle_holds_all_of_it(self, thing):
        assert_same(pickle.loads(pickle.dumps(thing)), thing)
        assert_same(pickle.loads(pickle.dumps(jax.tree.map(jnp.float32, thing))), jax.tree.map(jnp.float32, thing))

    @every_type
    def test_copies_are_equal_in_every_leaf(self, thing):
        assert_same(copy.copy(thing), thing)
        assert_same(copy.deepcopy(thing), thing)

    @every_type
    def test_equality_and_hash_are_those_of_an_object(self, thing):
        assert thing == thing
        assert thing != copy.copy(thing)
        assert {thing: 1}[thing] == 1

    @every_type
    def test_its_text_names_the_type_and_every_field(self, thing):
        text = repr(thing)
        assert text.startswith(type(thing).__name__ + "(")
        assert all(f"{field.name}=" in text for field in dataclasses.fields(thing))

    @every_type
    def test_constructing_it_anew_from_its_own_fields_changes_nothing(self, thing):
        assert_same(dataclasses.replace(thing), thing)


def test_a_batch_of_plants_under_vmap_gives_each_plants_own_trajectory():
    masses = jnp.asarray([0.5, 1.0, 3.0])
    plants = jax.vmap(lambda mass: dataclasses.replace(PLANT, cart_mass=mass))(masses)
    assert {leaf.shape for leaf in jax.tree.leaves(plants)} == {(3,)}
    batch = jax.vmap(lambda plant: rollout(plant, HYBRID, START, **RUN))(plants)
    assert batch.state.theta.shape == (3, 21)
    assert len(set(np.asarray(batch.state.x[:, -1]))) == 3
    for i, mass in enumerate(masses):
        one = rollout(dataclasses.replace(PLANT, cart_mass=float(mass)), HYBRID, START, **RUN)
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], batch), one, rtol=1e-12, atol=1e-12)


def test_one_axis_given_by_a_tree_of_axes_batches_one_parameter_alone():
    def marked(path, leaf):
        return 0 if path[-1].name == "cart_mass" else None

    axes = jax.tree_util.tree_map_with_path(marked, PLANT)
    plants = dataclasses.replace(PLANT, cart_mass=np.array([0.5, 1.0, 3.0]))
    moving = jax.vmap(lambda plant: plant.moving_mass + plant.pole_mass, in_axes=(axes,))(plants)
    np.testing.assert_allclose(moving, np.array([0.5, 1.0, 3.0]) + 0.5 + 7e-6, rtol=1e-15)


def test_a_batch_of_controllers_under_vmap_gives_each_controllers_own_metrics():
    gains = np.array(GAIN) * np.array([[1.0], [2.0], [0.5]])
    angles = jnp.asarray([0.2, 0.5, 2.9])

    def build(gain, angle):
        return dataclasses.replace(HYBRID, regulator=StateFeedback(gain), gate=AngleGate(angle))

    controllers = jax.vmap(build)(gains, angles)
    batch = jax.vmap(lambda controller: measure(PLANT, controller, START, **RUN))(controllers)
    assert len(set(np.asarray(batch.effort).round(6))) == 2  # two of the three gates are never reached
    for i in range(3):
        one = measure(PLANT, build(gains[i], float(angles[i])), START, **RUN)
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], batch), one, rtol=1e-12)


def test_eval_shape_of_a_rollout_has_the_shapes_and_types_of_the_rollout():
    shapes = jax.eval_shape(lambda plant, start: rollout(plant, HYBRID, start, **RUN), PLANT, START)
    real = rollout(PLANT, HYBRID, START, **RUN)
    assert jax.tree.structure(shapes) == jax.tree.structure(real)
    for shape, leaf in zip(jax.tree.leaves(shapes), jax.tree.leaves(real), strict=True):
        assert (shape.shape, shape.dtype) == (leaf.shape, leaf.dtype)


def test_a_float32_start_makes_the_rollout_float32_and_close_to_float64():
    plant, controller, start = (jax.tree.map(jnp.float32, tree) for tree in (PLANT, HYBRID, START))
    narrow = rollout(plant, controller, start, **RUN)
    wide = rollout(PLANT, HYBRID, START, **RUN)
    kinds = {leaf.dtype for leaf in jax.tree.leaves(narrow) if jnp.issubdtype(leaf.dtype, jnp.floating)}
    assert kinds == {jnp.dtype("float32")}
    assert_close(narrow.state, wide.state, rtol=1e-4, atol=1e-5)


def test_the_start_alone_decides_the_type_of_a_rollout():
    float32 = jax.tree.map(jnp.float32, START)
    narrow = jax.eval_shape(lambda: rollout(PLANT, HYBRID, float32, **RUN))
    assert narrow.voltage.dtype == jnp.float32
    wide = jax.eval_shape(lambda: rollout(jax.tree.map(jnp.float32, PLANT), HYBRID, START, **RUN))
    assert wide.voltage.dtype == jnp.float64


def test_gradients_flow_through_every_constructor():
    def effort(numbers):
        motor = Motor(resistance=numbers["resistance"], voltage_limit=math.inf)
        plant = CartPole(cart_mass=numbers["cart_mass"], motor=motor)
        law = StateFeedback(
            jnp.stack([-30.0, numbers["gain"], 110.0, 28.0]), reference=State(numbers["x"], 0.0, 0.0, 0.0)
        )
        start = State(0.1, 0.0, numbers["theta"], 0.0)
        return measure(plant, law, start, clock="continuous", duration=0.2, dt=0.01).effort

    numbers = {"resistance": 1.25, "cart_mass": 1.0, "gain": -25.0, "x": 0.2, "theta": 0.3}
    jitted = jax.jit(effort)
    gradient = jax.jit(jax.grad(effort))(numbers)
    for name, value in numbers.items():
        h = 1e-5
        slope = (jitted({**numbers, name: value + h}) - jitted({**numbers, name: value - h})) / (2 * h)
        assert float(slope) != 0.0
        np.testing.assert_allclose(gradient[name], slope, rtol=1e-6)


def test_numbers_of_plant_controller_start_metrics_and_step_share_one_compilation():
    weak = jnp.multiply(2.0, 1.0)  # a JAX scalar without a type of its own
    changes = [
        {"plant": dataclasses.replace(PLANT, cart_mass=2.0)},
        {"plant": dataclasses.replace(PLANT, cart_mass=weak), "start": State(weak, 0, np.float64(2.0), 0.0)},
        {"plant": jax.tree.map(jnp.float32, PLANT)},
        {"plant": dataclasses.replace(PLANT, motor=Motor(gear_ratio=np.array(3.0)))},
        {"controller": dataclasses.replace(HYBRID, regulator=StateFeedback([1, 2, 3, 4]))},
        {"controller": dataclasses.replace(HYBRID, gate=AngleGate(1.0))},
        {"metrics": ProtocolMetrics(hold=0.1)},
        {"duration": 0.4, "dt": 0.02, "clock": "sampled", "control_period": 0.02},
    ]
    usual = {"plant": PLANT, "controller": HYBRID, "start": START, "metrics": ProtocolMetrics(), **RUN}
    for array in (jnp.float32(1.0), weak):  # what a rollout converts arrays with is compiled too, once
        measure(**usual | {"plant": dataclasses.replace(PLANT, cart_mass=array)})
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, _, **__: compiled.append(event))
    try:
        for change in changes:
            measure(**usual | change)
    finally:
        jax.monitoring.clear_event_listeners()
    assert [event for event in compiled if "backend_compile" in event] == []


def test_a_jitted_function_of_the_plant_is_traced_once_for_all_plants():
    traces = []

    @jax.jit
    def energy(plant, controller):
        traces.append(None)
        return plant.total_energy(START) + controller.mode_voltage(START, jnp.asarray(1))

    values = {
        float(energy(dataclasses.replace(PLANT, pole_length=length), dataclasses.replace(HYBRID, regulator=law)))
        for length in (0.5, 1.5)
        for law in (FEEDBACK, StateFeedback(2.0 * FEEDBACK.K))
    }
    assert len(values) == 4
    assert len(traces) == 1


@pytree
class _Limited:
    """A class with a check of its own, as a user of the decorator would write it."""

    size: float = number("m", "how large", above=0.0)

    def __post_init__(self):
        if not isinstance(self.size, jax.core.Tracer) and self.size > 2.0:
            raise InputError("_Limited.size", self.size, "at most 2 in all")


def test_the_own_check_of_a_class_runs_after_the_declared_ones():
    with pytest.raises(InputError, match=r"_Limited\.size = -1\.0: must be a finite number above 0 \[m\]"):
        _Limited(-1.0)
    with pytest.raises(InputError, match=r"at most 2 in all"):
        _Limited(3.0)


def test_a_config_checks_its_fields_and_lists_them_in_its_docstring():
    @config
    class Run:
        """Sizes of a run."""

        starts: int = count("initial states", default=4, at_least=1)
        step: float = number("s", "of the integrator", default=0.1, above=0.0)
        law: str = choice("swing-up law", ("energy", "bang"), default="energy")

    assert Run(step=1).step == 1.0
    assert Run.__doc__.endswith("  starts: initial states.\n  step: of the integrator [s].\n  law: swing-up law.")
    for given, field in (({"starts": 0}, "starts"), ({"starts": True}, "starts"), ({"law": "none"}, "law")):
        with pytest.raises(InputError) as caught:
            Run(**given)
        assert caught.value.field == field


def test_an_old_name_of_a_field_works_and_warns():
    @renamed(h="step")
    @config
    class Run:
        """Sizes of a run."""

        step: float = number("s", "of the integrator", default=0.1, above=0.0)

    with pytest.warns(DeprecationWarning, match="Run.h is now step"):
        assert Run(h=0.5).step == 0.5
    with pytest.raises(TypeError):
        Run(g=0.5)


def test_counts_and_choices_are_part_of_the_structure_and_no_leaves():
    @pytree
    class Repeated:
        gain: float = number("1", "factor")
        times: int = count("how often", default=2)
        way: str = choice("in which way", ("up", "down"), default="up")

        def value(self):
            return self.gain**self.times * (1.0 if self.way == "up" else -1.0)

    thing = Repeated(3.0)
    assert jax.tree.leaves(thing) == [3.0]
    assert jax.tree.structure(thing) != jax.tree.structure(Repeated(3.0, 3))
    assert float(jax.jit(Repeated.value)(Repeated(3.0, way="down"))) == -9.0
    assert float(jax.grad(Repeated.value)(thing).gain) == 6.0
    with pytest.raises(InputError, match=r"Repeated\.way"):
        Repeated(3.0, way="left")
