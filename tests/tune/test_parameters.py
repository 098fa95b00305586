import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.controllers import AngleRateGate, EnergySwingUp, Hybrid, LqrWeights, LyapunovGate, PoleFactors, StateFeedback
from cpjax.errors import InputError
from cpjax.paper.initial import initial_controller
from cpjax.plant import linearize
from cpjax.tune.baseline import baseline
from cpjax.tune.parameters import free_parameters
from cpjax.tune.tuner import fastest_pole_bound

PLANT = paper.appendix_plant()
DESIGNS = ("lqr", "placement")


@pytest.mark.slow
@pytest.mark.parametrize(("design", "full_q"), [("lqr", False), ("lqr", True), ("placement", False)])
def test_the_starting_vector_makes_the_controller_again(design, full_q):
    begun = baseline(design, PLANT)
    free = free_parameters(begun, full_q=full_q)
    made = free.build(free.start())
    np.testing.assert_allclose(made.regulator.K, begun.regulator.K, rtol=1e-9)
    assert float(made.gate.half_angle) == pytest.approx(0.5, rel=1e-12)
    assert float(made.swing_up.energy_gain) == pytest.approx(3.0, rel=1e-12)
    assert len(free.labels) == free.physical(free.start()).shape[0] == free.start().shape[0]


@pytest.mark.slow
@pytest.mark.parametrize("design", DESIGNS)
def test_any_vector_makes_a_stable_regulator_and_a_gate_within_its_range(design):
    free = free_parameters(baseline(design, PLANT))
    A, B = cpjax.linearize(PLANT)
    for vector in free.draw(np.random.default_rng(0), 20):
        made = free.build(jnp.asarray(vector))
        assert np.all(np.linalg.eigvals(np.asarray(A - B @ made.regulator.K)).real < 0.0)
        assert 0.0 < float(made.gate.half_angle) < math.pi


