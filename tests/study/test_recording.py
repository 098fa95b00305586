"""A sweep on disk."""

import os
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest
from extensions import dead_time

import cpjax
from cpjax import InputError, files, io, paper, read_sweep, record_sweep
from cpjax.study import recording

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)
STARTS = cpjax.sample_starts("anywhere", 70, seed=3)
SETTINGS = {"duration": 0.1, "dt": 0.002, "clock": "sampled", "block": 32}


@pytest.fixture(scope="module")
def swept():
    return cpjax.sweep(PLANT, CENTRED, STARTS, **SETTINGS)


@pytest.mark.parametrize("suffix", recording.SUFFIXES)
def test_a_file_has_the_sweeps_results_its_starts_and_where_they_come_from(suffix, swept, tmp_path):
    path = tmp_path / f"runs{suffix}"
    returned = record_sweep(path, PLANT, CENTRED, STARTS, **SETTINGS, about={"seed": 3})
    assert [p.name for p in tmp_path.iterdir()] == [path.name]  # the parts are gone
    document, columns = read_sweep(path)
    for name, found in zip(swept.__dataclass_fields__, jax.tree.leaves(swept), strict=True):
        np.testing.assert_array_equal(getattr(returned, name), found)
        np.testing.assert_array_equal(np.asarray(columns[name], dtype=float), np.asarray(found, dtype=float))
    np.testing.assert_array_equal(columns["start.theta"], STARTS.theta)
    assert document["about"] == {"seed": 3}
    assert document["run"] == {"duration": 0.1, "dt": 0.002, "clock": "sampled"}
    assert document["versions"] == files.versions()
    assert document["plant"] == io.encode(PLANT)
    assert document["controller"]["type"] == "Hybrid"
    again = tmp_path / f"again{suffix}"
    record_sweep(again, PLANT, CENTRED, STARTS, **SETTINGS, about={"seed": 3})
    assert again.read_bytes() == path.read_bytes()


def test_trajectories_go_to_a_folder_block_by_block(tmp_path):
    assert record_sweep(tmp_path / "runs", PLANT, CENTRED, STARTS, **SETTINGS, save_every=10) is None
    parts = sorted((tmp_path / "runs").glob("part-*.npz"))
    assert [part.name for part in parts] == [
        "part-000000000-000000032.npz",
        "part-000000032-000000064.npz",
        "part-000000064-000000070.npz",
    ]
    whole = cpjax.sweep(PLANT, CENTRED, STARTS, **SETTINGS, save_every=10)
    with np.load(parts[1]) as part:
        np.testing.assert_array_equal(part["state.theta"], whole.state.theta[32:64])
        np.testing.assert_array_equal(part["start.x"], STARTS.x[32:64])
        np.testing.assert_array_equal(part["metrics.effort"], whole.metrics.effort[32:64])
    assert files.read_table(tmp_path / "runs" / "sweep.json")["plant"]["type"] == "CartPole"


class InterruptedSweepError(Exception):
    pass


def test_an_interrupted_sweep_goes_on_and_ends_in_the_identical_file(tmp_path):
    computed = []

    def stop(done, total):
        computed.append(done)
        if len(computed) == 2:
            raise InterruptedSweepError

    whole, resumed = tmp_path / "whole.npz", tmp_path / "resumed.npz"
    record_sweep(whole, PLANT, CENTRED, STARTS, **SETTINGS)
    with pytest.raises(InterruptedSweepError):
        record_sweep(resumed, PLANT, CENTRED, STARTS, **SETTINGS, progress=stop)
    assert not resumed.exists()
    parts = sorted((tmp_path / "resumed.npz.parts").glob("part-*"))
    assert len(parts) == 2
    written = [part.stat().st_mtime_ns for part in parts]
    with pytest.raises(InterruptedSweepError):
        record_sweep(resumed, PLANT, CENTRED, STARTS, **SETTINGS, progress=stop_at_end)
    assert [part.stat().st_mtime_ns for part in parts] == written
    record_sweep(resumed, PLANT, CENTRED, STARTS, **SETTINGS)
    assert resumed.read_bytes() == whole.read_bytes()


def stop_at_end(done, total):
    """All parts are there, and the file is not."""
    if done == total:
        raise InterruptedSweepError


def test_parts_of_another_sweep_are_refused(tmp_path):
    path = tmp_path / "runs.npz"
    with pytest.raises(InterruptedSweepError):
        record_sweep(path, PLANT, CENTRED, STARTS, **SETTINGS, progress=lambda done, total: stop_at_end(total, total))
    others = (
        {"starts": cpjax.sample_starts("anywhere", 70, seed=4)},
        {"plant": cpjax.CartPole(cart_mass=1.1)},
        {"duration": 0.2},
    )
    for other in others:
        given = {"plant": PLANT, "controller": CENTRED, "starts": STARTS, **SETTINGS, **other}
        with pytest.raises(InputError, match="a place without the parts of other work"):
            record_sweep(path, **given)


