"""Bad input is refused by name, value and allowed range; what goes wrong inside jit is flagged and never a success."""

import dataclasses
import functools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

import cpjax
from cpjax import (
    HANGING,
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
    linearize,
    measure,
    paper,
    rollout,
    sample_starts,
    sweep,
)
from cpjax.fields import rules
from cpjax.numeric.statistics import two_proportion_p_value, wilson_interval
from cpjax.sim.flags import STOPPED, Flag

PLANT = paper.appendix_plant()
LAW = StateFeedback([-24.74, -25.36, 111.70, 28.58])
HUGE = 10**400  # an integer that no float can hold


def refused(field, value, allowed):
    """The error that names `field`, shows `value` and says what is `allowed` (any text: give its literal beginning)."""
    pattern = rf"(^|: ){re.escape(field)} = {re.escape(value)}.*: must be {re.escape(allowed)}"
    return pytest.raises(InputError, match=pattern)


# --- constructors -----------------------------------------------------------------------------------------------------

POSITIVE, NOT_NEGATIVE, ANY = "a finite number above 0", "a finite number at least 0", "a finite number"
ANGLE = "a finite number above 0 and at most 3.14159"
NUMBERS = [
    *((Motor, f, POSITIVE, u) for f, u in (("torque_constant", "N m/A"), ("resistance", "ohm"))),
    *((Motor, f, POSITIVE, u) for f, u in (("wheel_radius", "m"), ("gear_ratio", "1"))),
    *((Motor, f, NOT_NEGATIVE, u) for f, u in (("back_emf_constant", "V s/rad"), ("rotor_inertia", "kg m^2"))),
    (Motor, "viscous_friction", NOT_NEGATIVE, "N m s/rad"),
    (Motor, "voltage_limit", "a number above 0", "V"),
    *((CartPole, f, POSITIVE, u) for f, u in (("cart_mass", "kg"), ("pole_mass", "kg"), ("pole_length", "m"))),
    (CartPole, "gravity", POSITIVE, "m/s^2"),
    *((CartPole, f, NOT_NEGATIVE, u) for f, u in (("pole_inertia", "kg m^2"), ("cart_friction", "N s/m"))),
    (CartPole, "pivot_friction", NOT_NEGATIVE, "N m s/rad"),
    (Motor, "inductance", POSITIVE, "H"),
    (CartPole, "coulomb_friction", NOT_NEGATIVE, "N"),
    (CartPole, "pivot_coulomb_friction", NOT_NEGATIVE, "N m"),
    (CartPole, "static_friction_ratio", "a finite number at least 1", "1"),
    (EnergySwingUp, "energy_gain", NOT_NEGATIVE, "m/(J s)"),
    (EnergySwingUp, "cart_stiffness", NOT_NEGATIVE, "1/s^2"),
    (EnergySwingUp, "cart_damping", NOT_NEGATIVE, "1/s"),
    (EnergySwingUp, "kick", ANY, "m/s^2"),
    (EnergySwingUp, "kick_radius", "a finite number at least 0.001 and at most 1.5708", "rad"),
    (paper.PrintedSwingUp, "energy_gain", ANY, "V/(J rad/s)"),
    (paper.CorrectedSwingUpAsVoltage, "energy_gain", ANY, "V/(J rad/s)"),
    (AngleGate, "half_angle", ANGLE, "rad"),
    (AngleGate, "hysteresis", NOT_NEGATIVE, "1"),
    (AngleRateGate, "half_angle", ANGLE, "rad"),
    (AngleRateGate, "rate", POSITIVE, "rad/s"),
    (AngleRateGate, "hysteresis", NOT_NEGATIVE, "1"),
    (LyapunovGate, "level", POSITIVE, "1"),
    (LyapunovGate, "hysteresis", NOT_NEGATIVE, "1"),
    *((ProtocolMetrics, f, POSITIVE, u) for f, u in (("angle_band", "rad"), ("position_band", "m"))),
    (ProtocolMetrics, "hold", NOT_NEGATIVE, "s"),
    (ProtocolMetrics, "reference_x", "a finite number", "m"),
    (ProtocolMetrics, "track_limit", "a number above 0", "m"),
]
REQUIRED = {
    EnergySwingUp: {"model": PLANT, "energy_gain": 1.0},
    paper.PrintedSwingUp: {"model": PLANT},
    paper.CorrectedSwingUpAsVoltage: {"model": PLANT},
    AngleGate: {"half_angle": 0.5},
    AngleRateGate: {"half_angle": 0.5, "rate": 2.0},
    LyapunovGate: {"P": np.eye(4), "level": 1.0},
    StateFeedback: {"K": LAW.K},
    Hybrid: {"swing_up": LAW, "regulator": LAW, "gate": AngleGate(0.5)},
}
every_number = rows(
    ("cls", "field", "allowed", "unit"), NUMBERS, ids=[f"{cls.__name__}.{field}" for cls, field, _, _ in NUMBERS]
)


