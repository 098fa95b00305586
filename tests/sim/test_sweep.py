"""Many starts at once: what one chunk may cost, and that chunks are only a way of working."""

import importlib
import json
from pathlib import Path

import jax
import numpy as np
import pytest

import cpjax
from cpjax import paper

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def test_4096_starts_of_10_s_run_under_one_vmap_within_a_gibibyte(monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    start_up = importlib.import_module("start_up")  # its script runs in a process of its own
    figures = json.loads(start_up.python(start_up.SWEEP.format(count=4096, seed=3, duration=10.0)))
    assert figures["success"] > 0.98
    assert figures["peak_MiB"] < 1024


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_chunk():
    starts = cpjax.sample_starts("anywhere", 7, seed=4)
    settings = {"duration": 1.0, "dt": 0.002, "clock": "continuous"}
    whole = cpjax.sweep(PLANT, CENTRED, starts, **settings)
    for chunk in (1, 3, 7, 100):
        parts = cpjax.sweep(PLANT, CENTRED, starts, chunk=chunk, **settings)
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(parts), strict=True):
            assert a.shape == b.shape == (7,)
            np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_batch_of_plants_and_controllers_runs_under_vmap():
    masses = np.array([0.8, 1.0, 1.3])
    gains = np.array([3.0, 5.0, 7.0])

    def travel(mass, gain):
        rig = cpjax.CartPole(cart_mass=mass)
        law = cpjax.EnergySwingUp(rig, energy_gain=gain)
        return cpjax.measure(rig, law, cpjax.HANGING, duration=0.5, dt=0.005).cart_travel

    batch = jax.vmap(travel)(masses, gains)
    alone = [float(travel(m, g)) for m, g in zip(masses.tolist(), gains.tolist(), strict=True)]
    np.testing.assert_allclose(batch, alone, rtol=1e-9)
    assert len(set(np.round(alone, 6))) == 3
