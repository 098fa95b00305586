"""Workspaces: what is done stays after an interruption, is used by the same work alone, and damages are noticed."""

import subprocess
import sys

import numpy as np
import pytest

from cpjax import DamagedFileWarning, InputError
from cpjax.workspace import Workspace, intact


def work(folder, request, name=None, stop=None):
    """What a computation finds in its workspace; it saves one part, and may be stopped."""
    with Workspace(folder, request) as memory:
        found = [each for each in ("first", "second") if memory.load(each) is not None]
        if name:
            memory.save(name, {"x": np.arange(3.0)}, {"done": name})
        if stop:
            raise stop
    return found


def test_parts_stay_when_the_work_is_stopped_and_are_refused_to_any_other(tmp_path):
    folder = tmp_path / "parts"
    with pytest.raises(KeyboardInterrupt):
        work(folder, {"seed": 1}, None, KeyboardInterrupt())
    assert not folder.exists()  # nothing was saved
    with pytest.raises(ZeroDivisionError):
        work(folder, {"seed": 1}, "first", ZeroDivisionError())
    with pytest.raises(InputError, match=f"path = '{folder}': must be a place without the parts of other work"):
        work(folder, {"seed": 2}, "second")
    assert work(folder, {"seed": 1}, "second") == ["first"]
    assert not folder.exists()
    assert work(folder, {"seed": 2}, "first") == []


def test_a_request_alone_in_its_folder_gives_way(tmp_path):
    (tmp_path / "request.json").write_text("{}")
    assert work(tmp_path / "parts", {"seed": 2}) == []


def stopped(folder, *names):
    """Leaves a workspace with these parts."""
    for name in names:
        with pytest.raises(ZeroDivisionError):
            work(folder, {"seed": 1}, name, ZeroDivisionError())


def test_a_damaged_request_does_not_lose_the_parts(tmp_path):
    folder = tmp_path / "parts"
    stopped(folder, "first", "second")
    (folder / "request.json").write_bytes(b"\x00")
    assert work(folder, {"seed": 1}) == ["first", "second"]


@pytest.mark.parametrize("kind", ["damaged", "swapped", "of other work", "a folder", "a dangling link"])
def test_a_part_that_is_not_this_one_is_set_aside_and_made_again(kind, tmp_path):
    folder = tmp_path / "parts"
    stopped(folder, "first", "second")
    part = folder / "first.npz"
    if kind == "damaged":
        part.write_bytes(part.read_bytes()[:-1])
    elif kind == "swapped":
        part.write_bytes((folder / "second.npz").read_bytes())
    elif kind == "of other work":
        with pytest.raises(ZeroDivisionError):
            work(tmp_path / "other", {"seed": 2}, "first", ZeroDivisionError())
        part.write_bytes((tmp_path / "other" / "first.npz").read_bytes())
    else:
        part.unlink()
        part.mkdir() if kind == "a folder" else part.symlink_to(tmp_path / "nowhere")
    with pytest.warns(DamagedFileWarning, match=r"It is first\.npz\.[0-9a-f]{8}\.damaged now"):
        assert work(folder, {"seed": 1}, "first") == ["second"]
    assert [path.suffix for path in folder.iterdir()] == [".damaged"]  # all that is left
    assert work(folder, {"seed": 3}) == []  # and in nobody's way


def test_files_of_others_are_neither_used_nor_lost(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt in it is of such work"):
        work(tmp_path, {"seed": 1})
    with Workspace(tmp_path / "parts", {"seed": 1}) as memory:
        memory.save("first", {})
        (tmp_path / "parts" / "notes.txt").write_text("mine")
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["notes.txt"]


def test_two_at_once_are_refused_and_a_killed_one_leaves_no_lock(tmp_path):
    folder = tmp_path / "parts"
    hold = (
        "import os, pathlib, sys; from cpjax.workspace import Workspace; "
        "w = Workspace(pathlib.Path(sys.argv[1]), {'seed': 1}); w.save('first', {}); print('ready', flush=True); "
        "sys.stdin.read(); os._exit(9)"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", hold, str(folder)], **pipes) as process:
        assert process.stdout.readline() == "ready\n"
        with pytest.raises(InputError, match="a folder in which no other process works"):
            work(folder, {"seed": 1})
    assert process.returncode == 9
    assert work(folder, {"seed": 1}) == ["first"]


def test_a_stopped_removal_leaves_nothing_that_could_be_taken_for_parts(tmp_path, monkeypatch):
    folder = tmp_path / "parts"

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("shutil.rmtree", stop)
        with pytest.raises(KeyboardInterrupt):
            work(folder, {"seed": 1}, "first")
    assert not folder.exists()


def test_parts_that_a_resumed_run_did_not_need_are_removed_too(tmp_path):
    stopped(tmp_path / "parts", "unneeded")
    assert work(tmp_path / "parts", {"seed": 1}) == []
    assert not (tmp_path / "parts").exists()


def test_the_left_over_of_a_killed_write_is_removed_too(tmp_path):
    stopped(tmp_path / "parts", "first")
    (tmp_path / "parts" / ".first.npz.12-ab").write_bytes(b"half")
    assert work(tmp_path / "parts", {"seed": 1}) == ["first"]
    assert not (tmp_path / "parts").exists()


def test_a_workspace_at_an_impossible_place_is_bad_input(tmp_path):
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file" / "parts", tmp_path / ("o" * 300)):
        with pytest.raises(InputError, match="a place that can be written"):
            Workspace(place, {})


def test_a_missing_file_is_nothing_to_warn_of(tmp_path):
    assert intact(tmp_path / "missing.npz", lambda path: path) is None