def build(cls, **fields):
    return cls(**{**REQUIRED.get(cls, {}), **fields})


def test_the_table_of_numbers_misses_no_field_of_any_class():
    listed = {(cls, field) for cls, field, _, _ in NUMBERS}
    for cls in {cls for cls, _ in listed}:
        parts = {"motor", "model", "P", "reference"}
        assert {f.name for f in dataclasses.fields(cls)} - parts == {f for c, f in listed if c is cls}


@every_number
def test_a_number_that_is_not_finite_is_refused(cls, field, allowed, unit):
    for value in (math.nan, np.nan, np.array([1.0, np.nan]), jnp.asarray(math.nan), -math.inf):
        with refused(f"{cls.__name__}.{field}", "", allowed):
            build(cls, **{field: value})
    if allowed != "a number above 0":  # the two limits that may be infinite
        with refused(f"{cls.__name__}.{field}", "inf", f"{allowed} [{unit}]"):
            build(cls, **{field: math.inf})


@every_number
def test_a_number_below_its_range_is_refused_and_its_ends_are_held(cls, field, allowed, unit):
    name = f"{cls.__name__}.{field}"
    if allowed == ANY:
        assert getattr(build(cls, **{field: -1.0}), field) == -1.0
        return
    with refused(name, "-1.0", f"{allowed} [{unit}]"):
        build(cls, **{field: -1.0})
    with refused(name, "-1.0", allowed):
        build(cls, **{field: -1})
    with refused(name, "array([ 1., -1.])", allowed):
        build(cls, **{field: np.array([1.0, -1.0])})
    if allowed == NOT_NEGATIVE:
        assert getattr(build(cls, **{field: 0}), field) in ([None] if "coulomb" in field else [0.0])
    else:
        with refused(name, "0.0", allowed):
            build(cls, **{field: 0.0})


@every_number
@rows(
    ("value", "shown"),
    [
        (True, "True"),
        (np.True_, "True"),
        ("1.0", "'1.0'"),
        (None, "None"),
        (1j, "1j"),
        ([1.0], "[1.0]"),
        ({}, "{}"),
        (np.array([1, 2]), "'[1 2] of dtype int64'"),
        (np.array(1), "'1 of dtype int64'"),
        (np.array([True]), "'[ True] of dtype bool'"),
        (np.array("1"), "'1 of dtype <U1'"),
        (np.array([1j]), "'[0.+1.j] of dtype complex128'"),
    ],
    ids=lambda v: f"{type(v).__name__}" if not isinstance(v, str) else "",
)
def test_what_is_no_real_number_is_refused(cls, field, allowed, unit, value, shown):
    if value is None and rules(cls)[field].optional:
        assert getattr(build(cls, **{field: None}), field) is None
        return
    with refused(f"{cls.__name__}.{field}", shown, allowed):
        build(cls, **{field: value})


@rows("text", ["a\nb", "a\r\nb", "\x1b[31m", "\x07", "a\u2028b"])
def test_an_error_is_one_line_without_control_characters_whatever_was_given(text):
    for error in (InputError(text, 1, "x"), InputError("x", text, "x"), InputError("x", 1, text)):
        assert str(error).isprintable()


@rows("infinite", [(Motor, "voltage_limit"), (ProtocolMetrics, "track_limit")])
def test_the_two_limits_may_be_infinite(infinite):
    cls, field = infinite
    assert getattr(cls(**{field: math.inf}), field) == math.inf


def test_python_and_numpy_integers_are_welcome_where_a_number_is_meant():
    assert CartPole(cart_mass=2).cart_mass == 2.0
    assert isinstance(CartPole(cart_mass=np.int64(2)).cart_mass, float)


@rows("cls", [AngleGate, AngleRateGate])
def test_a_hysteresis_that_opens_an_angle_gate_beyond_half_a_turn_is_refused(cls):
    assert build(cls, half_angle=math.pi / 2, hysteresis=1.0).hysteresis == 1.0
    with refused(f"{cls.__name__}.hysteresis", "1.1", "small enough that half_angle * (1 + hysteresis) is at most pi"):
        build(cls, half_angle=math.pi / 2, hysteresis=1.1)
    with refused(f"{cls.__name__}.hysteresis", "0.5", "small enough"):
        build(cls, half_angle=np.array([0.1, 3.0]), hysteresis=0.5)


