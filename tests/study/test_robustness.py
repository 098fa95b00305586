"""Robustness cards: their grids against single sweeps, what counts, and the command."""

import dataclasses
import json
import math

import numpy as np
import pytest

import cpjax
from cpjax import Drive, Encoders, InputError, Rig, Track, paper
from cpjax.numeric.statistics import wilson_interval
from cpjax.plant import parameters_of
from cpjax.study.robustness import (
    RobustnessConfig,
    duration_of,
    initial_states,
    protocol_of,
    robustness_card,
    target_bands,
)

PLANT = paper.appendix_plant()
LAW = paper.controller("corrected-centred", "placement", PLANT)
SMALL = RobustnessConfig(values=3, starts=6, rigs=10, dt=0.01, control_period=0.01, seed=4)
RIG = Rig(PLANT, drive=Drive(delay=0.01), track=Track(1.5))


@pytest.fixture(scope="module")
def card():
    return robustness_card(RIG, LAW, SMALL)


def successes(rig, starts, seed=4):
    settings = {"duration": duration_of(rig, 0.01), "dt": 0.01, "control_period": 0.01, "seed": seed}
    return int(np.sum(cpjax.sweep(rig, LAW, starts, metrics=protocol_of(rig), **settings).success))


@pytest.mark.slow
def test_every_grid_of_a_card_is_the_sweep_that_it_stands_for(card):
    starts = initial_states(RIG, 6, 4)
    assert int(card.nominal.successes[0]) == successes(RIG, starts)
    by_name = {criterion.name: criterion for criterion in card.criteria}
    assert list(by_name) == ["plant", "measurement", "voltage", "lag", "delay", "pushes"]
    varied = {grid.name for grid in by_name["plant"].grids}
    assert varied == {n for n in parameters_of(PLANT) if n not in ("gravity", "static_friction_ratio")} - {
        n for n in parameters_of(PLANT) if float(getattr(PLANT, n, getattr(PLANT.motor, n, 1.0))) == 0.0
    }
    heavy = next(grid for grid in by_name["plant"].grids if grid.name == "pole_mass")
    np.testing.assert_allclose(heavy.values, [0.375, 0.5, 0.625])
    changed = dataclasses.replace(RIG, plant=dataclasses.replace(PLANT, pole_mass=0.625))
    assert int(heavy.successes[2]) == successes(changed, starts)
    (delay,) = by_name["delay"].grids
    np.testing.assert_allclose(delay.values, [0.01, 0.03, 0.05])
    late = dataclasses.replace(RIG, drive=Drive(delay=0.03))
    assert int(delay.successes[1]) == successes(late, starts)
    (lag,) = by_name["lag"].grids
    assert int(lag.successes[0]) == int(card.nominal.successes[0])
    (pushes,) = by_name["pushes"].grids
    assert float(pushes.values[2]) == pytest.approx(2.0 * 0.5 * 9.81)


@pytest.mark.slow
def test_scores_are_means_with_wilsons_intervals(card):
    for criterion in card.criteria:
        total = sum(int(np.sum(grid.successes)) for grid in criterion.grids)
        assert criterion.score == pytest.approx(total / criterion.runs)
        assert criterion.interval == wilson_interval(total, criterion.runs)
    assert card.together.trials == 10


@pytest.mark.slow
def test_delays_that_differ_between_runs_are_those_of_single_sweeps():
    starts = cpjax.sample_starts("hanging", 4, seed=2)
    settings = {"duration": 1.0, "dt": 0.002, "control_period": 0.006}
    delays = np.array([0.0, 0.002, 0.012, 0.006])
    together = cpjax.sweep(Rig(PLANT, drive=Drive(delay=delays)), LAW, starts, **settings)
    for i, delay in enumerate(delays):
        one = cpjax.State(*(float(column[i]) for column in dataclasses.astuple(starts)))
        alone = cpjax.measure(Rig(PLANT, drive=Drive(delay=float(delay))), LAW, one, **settings)
        assert float(together.effort[i]) == pytest.approx(float(alone.effort), rel=1e-9)


def test_the_protocol_of_a_rig_has_its_bands_its_track_and_its_length():
    long = cpjax.rig("quanser-ip02-long")
    assert target_bands(long) == (0.05, pytest.approx(0.05 * 2 * 0.3302))
    assert target_bands(Rig(cpjax.CartPole(pole_length=2.0))) == (0.05, 0.05)
    assert float(protocol_of(long).track_limit) == 0.40
    assert math.isinf(float(protocol_of(Rig(PLANT, track=Track(0.4, ends="stop"))).track_limit))
    assert duration_of(Rig(cpjax.CartPole(pole_length=4.0)), 0.01) > 40.0
    assert float(np.max(np.abs(initial_states(Rig(PLANT, track=Track(0.2)), 500, 1).x))) <= 0.05


@pytest.mark.slow
def test_the_command_writes_cards_and_a_picture(command, tmp_path):
    small = ("--values", "2", "--starts", "2", "--rigs", "2", "--dt", "0.01")
    result = command(
        "robustness", "--controllers", "tuned_lqr", "--rig", "quanser-ip02-medium", *small, "--out", tmp_path
    )
    assert result.code == 0
    assert "made for another plant" in result.err
    document = json.loads((tmp_path / "robustness.json").read_text())
    assert document["complete"]
    criteria = document["cards"]["tuned_lqr"]["criteria"]
    assert criteria["measurement"]["grids"][0]["unit"] == "steps"
    assert (tmp_path / "robustness.png").stat().st_size > 10_000


def test_what_no_card_can_be_is_refused_by_name(command, tmp_path):
    with pytest.raises(InputError, match="values"):
        RobustnessConfig(values=1)
    with pytest.raises(InputError, match=r"rig\.plant"):
        robustness_card(cpjax.CartPole(cart_mass=np.ones(3)), LAW, SMALL)
    with pytest.raises(InputError, match="controller"):
        robustness_card(Rig(PLANT, sensors=Encoders(1e-4, 1e-3)), LAW, SMALL)
    refused = command("robustness", "--controllers", "tuned_lqr", "tuned_lqr", "--out", tmp_path)
    assert (refused.code, "controllers" in refused.err) == (2, True)