@pytest.mark.slow
@pytest.mark.parametrize("design", DESIGNS)
def test_gradients_pass_through_the_design(design):
    free = free_parameters(baseline(design, PLANT))

    def gain(vector):
        return jnp.sum(free.build(vector).regulator.K)

    start, step = free.start(), 1e-5
    slope = jax.grad(gain)(start)
    for i in range(start.shape[0]):
        move = jnp.zeros_like(start).at[i].set(step)
        difference = (gain(start + move) - gain(start - move)) / (2 * step)
        assert float(slope[i]) == pytest.approx(float(difference), rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(slope, jax.jacfwd(gain)(start), rtol=1e-9, atol=1e-9)


def test_a_lyapunov_gate_has_the_designs_own_form():
    begun = baseline("lqr", PLANT)
    found = begun.regulator.design.solve(*cpjax.linearize(PLANT))
    gated = Hybrid(begun.swing_up, begun.regulator, LyapunovGate(found.P, 50.0))
    free = free_parameters(gated)
    made = free.build(free.start() + 0.3)
    np.testing.assert_allclose(made.gate.P, made.regulator.design.solve(*cpjax.linearize(PLANT)).P, rtol=1e-9)


def test_zeros_start_small_and_frozen_names_stay():
    free = free_parameters(initial_controller("paper", "lqr", PLANT), frozen=["energy_gain"])
    made = free.build(free.start())
    assert 0.0 < float(made.swing_up.cart_stiffness) < 0.1
    assert float(made.swing_up.energy_gain) == paper.ENERGY_GAIN
    assert "energy_gain" not in free.labels


@pytest.mark.parametrize(
    ("arguments", "field"),
    [({"free": ["nonsense"]}, "free"), ({"frozen": ["a"]}, "frozen"), ({"free": ["Q"], "frozen": ["Q"]}, "free")],
)
def test_a_wrong_name_is_named(arguments, field):
    with pytest.raises(InputError) as caught:
        free_parameters(baseline("lqr", PLANT), **arguments)
    assert caught.value.field == field


def test_a_regulator_without_its_design_is_refused():
    law = EnergySwingUp(PLANT, energy_gain=3.0)
    with pytest.raises(InputError, match="design"):
        free_parameters(Hybrid(law, StateFeedback([1.0, 1.0, 1.0, 1.0]), AngleRateGate(0.5, 6.0)))


def test_a_design_is_saved_beside_its_gain(tmp_path):
    regulator = baseline("lqr", PLANT).regulator
    cpjax.save(tmp_path / "law.json", regulator)
    loaded = cpjax.load(tmp_path / "law.json")
    assert isinstance(loaded.design, LqrWeights)
    np.testing.assert_array_equal(loaded.design.Q, regulator.design.Q)


def test_factors_of_poles_have_these_poles_and_want_four_stable_ones():
    factors = PoleFactors.from_poles([-3.0, -4.0, -5.0 + 2.0j, -5.0 - 2.0j])
    np.testing.assert_allclose(np.sort_complex(factors.poles), [-5.0 - 2.0j, -5.0 + 2.0j, -4.0, -3.0], rtol=1e-12)
    np.testing.assert_allclose(factors.polynomial, np.poly(factors.poles).real[1:], rtol=1e-12)
    for poles in ([-1.0, -2.0, -3.0], [-1.0, -2.0, -3.0, 4.0]):
        with pytest.raises(InputError, match="poles"):
            PoleFactors.from_poles(poles)


def test_the_pole_bound_is_a_bound_and_a_close_one():
    random = np.random.default_rng(3)
    for _ in range(50):
        A = random.standard_normal((4, 4)) * 10.0 ** random.uniform(-1, 2)
        fastest = np.max(np.abs(np.linalg.eigvals(A)))
        bound = float(fastest_pole_bound(jnp.asarray(A)))
        assert fastest * (1 - 1e-9) <= bound <= 1.15 * fastest
    # |3^64 I|^(1/64) = 3 x 2^(1/64)
    assert float(fastest_pole_bound(jnp.diag(jnp.full(4, -3.0)))) == pytest.approx(3.0 * 2.0 ** (1 / 64))
    tiny = 1e-3 * jnp.eye(4)
    slope = jax.grad(fastest_pole_bound)(tiny)
    assert float(jnp.sum(slope * tiny)) == pytest.approx(float(fastest_pole_bound(tiny)))  # homogeneous (Euler)
    assert np.all(np.isfinite(jax.grad(fastest_pole_bound)(jnp.zeros((4, 4)))))


def test_a_small_weight_that_is_not_zero_is_kept():
    begun = baseline("lqr", PLANT)
    weights = dataclasses.replace(begun.regulator.design, R=1e-7, Q=np.diag([1e-9, 1.0, 1.0, 1.0]))
    law = dataclasses.replace(
        begun, regulator=dataclasses.replace(begun.regulator, design=weights, K=weights.solve(*linearize(PLANT)).K)
    )
    free = free_parameters(law, frozen=[], free=["R", "Q"])
    made = free.build(free.start())
    np.testing.assert_allclose(made.regulator.design.Q, weights.Q, rtol=1e-9)
    assert float(made.regulator.design.R) == pytest.approx(1e-7, rel=1e-9)


def test_half_angle_and_hysteresis_may_be_free_together():
    """The gate's rule: half_angle (1 + hysteresis) at most pi. The vector may be anything, the gate may not."""
    begun = baseline("placement", PLANT)
    law = dataclasses.replace(begun, gate=AngleRateGate(1.5, 6.0, hysteresis=0.9))
    free = free_parameters(law, free=["half_angle", "hysteresis"])
    made = free.build(free.start())
    assert float(made.gate.half_angle) == pytest.approx(1.5)
    assert float(made.gate.hysteresis) == pytest.approx(0.9)
    for vector in np.random.default_rng(0).normal(0.0, 4.0, (50, 2)):
        gate = free.build(jnp.asarray(vector)).gate
        assert 0.0 < float(gate.half_angle * (1.0 + gate.hysteresis)) <= math.pi


def test_full_q_is_for_a_free_q():
    with pytest.raises(InputError, match="full_q"):
        free_parameters(baseline("placement", PLANT), full_q=True)
    begun = baseline("lqr", PLANT)
    Q = np.diag([10.0, 1.0, 10.0, 1.0])
    Q[0, 2] = Q[2, 0] = 1.0
    weights = dataclasses.replace(begun.regulator.design, Q=Q)
    law = dataclasses.replace(begun, regulator=dataclasses.replace(begun.regulator, design=weights))
    with pytest.raises(InputError, match="full_q"):
        free_parameters(law)


def test_a_short_track_is_tried_with_gentler_pumping_too():
    free = free_parameters(baseline("lqr", PLANT))
    random = np.random.default_rng(3)
    least = {short: np.min(free.draw(random, 4000, short_track=short)[:, 0]) for short in (False, True)}
    assert free.labels[0] == "energy_gain"
    assert least[True] - least[False] == pytest.approx(math.log(0.2), abs=0.05)


@pytest.mark.parametrize("name", ["baseline", "bland", "paper"])
@pytest.mark.parametrize("design", ["lqr", "placement"])
def test_an_initial_controller_may_have_the_level_set_of_its_own_design(name, design):
    made = initial_controller(name, design, PLANT, "lyapunov")
    assert free_parameters(made).labels[-1] == "level"
    found = made.regulator.design.solve(*linearize(PLANT))
    np.testing.assert_array_equal(made.gate.P, found.P)
    with pytest.raises(InputError, match="gate"):
        initial_controller(name, design, PLANT, "square")