@rows(
    ("value", "shown"),
    [
        ([1.0, 2.0, 3.0], "'array of shape (3,)'"),
        (np.ones((4, 1)), "'array of shape (4, 1)'"),
        (np.ones((2, 4)), "'array of shape (2, 4)'"),
        (1.0, "1.0"),
        (None, "None"),
        (True, "True"),
        ("1234", "'1234'"),
        ([[1.0], [1.0, 2.0]], "[[1.0], [1.0, 2.0]]"),
        ([1.0, 2.0, "x", 4.0], "[1.0, 2.0, 'x', 4.0]"),
        ([1j] * 4, "[1j, 1j, 1j, 1j]"),
        ([1.0, math.nan, 3.0, 4.0], "array([[ 1., nan, 3., 4.]])"),
        (np.array([1.0, 2.0, 3.0, math.inf]), "array([[ 1., 2., 3., inf]])"),
        (np.arange(4), "'[[0 1 2 3]] of dtype int64'"),
        (np.ones(4, bool), "'[[ True True True True]] of dtype bool'"),
        (np.ones(4, complex), "'[[1.+0.j 1.+0.j 1.+0.j 1.+0.j]] of dtype complex128'"),
        (np.ones(0), "'array of shape (0,)'"),
    ],
)
def test_a_gain_that_is_no_row_of_four_real_numbers_is_refused(value, shown):
    with refused("StateFeedback.K", shown, "a finite array of shape (1, 4) [V per unit of state]"):
        StateFeedback(value)


@rows("value", [["1", "2", "3", "4"], [True] * 4, [None] * 4], ids=["texts", "bools", "nones"])
def test_a_gain_listed_in_other_things_than_numbers_is_refused(value):
    with refused("StateFeedback.K", "", "a finite array of shape (1, 4)"):
        StateFeedback(value)


ASYMMETRIC = np.eye(4) + np.triu(np.full((4, 4), 1e-3), 1)


@rows(
    ("value", "shown"),
    [
        (ASYMMETRIC, "array([["),
        (np.stack([np.eye(4), ASYMMETRIC]), "array([[["),
        (np.ones(4), "'array of shape (4,)'"),
        (np.eye(3), "'array of shape (3, 3)'"),
        (np.eye(4, dtype=int), "'[[1 0 0 0]"),
        (np.full((4, 4), math.nan), "array([["),
        (np.full((4, 4), math.inf), "array([["),
        (np.diag([1.0, 1.0, 1.0, math.inf]), "array([["),
        (1.0, "1.0"),
        (None, "None"),
        ("eye", "'eye'"),
    ],
    ids=["asymmetric", "one of two asymmetric", "row", "3x3", "integers", "nan", "inf", "one inf", "1", "None", "text"],
)
def test_a_lyapunov_weight_that_is_no_symmetric_finite_matrix_is_refused(value, shown):
    with refused("LyapunovGate.P", shown, "a symmetric finite array of shape (4, 4) [per product of states]"):
        LyapunovGate(value, level=1.0)


@rows(
    ("cls", "field", "allowed"),
    [
        (CartPole, "motor", "a cpjax.Motor"),
        (EnergySwingUp, "model", "plant model used by the law, a CartPole"),
        (paper.PrintedSwingUp, "model", "plant model used by the law, a CartPole"),
        (paper.CorrectedSwingUpAsVoltage, "model", "plant model used by the law, a CartPole"),
        (StateFeedback, "reference", "the state to hold, a State"),
        (Hybrid, "swing_up", "a law (with voltage)"),
        (Hybrid, "regulator", "a law (with voltage)"),
        (Hybrid, "gate", "a gate (with margin)"),
    ],
)
@rows("value", [None, 1.0, "appendix", np.ones(4), {}, ProtocolMetrics()], ids=lambda v: str(v)[:8])
def test_a_part_of_the_wrong_kind_is_refused(cls, field, allowed, value):
    with refused(f"{cls.__name__}.{field}", repr(value)[:20].split("\n")[0], allowed):
        build(cls, **{field: value})


@rows("x", [math.nan, math.inf, "1", None, True, 1j, [1.0]], ids=repr)
def test_a_reference_that_is_no_state_of_finite_numbers_is_refused(x):
    with pytest.raises(InputError, match=r"reference.*\bx\b"):
        rollout(
            PLANT, StateFeedback(LAW.K, State(x, 0.0, 0.0, 0.0)), HANGING, clock="continuous", duration=0.1, dt=0.01
        )


