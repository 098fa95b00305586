import dataclasses
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

import cpjax
from cpjax import paper
from cpjax.errors import InputError
from cpjax.tune.baseline import baseline
from cpjax.tune.checkpoint import restore, store
from cpjax.tune.config import AGGREGATES, TuningConfig
from cpjax.tune.parameters import free_parameters
from cpjax.tune.plants import UNCERTAIN, sample_plants
from cpjax.tune.tuner import _Tuner, tune

PLANT = paper.appendix_plant()
SMALL = TuningConfig(
    candidates=6, screening=2, restarts=4, batch=2, steps=4, validate_every=2, validation=4, final=4,
    duration=2.0, horizon=3.0, final_horizon=3.0, final_dt=0.005,
)  # fmt: skip


@pytest.fixture(scope="module")
def tuner():
    return _Tuner(PLANT, free_parameters(baseline("placement", PLANT)), SMALL)


@pytest.mark.slow
def test_stopped_at_any_checkpoint_it_ends_in_the_same_bits(tuner, tmp_path):
    """Each memory goes through a file before the next step, and must change nothing."""
    whole = stopped = tuner.begin()
    while whole.step < SMALL.steps:
        path = tmp_path / f"{whole.step}.npz"
        store(path, tuner.identity, stopped)
        stopped = tuner.advance(restore(path, tuner.identity, tuner.optimiser))
        whole = tuner.advance(whole)
    np.testing.assert_array_equal(whole.vectors, stopped.vectors)
    np.testing.assert_array_equal(whole.best, stopped.best)
    assert json.dumps(whole.history) == json.dumps(stopped.history)  # NaN is NaN there
    a, b = tuner.finish(whole, 0.0), tuner.finish(stopped, 0.0)
    np.testing.assert_array_equal(a.vector, b.vector)
    assert a.score == b.score
    assert np.all(np.isfinite(a.vector))


@pytest.mark.slow
def test_a_checkpoint_of_another_tuning_is_refused(tuner, tmp_path):
    path = tmp_path / "checkpoint.npz"
    store(path, tuner.identity, tuner.begin())
    other = dataclasses.replace(SMALL, seed=2)
    with pytest.raises(InputError, match="same tuning"):
        tune(PLANT, tuner.free, other, checkpoint=path)


