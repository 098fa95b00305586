"""Many starts at once: that blocks, chunks, devices and turned stage angles are only ways of working."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import columns

import cpjax
from cpjax import Flag, paper
from cpjax.errors import InputError
from cpjax.pytree import pytree

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)
SAMPLED = {"dt": 0.002, "clock": "sampled"}

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def one_by_one(starts, plant=PLANT, controller=CENTRED, **settings):
    """By `measure`, in which no stage angle is a turn away from another."""
    return jax.vmap(lambda start: cpjax.measure(plant, controller, start, **settings))(starts)


def assert_same(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.shape == y.shape
        np.testing.assert_allclose(x, y, **tolerance) if tolerance else np.testing.assert_array_equal(x, y)


@pytest.mark.slow
def test_4096_starts_of_10_s_run_under_one_vmap_within_a_gibibyte(monkeypatch):
    monkeypatch.syspath_prepend(str(EXPERIMENTS))
    start_up = importlib.import_module("start_up")  # its script runs in a process of its own
    figures = json.loads(start_up.python(start_up.SWEEP.format(count=4096, seed=3, duration=10.0)))
    assert figures["success"] > 0.98
    assert figures["peak_MiB"] < 1024


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 3e-3)])
def test_turned_stage_angles_give_what_full_ones_give(dtype, tolerance):
    starts = cpjax.sample_starts("anywhere", 64, seed=5, dtype=dtype)
    fast = cpjax.sweep(PLANT, CENTRED, starts, duration=0.5, **SAMPLED)
    assert fast.cart_travel.dtype == dtype
    assert_same(fast, one_by_one(starts, duration=0.5, **SAMPLED), rtol=tolerance, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [49.0, 51.0, 600.0])
def test_a_pole_too_fast_for_turns_is_computed_in_full(speed):
    """At 50 rad/s a step of 2 ms turns the pole by 0.1 rad."""
    starts = cpjax.State(np.zeros(3), np.zeros(3), np.array([0.3, 0.3, 3.0]), np.array([0.0, speed, -1.5 * speed]))
    batch = cpjax.sweep(PLANT, CENTRED, starts, duration=0.02, save_every=1, **SAMPLED)
    for i in range(3):
        start = jax.tree.map(lambda column, i=i: float(column[i]), starts)
        alone = cpjax.rollout(PLANT, CENTRED, start, duration=0.02, **SAMPLED)
        np.testing.assert_allclose(columns(batch.state)[i], columns(alone.state), rtol=1e-11, atol=1e-11)
        assert batch.flag[i] == batch.metrics.flag[i] == alone.flag
    assert set(np.asarray(batch.flag).tolist()) <= {0, int(Flag.RUNAWAY)}


@pytree
class Poisoned:
    """NaN beyond a speed of the cart."""

    def voltage(self, state):
        return jnp.where(jnp.abs(state.x_dot) > 1.0, jnp.nan, 3.0)


def test_runs_that_go_wrong_are_held_and_flagged_as_in_a_rollout():
    wrong = cpjax.State(np.array([0.0, 999.0]), np.array([0.0, 900.0]), np.array([3.0, 3.0]), np.zeros(2))
    slow_and_fast = cpjax.State(np.zeros(2), np.array([-1.0, 0.9]), np.array([3.0, 3.0]), np.zeros(2))
    for law, starts, flag in ((CENTRED, wrong, Flag.RUNAWAY), (Poisoned(), slow_and_fast, Flag.NON_FINITE)):
        batch = cpjax.sweep(PLANT, law, starts, duration=0.1, **SAMPLED)
        assert batch.flag.tolist() == [0, int(flag)]
        assert not batch.success[1]
        for i in range(2):
            start = jax.tree.map(lambda column, i=i: float(column[i]), starts)
            alone = cpjax.measure(PLANT, law, start, duration=0.1, **SAMPLED)
            assert_same(jax.tree.map(lambda column, i=i: column[i], batch), alone, rtol=1e-9)


def test_trajectories_are_those_of_rollouts():
    starts = cpjax.sample_starts("hanging", 5, seed=6)
    batch = cpjax.sweep(PLANT, CENTRED, starts, duration=0.3, save_every=10, block=2, **SAMPLED)
    assert batch.voltage.shape == (5, 16)
    for i in range(5):
        start = jax.tree.map(lambda column, i=i: column[i], starts)
        alone = cpjax.rollout(PLANT, CENTRED, start, duration=0.3, save_every=10, **SAMPLED)
        assert_same(jax.tree.map(lambda column, i=i: column[i], batch), alone, rtol=1e-9, atol=1e-12)


def test_each_start_may_have_its_own_plant_and_controller():
    starts = cpjax.sample_starts("anywhere", 4, seed=7)
    masses, gains = np.array([0.8, 1.0, 1.3, 1.1]), np.array([3.0, 5.0, 7.0, 4.0])
    K = np.asarray(CENTRED.regulator.K) * np.array([1.0, 0.9, 1.1, 1.05])[:, None, None]
    plants = cpjax.CartPole(cart_mass=masses)

    def law(gain, K):
        return cpjax.Hybrid(cpjax.EnergySwingUp(PLANT, energy_gain=gain), cpjax.StateFeedback(K), CENTRED.gate)

    batch = cpjax.sweep(plants, law(gains, K), starts, duration=0.5, **SAMPLED)
    for i in range(4):
        start = jax.tree.map(lambda column, i=i: float(column[i]), starts)
        rig = cpjax.CartPole(cart_mass=float(masses[i]))
        alone = cpjax.measure(rig, law(float(gains[i]), K[i]), start, duration=0.5, **SAMPLED)
        assert_same(jax.tree.map(lambda column, i=i: column[i], batch), alone, rtol=1e-9)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_batch_of_plants_of_another_length_is_refused(count):
    starts = cpjax.sample_starts("anywhere", 4, seed=7)
    with pytest.raises(InputError, match=r"plant.cart_mass .* of shape \(\); or \(4,\), one for each initial state"):
        cpjax.sweep(cpjax.CartPole(cart_mass=np.ones(count)), CENTRED, starts, duration=0.1, **SAMPLED)


def test_new_numbers_need_no_new_compilation():
    starts = cpjax.sample_starts("anywhere", 4, seed=8)
    cpjax.sweep(PLANT, CENTRED, starts, duration=0.1, **SAMPLED)
    other = paper.controller("corrected-centred", "lqr", PLANT)
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, _, **__: compiled.append(event))
    try:
        moved = cpjax.sample_starts("hanging", 4, seed=9)
        cpjax.sweep(cpjax.CartPole(cart_mass=1.2), other, moved, duration=0.05, dt=0.001, clock="sampled")
    finally:
        jax.monitoring.clear_event_listeners()
    assert [event for event in compiled if "backend_compile" in event] == []


def test_under_jit_and_differentiation_a_sweep_is_a_vmap_of_rollouts():
    starts = cpjax.sample_starts("anywhere", 3, seed=10)

    @jax.jit
    def travel(mass):
        plant = cpjax.CartPole(cart_mass=mass)
        settings = {**SAMPLED, "duration": 0.2, "derivative": "pathwise"}
        return jnp.sum(cpjax.sweep(plant, CENTRED, starts, **settings).cart_travel)

    slope = jax.grad(travel)(1.0)
    assert slope == pytest.approx(float(travel(1.0 + 1e-5) - travel(1.0 - 1e-5)) / 2e-5, rel=1e-5)


ON_DEVICES = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import cpjax
from cpjax import paper
from cpjax.backend import runtime
if sys.argv[1] == "configured":
    assert cpjax.configure_cpu(devices=8)
    assert runtime.compiler_fuses_loops()
else:
    assert not runtime.compiler_fuses_loops()
    assert len(jax.devices()) == 1
plant = paper.appendix_plant()
controller = paper.controller("corrected-centred", "placement", plant)
starts = cpjax.sample_starts("anywhere", 300, seed=4)
if sys.argv[1] == "configured":
    assert len(jax.devices()) == 8
found = cpjax.sweep(plant, controller, starts, duration=0.4, dt=0.002, clock="sampled", block=int(sys.argv[3]))
np.savez(sys.argv[2], *jax.tree.leaves(found))
"""


def in_a_process(script, *arguments):
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_with_the_compilers_options_and_on_eight_devices_a_sweep_gives_the_same(tmp_path):
    """The options change what is computed twice, and with it the last bits; the number of devices changes nothing."""
    for name, kind, block in (("plain", "plain", 1000), ("eight", "configured", 1000), ("blocks", "configured", 128)):
        in_a_process(ON_DEVICES, kind, tmp_path / f"{name}.npz", block)
    plain, eight, blocks = (np.load(tmp_path / f"{name}.npz") for name in ("plain", "eight", "blocks"))
    for key in plain.files:
        np.testing.assert_array_equal(eight[key], blocks[key])
        np.testing.assert_allclose(eight[key], plain[key], rtol=1e-9, atol=1e-12)