@rows("cls", [CartPole, AngleGate, ProtocolMetrics])
def test_an_empty_batch_of_numbers_is_refused(cls):
    field = dataclasses.fields(cls)[0].name
    with refused(f"{cls.__name__}.{field}", "", "a finite number"):
        build(cls, **{field: np.ones(0)})


@rows(
    "use",
    [
        lambda: CartPole(cart_mass=HUGE),
        lambda: StateFeedback([HUGE, 0, 0, 0]),
        lambda: rollout(PLANT, LAW, State(HUGE, 0.0, 0.0, 0.0), clock="continuous", duration=1.0, dt=0.1),
        lambda: rollout(PLANT, LAW, HANGING, clock="continuous", duration=HUGE, dt=0.1),
        lambda: rollout(PLANT, LAW, HANGING, clock="continuous", duration=1.0, dt=HUGE),
        lambda: wilson_interval(1, HUGE),
    ],
    ids=["field", "matrix", "start", "duration", "dt", "trials"],
)
def test_an_integer_too_large_for_a_float_is_refused(use):
    with pytest.raises(InputError, match="must be"):
        use()


@rows(
    ("arguments", "field", "allowed"),
    [
        ({"mass": -1, "length": 1}, "CartPole.rod: mass = -1.0", "above 0"),
        ({"mass": 1.0, "length": -1.0}, "CartPole.rod: length = -1.0", "above 0"),
        ({"mass": "1", "length": 1.0}, "mass = '1'", "a finite number"),
        ({"mass": 1.0, "length": None}, "length = None", "a finite number"),
    ],
)
def test_a_rod_of_bad_mass_or_length_is_refused(arguments, field, allowed):
    with pytest.raises(InputError, match=f"{re.escape(field)}: must be .*{allowed}"):
        CartPole.rod(**arguments)


# --- rollout, measure, sweep ------------------------------------------------------------------------------------------

SECONDS = "a finite number above 0 [s]"
SAMPLED = {"clock": "sampled"}


def run(function=rollout, plant=PLANT, controller=LAW, start=HANGING, **settings):
    return function(plant, controller, start, **{"duration": 0.1, "dt": 0.01, **settings})


@rows("function", [rollout, measure], ids=lambda f: f.__name__)
@rows(
    ("settings", "field", "value", "allowed"),
    [
        ({"dt": 0.2}, "dt", "0.2", "at most the duration, 0.1 s"),
        ({"dt": 0.03}, "duration", "0.1", "a whole multiple of dt = 0.03 s"),
        ({"duration": 0.1 + 1e-6}, "duration", "0.100001", "a whole multiple of dt = 0.01 s"),
        *(
            ({"dt": v}, "dt", repr(v), SECONDS)
            for v in (0, 0.0, -0.01, math.nan, math.inf, True, None, 1j, "x", [0.01])
        ),
        *(({"duration": v}, "duration", repr(v), SECONDS) for v in (0, -1.0, math.nan, math.inf, True, None, 1j, "x")),
        ({"duration": 1e300}, "duration", "1e+300", "fewer than 2^31 steps"),
        ({"duration": 1e7, "dt": 1e-3}, "duration", "10000000.0", "fewer than 2^31 steps"),
        ({"clock": "continuous", "control_period": 0.02}, "control_period", "0.02", "absent unless clock is sampled"),
        ({**SAMPLED, "control_period": 0.005}, "control_period", "0.005", "at least one step, dt = 0.01 s"),
        ({**SAMPLED, "control_period": 0.025}, "control_period", "0.025", "a whole multiple of dt = 0.01 s"),
        *(
            ({**SAMPLED, "control_period": v}, "control_period", repr(v), SECONDS)
            for v in (0.0, -1, math.nan, True, "x")
        ),
        *(({"clock": v}, "clock", repr(v), "continuous or sampled") for v in ("Sampled", "", 1, [], {})),
        *(({"integrator": v}, "integrator", repr(v), "one of rk4, ") for v in ("RK4", "", None, 4, [], {}, ["rk4"])),
        *(({"switching": v}, "switching", repr(v), "per_step") for v in ("events", 0, [])),
    ],
    ids=str,
)
def test_a_bad_setting_of_a_rollout_is_refused(function, settings, field, value, allowed):
    with refused(field, value, allowed):
        run(function, **settings)