def test_a_damaged_checkpoint_is_set_aside_and_one_of_another_kind_too(tuner, tmp_path):
    path = tmp_path / "checkpoint.npz"
    store(path, tuner.identity, tuner.begin())
    whole = path.read_bytes()
    with np.load(path) as content:
        arrays = dict(content)
    damaged = [whole[: len(whole) // 2], b"not a checkpoint"]
    for name, changed in (("vectors", arrays["vectors"] + 1e-9), ("cpjax", np.asarray('{"identity": 1}'))):
        np.savez(path, **{**arrays, name: changed})
        damaged.append(path.read_bytes())
    for number, content in enumerate(damaged):
        path.write_bytes(content)
        with pytest.warns(cpjax.DamagedFileWarning, match=r"checkpoint\.npz\.[0-9a-f]{8}\.damaged now"):
            assert restore(path, tuner.identity, tuner.optimiser) is None
        assert not path.exists()
        assert len([*tmp_path.iterdir()]) == number + 1  # nothing is lost


def test_candidates_are_compared_on_more_starts_and_the_given_controller_stays(monkeypatch):
    free = free_parameters(baseline("placement", PLANT))
    asked, seen = [], []

    def by_first_parameter(tuner, vectors, count, purpose):
        asked.append((len(vectors), count))
        seen.append(vectors[:, 0])
        return vectors[:, 0], np.ones(len(vectors)), np.ones(len(vectors))

    monkeypatch.setattr(_Tuner, "_score", by_first_parameter)
    plan = dataclasses.replace(SMALL, candidates=255, restarts=2, screening=1)
    memory = _Tuner(PLANT, free, plan).begin()
    assert asked == [(256, 1), (64, 4), (16, 16), (2, SMALL.validation)]
    np.testing.assert_array_equal(memory.vectors[0], np.asarray(free.start()))
    assert memory.vectors[1, 0] == np.min(seen[0][1:])
    steps = sum(n * (count * 375 + count // 8 * (100 + SMALL.spare_steps)) for n, count in asked)
    assert memory.value_steps == steps


@pytest.mark.slow
def test_a_law_whose_crossings_cannot_be_located_scores_as_one_that_fails():
    free = free_parameters(baseline("placement", PLANT))
    scores = {}
    for spare in (0.0, 32.0):
        tuner = _Tuner(PLANT, free, dataclasses.replace(SMALL, spare_rate=spare, horizon=8.0))
        found, rates, _ = tuner._score(np.asarray(free.start())[None], 16, 1)
        assert rates[0] == 1.0
        scores[spare] = found[0]
    assert scores[32.0] < 8.0
    assert scores[0.0] == pytest.approx(scores[32.0] + 30.0 * 8.0)


@pytest.mark.parametrize(("resample", "batches"), [(1, [0, 1, 2, 3]), (2, [0, 0, 1, 1]), (0, [0, 0, 0, 0])])
def test_starts_are_drawn_anew_as_often_as_the_plan_says(resample, batches, monkeypatch):
    tuner = _Tuner(
        PLANT,
        free_parameters(baseline("placement", PLANT)),
        dataclasses.replace(SMALL, resample=resample, validate_every=4, candidates=1, restarts=1),
    )
    seen = []

    def scored(tuner, vectors, count, purpose):
        return vectors[:, 0], np.ones(len(vectors)), np.ones(len(vectors))

    def gradient(vectors, starts, plants, width):
        seen.append(float(starts.theta[0]))
        return jnp.zeros(vectors.shape[0]), jnp.zeros_like(vectors)

    monkeypatch.setattr(_Tuner, "_score", scored)
    monkeypatch.setattr(tuner, "gradient", gradient)
    tuner.advance(tuner.begin())
    assert [seen.index(one) for one in seen] == [batches.index(one) for one in batches]


@pytest.mark.parametrize("aggregate", AGGREGATES)
def test_a_batch_is_aggregated_as_the_plan_says(aggregate):
    values = jnp.asarray([1.0, 2.0, 6.0])
    plan = TuningConfig(aggregate=aggregate, tail=0.34, temperature=0.1, threshold=4.0)
    expected = {"tail": 6.0, "soft-maximum": 6.0 - 0.1 * math.log(3.0), "success-weighted": 1.5}[aggregate]
    assert float(plan.aggregated(values)) == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_a_start_that_cannot_be_simulated_does_no_harm(tuner):
    starts, _ = tuner._draw(2, 1, 0)
    bad = dataclasses.replace(starts, theta_dot=jnp.asarray([0.1, jnp.nan]))
    vectors = jnp.asarray(tuner.begin().vectors)
    loss, slope = tuner.gradient(vectors, bad, None, jnp.asarray(0.2, vectors.dtype))
    assert np.all(np.isfinite(slope))
    assert np.all(np.isfinite(loss))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("starts", "nowhere"),
        ("batch", 0),
        ("learning_rate", -1.0),
        ("dt", 0.7),
        ("plant_spread", 1.0),
        ("steps", 1.5),
        ("aggregate", "best"),
    ],
)
def test_a_bad_plan_is_refused(field, value):
    with pytest.raises(InputError):
        TuningConfig(**{field: value})


@pytest.mark.parametrize(
    ("step", "field"), [("horizon_dt", "horizon"), ("final_dt", "final_horizon"), ("dt", "duration")]
)
def test_a_length_that_is_no_whole_number_of_steps_has_its_own_name(step, field):
    with pytest.raises(InputError) as caught:
        TuningConfig(**{step: 0.7})
    assert caught.value.field == field


def test_plants_are_drawn_within_their_spread():
    plants = sample_plants(PLANT, 200, spread=0.2, seed=1)
    units = {"cart_friction": PLANT.motor.damping, "pivot_friction": 0.4 * math.sqrt(0.5 * 9.81 * 0.7 * 0.5 * 0.7**2)}
    for name in UNCERTAIN:
        part = PLANT.motor if hasattr(PLANT.motor, name) else PLANT
        drawn = getattr(plants.motor if part is PLANT.motor else plants, name)
        nominal = float(getattr(part, name))
        if nominal == 0.0:  # the paper's plant has no friction: a share of nothing is nothing
            assert 0.0 <= np.min(drawn) < np.max(drawn) <= 0.2 * units[name]
            continue
        assert drawn.shape == (200,)
        assert np.all(np.abs(drawn - nominal) <= 0.2 * nominal + 1e-12)
    one = sample_plants(PLANT, 5, spread=0.2, seed=1, only="pole_mass")
    assert np.all(one.cart_mass == 1.0)
    assert np.std(one.pole_mass) > 0.0
    with pytest.raises(InputError):
        sample_plants(PLANT, 5, spread=0.2, seed=1, only="gravity")