KILLED = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import cpjax
from cpjax import paper
plant = paper.appendix_plant()
law = paper.controller("corrected-centred", "placement", plant)
starts = cpjax.sample_starts("anywhere", 3000, seed=3)
cpjax.record_sweep(sys.argv[1], plant, law, starts, duration=0.5, dt=0.002, clock="sampled", block=64)
"""


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_in_the_identical_file(tmp_path):
    whole, killed = tmp_path / "whole.npz", tmp_path / "killed.npz"
    subprocess.run([sys.executable, "-c", KILLED, str(whole)], check=True)
    parts, kills = tmp_path / "killed.npz.parts", 0
    for count in (3, 11, 29, 40):  # parts on disk when it is killed
        process = subprocess.Popen([sys.executable, "-c", KILLED, str(killed)])
        while process.poll() is None and len(list(parts.glob("part-*"))) < count:
            time.sleep(0.002)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills >= 2
    subprocess.run([sys.executable, "-c", KILLED, str(killed)], check=True)
    assert killed.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("path", ["runs.csv", "runs", 3, None])
def test_a_bad_file_name_is_refused(path):
    with pytest.raises(InputError, match=r"path .* a file name"):
        record_sweep(path, PLANT, CENTRED, STARTS, **SETTINGS)


def test_trajectories_want_a_folder():
    with pytest.raises(InputError, match="the name of a folder, without a suffix"):
        record_sweep("runs.npz", PLANT, CENTRED, STARTS, **SETTINGS, save_every=10)


@pytest.mark.parametrize(
    ("name", "content"), [("a.npz", b"x"), ("b.json", b"{}"), ("c.parquet", b"PAR1"), ("d.npz", b"")]
)
def test_a_file_that_is_none_of_its_own_is_refused(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"a file written by record_sweep|a file of arrays that cpjax wrote"):
        read_sweep(tmp_path / name)
    with pytest.raises(InputError):
        read_sweep(tmp_path / f"missing-{name}")


TWO_HOSTS = """
import sys, jax
jax.config.update("jax_enable_x64", True)
import cpjax
from cpjax import paper
cpjax.configure_cpu(devices=2)
if sys.argv[2] != "alone":
    jax.distributed.initialize(sys.argv[3], num_processes=2, process_id=int(sys.argv[2]))
    assert len(jax.devices()) == 4
plant = paper.appendix_plant()
law = paper.controller("corrected-centred", "placement", plant)
starts = cpjax.sample_starts("anywhere", 300, seed=3)
cpjax.record_sweep(sys.argv[1], plant, law, starts, duration=0.3, dt=0.002, clock="sampled", block=128)
"""


@pytest.mark.slow
def test_two_processes_write_the_file_that_one_writes(tmp_path):
    import socket

    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    one, two = tmp_path / "one.npz", tmp_path / "two.npz"

    def begin(path, *arguments):
        return subprocess.Popen([sys.executable, "-c", TWO_HOSTS, str(path), *arguments], env=environment)

    for processes in ([begin(one, "alone")], [begin(two, str(i), address) for i in range(2)]):
        assert [process.wait(timeout=120) for process in processes] == [0] * len(processes)
    assert one.read_bytes() == two.read_bytes()


def test_a_controller_of_ones_own_is_recorded_and_its_choices_tell_two_sweeps_apart(tmp_path):
    starts = cpjax.sample_starts("hanging", 64, seed=1)

    def stop(done, total):
        raise KeyboardInterrupt

    settings = {"duration": 0.1, "dt": 0.002, "block": 16}
    path = tmp_path / "sweep.npz"
    with pytest.raises(KeyboardInterrupt):
        cpjax.record_sweep(path, PLANT, dead_time.example()[0], starts, progress=stop, **settings)
    longer = dead_time.DeadTime(dead_time.example()[0].controller, 12.0, 40)
    with pytest.raises(cpjax.InputError, match="parts of other work"):
        cpjax.record_sweep(path, PLANT, longer, starts, **settings)
    found = cpjax.record_sweep(path, PLANT, dead_time.example()[0], starts, **settings)
    assert found.effort.shape == (64,)
    assert cpjax.read_sweep(path)[0]["controller"] == "DeadTime"


def test_a_changed_description_of_a_result_is_refused(tmp_path):
    path = tmp_path / "runs.json"
    starts = cpjax.sample_starts("hanging", 3, seed=1)
    law = paper.controller("corrected-centred", "placement", PLANT)
    record_sweep(path, PLANT, law, starts, duration=0.02, dt=0.01)
    whole = path.read_bytes()
    for old, new in ((b'"count": 3', b'"count": 4'), (b'"digest"', b'"digesu"'), (b'"layout"', b'"layouu"')):
        assert whole.count(old) >= 1
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(InputError):
            read_sweep(path)
    path.write_bytes(whole)
    assert read_sweep(path)[0]["count"] == 3