@rows(
    ("value", "allowed"),
    [
        (3, "a divisor of the number of steps, 10"),
        (20, "a divisor of the number of steps, 10"),
        *((v, "a whole number of steps, at least 1") for v in (0, -1, True, 1.0, "1", np.ones(1), None)),
    ],
    ids=repr,
)
def test_a_bad_save_every_is_refused(value, allowed):
    with refused("save_every", repr(value), allowed):
        run(save_every=value)


@rows("name", ["dt", "duration", "control_period", "save_every", "clock", "switching", "integrator"])
def test_a_traced_setting_is_refused(name):
    def traced(value):
        return run(**{**SAMPLED, name: value}).flag

    with refused(name, "", ""):
        jax.jit(traced)(0.01)


@rows("field", ["dt", "duration", "control_period"])
def test_seconds_given_as_text_are_refused(field):
    with refused(field, "'0.1'", SECONDS):
        run(**{**SAMPLED, field: "0.1"})


def test_a_step_too_small_for_any_count_of_steps_is_refused():
    with refused("duration", "1e+300", "fewer than 2^31 steps"):
        run(duration=1e300, dt=1e-300)


@rows(
    ("start", "field", "value", "allowed"),
    [
        *((v, "start", repr(v)[:9], "a cpjax.State(x, x_dot, theta, theta_dot)") for v in (None, (0, 0, 0, 0), 1.0)),
        (np.zeros(4), "start", "array(", "a cpjax.State"),
        (PLANT, "start", "CartPole(", "a cpjax.State"),
        (State(math.nan, 0.0, 0.0, 0.0), "start.x", "nan", "finite"),
        (State(0.0, math.inf, 0.0, 0.0), "start.x_dot", "inf", "finite"),
        (State(0.0, 0.0, np.array(math.nan), 0.0), "start.theta", "array(nan)", "finite"),
        (State(0.0, 0.0, jnp.asarray(-math.inf), 0.0), "start.theta", "Array(-inf", "finite"),
        (State(0.0, 0.0, 0.0, np.array(3)), "start.theta_dot", "'array of dtype int64'", "of dtype float32 or float64"),
        (State(np.array(True), 0.0, 0.0, 0.0), "start.x", "'array of dtype bool'", "of dtype float32 or float64"),
        (State(np.float16(1), 0.0, 0.0, 0.0), "start.x", "'array of dtype float16'", "of dtype float32 or float64"),
        (State(jnp.bfloat16(1), 0.0, 0.0, 0.0), "start.x", "'array of dtype bfloat16'", "of dtype float32 or float64"),
        (State(np.array(1j), 0.0, 0.0, 0.0), "start.x", "'array of dtype complex128'", "of dtype float32 or float64"),
        *((State(v, 0.0, 0.0, 0.0), "start.x", repr(v), "a real number") for v in (True, "0", None, 1j, [0.0])),
        (
            State(np.float32(1), np.array(1.0), 0.0, 0.0),
            "start",
            "'State with dtypes x: float32, x_dot: float64'",
            "of one dtype, float32 or float64, throughout",
        ),
        (
            State(np.ones(1), 0.0, 0.0, 0.0),
            "start.x",
            "'array of shape (1,)'",
            "one number; many initial states go through",
        ),
        (
            State(0.0, 0.0, np.ones(3), 0.0),
            "start.theta",
            "'array of shape (3,)'",
            "one number; many initial states go through",
        ),
    ],
    ids=lambda v: "",
)
@rows("function", [rollout, measure], ids=lambda f: f.__name__)
def test_a_start_that_is_no_state_of_four_finite_numbers_of_one_type_is_refused(function, start, field, value, allowed):
    with refused(field, value, allowed):
        run(function, start=start)


def test_a_traced_start_of_the_wrong_type_or_shape_is_refused():
    for value in (jnp.asarray(1), jnp.float16(1), jnp.ones(3)):
        with pytest.raises(InputError, match=r"start\.x = 'array of (dtype (int64|float16)|shape \(3,\))': must be "):
            jax.jit(lambda x: run(start=State(x, 0.0, 0.0, 0.0)))(value)


def test_a_start_beyond_the_range_of_its_type_is_refused():
    with pytest.raises(InputError, match="start"):
        run(start=State(np.float32(0.0), 1e300, 0.0, 0.0))


@rows("function", [rollout, measure, sweep], ids=lambda f: f.__name__)
@rows("plant", [None, PLANT.motor, LAW, CartPole, "appendix", {}], ids=lambda v: repr(v)[:12])
def test_a_plant_of_the_wrong_kind_is_refused(function, plant):
    start = State(np.ones(2), 0.0, 0.0, 0.0) if function is sweep else HANGING
    with refused("plant", repr(plant)[:12], "a cpjax.CartPole"):
        run(function, plant=plant, start=start)


@rows(
    "controller",
    [None, PLANT, PLANT.motor, AngleGate(0.5), "lqr", 1.0, lambda state: 0.0, Hybrid, StateFeedback],
    ids=lambda v: repr(v)[:24],
)
def test_a_controller_of_the_wrong_kind_is_refused(controller):
    with refused("controller", repr(controller)[:12], "a controller such as cpjax.Hybrid, or a law"):
        run(controller=controller)


@rows("metrics", [1, "effort", PLANT, ProtocolMetrics, {}], ids=lambda v: repr(v)[:24])
def test_metrics_that_are_no_fold_are_refused(metrics):
    with refused("metrics", repr(metrics)[:12], ""):
        run(metrics=metrics)


BATCHED = {
    "plant": {"plant": dataclasses.replace(PLANT, cart_mass=np.ones(3))},
    "plant.motor": {"plant": dataclasses.replace(PLANT, motor=Motor(resistance=np.ones(3)))},
    "controller": {"controller": StateFeedback(np.ones((3, 1, 4)))},
    "controller's reference": {"controller": StateFeedback(LAW.K, State(np.ones(3), 0.0, 0.0, 0.0))},
    "controller's gate": {"controller": Hybrid(LAW, LAW, AngleGate(np.full(3, 0.5)))},
    "metrics": {"metrics": ProtocolMetrics(hold=np.ones(3))},
}


@rows("arguments", BATCHED.values(), ids=BATCHED)
def test_a_batched_component_without_vmap_is_refused(arguments):
    name = next(iter(arguments))
    with pytest.raises(InputError, match=rf"{name}\S* = 'array of shape \(3,( 1, 4)?\)?.*vmap"):
        run(**arguments)


@rows(
    ("starts", "settings", "field", "value", "allowed"),
    [
        (
            State(*[np.zeros(0)] * 4),
            {},
            "starts",
            "'State of shapes [(0,), (0,), (0,), (0,)]'",
            "arrays of one shape (n,)",
        ),
        (State(np.ones(2), np.ones(3), 0.0, 0.0), {}, "starts", "'State of shapes [(2,), (3,),", "arrays of one shape"),
        (State(np.ones((2, 2)), 0.0, 0.0, 0.0), {}, "starts", "'State of shapes [(2, 2),", "arrays of one shape (n,)"),
        (State(np.array([0.0, math.nan]), 0.0, 0.0, 0.0), {}, "starts.x", "array([ 0., nan])", "finite"),
        (State(np.arange(2), 0.0, 0.0, 0.0), {}, "starts.x", "'array of dtype int64'", "of dtype float32 or float64"),
        (np.ones((2, 4)), {}, "starts", "array(", "a cpjax.State"),
        *(
            (State(np.ones(2), 0.0, 0.0, 0.0), {name: v}, name, repr(v), "a whole number of initial states, at least 1")
            for v in (0, -1, 1.0, True, "1")
            for name in ("chunk", "block")
        ),
        (State(np.ones(2), 0.0, 0.0, 0.0), {"dt": 0.03}, "duration", "0.1", "a whole multiple of dt"),
        (State(np.ones(2), 0.0, 0.0, 0.0), {"clock": "x"}, "clock", "'x'", "continuous or sampled"),
    ],
    ids=lambda v: "",
)
def test_a_bad_argument_of_a_sweep_is_refused(starts, settings, field, value, allowed):
    with refused(field, value, allowed):
        run(sweep, start=starts, **settings)


# --- the other functions that take arguments --------------------------------------------------------------------------


@rows(
    ("arguments", "field", "value", "allowed"),
    [
        *(((v, 1, 1), "starts", repr(v), "one of hanging, anywhere, wide, rest") for v in ("Hanging", "", None, 1, [])),
        *((("rest", v, 1), "count", repr(v), "a whole number, at least 1") for v in (0, -1, 1.0, True, "1", None)),
        *((("rest", 1, v), "seed", repr(v), "a whole number, at least 0") for v in (-1, 1.0, True, "1", None)),
    ],
    ids=str,
)
def test_bad_arguments_of_sample_starts_are_refused(arguments, field, value, allowed):
    name, count, seed = arguments
    with refused(field, value, allowed):
        sample_starts(name, count, seed=seed)


@rows("dtype", [int, str, complex, "x"], ids=str)
def test_a_type_of_starts_that_no_rollout_takes_is_refused(dtype):
    with pytest.raises(InputError, match=r"dtype = .*: must be .*float32 or float64"):
        sample_starts("hanging", 2, seed=1, dtype=dtype)


@rows("count", [10**12, 10**30])
def test_a_count_of_starts_that_fits_no_memory_is_refused(count):
    with refused("count", repr(count), "a whole number"):
        sample_starts("hanging", count, seed=1)


@rows(
    ("arguments", "field", "value", "allowed"),
    [
        *(((1, v), "trials", repr(v), "a whole number, at least 1") for v in (0, -1, 3.5, math.inf, "3", None)),
        *(
            ((v, 3), "successes", repr(v), "a whole number from 0 to trials = 3")
            for v in (-1, 4, 1.5, math.nan, "1", None)
        ),
        *(((1, 3, v), "confidence", repr(v), "") for v in (0.0, 1.0, -1.0, 2.0, math.nan, "0.95")),
    ],
    ids=str,
)
def test_bad_arguments_of_the_wilson_interval_are_refused(arguments, field, value, allowed):
    with refused(field, value, allowed):
        wilson_interval(*arguments)


@rows(
    ("arguments", "field"),
    [
        ((1, 0, 1, 3), "trials"),
        ((1, 3, 1, 0), "trials"),
        ((4, 3, 1, 3), "successes"),
        ((1, 3, -1, 3), "successes"),
        ((1.5, 3, 1, 3), "successes"),
        ((1, 3, "1", 3), "successes"),
        ((1, 3, math.nan, 3), "successes"),
    ],
    ids=str,
)
def test_bad_arguments_of_the_two_proportion_test_are_refused(arguments, field):
    with refused(field, "", "a whole number"):
        two_proportion_p_value(*arguments)


@rows(
    ("arguments", "field", "value"),
    [
        ((PLANT, "up"), "equilibrium", "'up'"),
        ((PLANT, None), "equilibrium", "None"),
        ((PLANT, 1.0), "equilibrium", "1.0"),
        ((PLANT, State(0.0, 0.0, 1.0, 0.0)), "equilibrium", "State("),
        ((PLANT, State(0.0, 1.0, 0.0, 0.0)), "equilibrium", "State("),
        ((PLANT, State(0.0, 0.0, math.nan, 0.0)), "equilibrium", "State("),
        ((None,), "plant", "None"),
        ((LAW,), "plant", "StateFeedback("),
    ],
    ids=lambda v: "",
)
def test_bad_arguments_of_linearize_are_refused(arguments, field, value):
    with refused(field, value, ""):
        linearize(*arguments)


@rows(
    ("arguments", "field", "value", "allowed"),
    [
        (("printed", "lqr", PLANT), "law", "'printed'", "one of as-printed, corrected, corrected-as-voltage"),
        (("corrected", "LQR", PLANT), "design", "'LQR'", "one of placement, lqr"),
        (("corrected", "lqr", PLANT, "best"), "gains", "'best'", "one of printed, computed"),
        (("corrected", "lqr", None), "EnergySwingUp.model", "None", "plant model used by the law, a CartPole"),
    ],
    ids=lambda v: "",
)
def test_unknown_names_of_the_papers_controllers_are_refused(arguments, field, value, allowed):
    with refused(field, value, allowed):
        paper.controller(*arguments)


def test_an_input_error_is_a_value_error_that_holds_its_parts():
    with pytest.raises(ValueError, match="must be") as caught:
        CartPole(cart_mass=-1.0)
    error = caught.value
    assert (type(error), error.field, error.value) == (cpjax.InputError, "CartPole.cart_mass", -1.0)
    assert error.allowed == "a finite number above 0 [kg]"


def test_the_text_of_an_input_error_stays_one_short_line():
    text = str(InputError("field", np.ones((100, 100)), "small"))
    assert "\n" not in text
    assert len(text) < 160
    assert text.startswith("field = array(")
    assert text.endswith("...: must be small")


# --- inside jit -------------------------------------------------------------------------------------------------------
# One compilation of each serves all that follows: an open supply, so that nothing is clipped before it blows up.

OPEN = dataclasses.replace(PLANT, motor=dataclasses.replace(PLANT.motor, voltage_limit=math.inf))
SWITCHING = Hybrid(EnergySwingUp(OPEN, energy_gain=2.0), LAW, LyapunovGate(np.eye(4), level=0.5))
NEAR = State(0.01, 0.0, 0.01, 0.0)
AWAY = State(0.1, 0.2, 2.5, 0.3)


@functools.partial(jax.jit, static_argnames="clock")
def hybrid_metrics(plant, controller, start, clock="sampled"):
    return measure(plant, controller, start, duration=1.0, dt=0.01, clock=clock, metrics=ProtocolMetrics(hold=0.0))


@functools.partial(jax.jit, static_argnames="clock")
def law_metrics(plant, law, start, clock="sampled"):
    return measure(plant, law, start, duration=1.0, dt=0.01, clock=clock, metrics=ProtocolMetrics(hold=0.0))


@functools.partial(jax.jit, static_argnames="clock")
def law_gradient(plant, law, start, clock="sampled"):
    def cost(plant, law):
        result = law_metrics(plant, law, start, clock)
        return result.cart_travel + result.effort, result.flag

    return jax.grad(cost, argnums=(0, 1), has_aux=True)(plant, law)


def with_nan(tree, name):
    """`tree` with NaN in every leaf whose path ends in `name`."""

    def poison(path, leaf):
        return leaf * math.nan if jax.tree_util.keystr(path).endswith(name) else leaf

    return jax.tree_util.tree_map_with_path(poison, jax.tree.map(jnp.asarray, tree))


def leaf_names(tree):
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(tree)[0]]


@rows("name", leaf_names(OPEN))
def test_a_nan_in_the_plant_under_jit_is_flagged_and_no_success(name):
    metrics = hybrid_metrics(with_nan(OPEN, name), SWITCHING, AWAY)
    assert int(metrics.flag) == Flag.NON_FINITE
    assert not bool(metrics.success)
    assert float(metrics.settling_time) == math.inf


# Not in this list: the model's own clip, which no law reads, and the hysteresis of a gate that is not yet open.
READ = [n for n in leaf_names(SWITCHING) if not n.endswith(("voltage_limit", "hysteresis"))]


@rows("name", READ)
def test_a_nan_in_the_controller_under_jit_is_flagged_and_no_success(name):
    start = NEAR if name.startswith((".regulator", ".gate")) else AWAY
    metrics = hybrid_metrics(OPEN, with_nan(SWITCHING, name), start)
    assert not bool(metrics.success)
    assert int(metrics.flag) == Flag.NON_FINITE


def test_a_nan_in_the_start_under_jit_is_flagged_and_no_success():
    for name in leaf_names(AWAY):
        metrics = hybrid_metrics(OPEN, SWITCHING, with_nan(AWAY, name))
        assert int(metrics.flag) == Flag.NON_FINITE
        assert not bool(metrics.success)


@rows("clock", ["sampled", "continuous"])
@rows("gain", [1e3, 1e6, 1e12, 1e100, 1e150, 1e300])
def test_a_hugely_stiff_gain_is_flagged_and_no_success_even_from_inside_the_bands(gain, clock):
    metrics = law_metrics(OPEN, StateFeedback(np.full(4, -gain)), NEAR, clock)
    assert int(metrics.flag) in (Flag.RUNAWAY, Flag.NON_FINITE)
    assert not bool(metrics.success)
    assert float(metrics.settling_time) == math.inf
    assert math.isfinite(float(metrics.cart_travel))


def test_the_same_run_with_a_sane_gain_is_a_success_without_a_flag():
    metrics = law_metrics(OPEN, LAW, NEAR)
    assert bool(metrics.success)
    assert int(metrics.flag) == 0


def test_a_run_that_starts_outside_the_limits_is_flagged_at_once_and_held_there():
    @jax.jit  # outside jit such a start is refused
    def run(x):
        return rollout(OPEN, LAW, State(x, 0.0, 0.0, 0.0), clock="continuous", duration=1.0, dt=0.01)

    result = run(2e3)
    assert int(result.flag) == Flag.RUNAWAY
    assert set(np.asarray(result.state.x)) == {2e3}


@pytest.mark.slow
@rows("clock", ["sampled", "continuous"])
@rows("gain", [1e3, 1e12, 1e150])  # with 1e300, d effort / d reference itself is beyond float64
def test_the_gradient_of_a_flagged_run_is_finite_where_its_parameters_are(gain, clock):
    gradient, flag = law_gradient(OPEN, StateFeedback(np.full((1, 4), -gain)), NEAR, clock)
    assert int(flag) & STOPPED
    pairs = zip(leaf_names(gradient), jax.tree.leaves(gradient), strict=True)
    assert [name for name, leaf in pairs if not np.all(np.isfinite(leaf))] == []


def test_an_angle_too_large_to_reduce_is_refused_or_flagged():
    # Beyond 2^31 quarter turns the quadrant no longer fits its integer; sine and cosine are then of some other angle.
    try:
        metrics = run(measure, start=State(0.0, 0.0, 1e12, 0.0))
    except InputError:
        return
    assert int(metrics.flag) & STOPPED
