"""Damages to the files of long computations: are they noticed, and does the next run go on?

    python experiments/damages.py

Each case is a computation that was stopped when some of its parts were done, or a result on disk. One file of it is
damaged at random (a bit, a missing end, a block of zeros, two blocks swapped, foreign content, another part's content,
a dangling link, a folder in its place), and the computation runs again, or the result is read again. It must end in the
result of an undamaged run, or be refused by name (`InputError`). Counts both; anything else is an error.
"""

import collections
import contextlib
import hashlib
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import optax
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table
from cpjax.paper import reproduction
from cpjax.tune.checkpoint import TunerState, restore, store
from cpjax.workspace import Workspace

KINDS = ("a bit", "end missing", "zeros", "swapped blocks", "foreign", "another file", "dangling link", "folder")
OUTCOMES = ("same result", "refused", "wrong result")


class StopError(Exception):
    """Ends a computation where its parts are on disk and its result is not."""


class Case(NamedTuple):
    """A computation or a result on disk."""

    make: Callable[[Path], None]
    """Leaves the files in a folder."""
    again: Callable[[Path], str]
    """Runs or reads again; returns a fingerprint of the result."""


def _fingerprint(columns: Any) -> str:
    return hashlib.sha256(files.dump_json(columns).encode()).hexdigest()


def _sweep(suffix: str, trajectories: bool = False) -> Case:
    plant, law = paper.appendix_plant(), cpjax.preset("lqr")
    starts = cpjax.sample_starts("anywhere", 24, seed=3)

    def record(folder: Path, stop: int | None = None) -> None:
        def progress(done: int, total: int) -> None:
            if done == stop:
                raise StopError

        settings: dict[str, Any] = {"duration": 0.02, "dt": 2e-3, "block": 8, "progress": progress}
        if trajectories:
            settings["save_every"] = 5
        cpjax.record_sweep(folder / f"runs{suffix}", plant, law, starts, **settings)

    def make(folder: Path) -> None:
        with contextlib.suppress(StopError):
            record(folder, stop=16)

    def again(folder: Path) -> str:
        record(folder)
        if not trajectories:
            return _fingerprint(cpjax.read_sweep(folder / f"runs{suffix}"))
        # The arrays, not the bytes: a ZIP file has bytes without a meaning, such as a member's date.
        parts = [np.load(part) for part in sorted((folder / "runs").glob("part-*.npz"))]
        return _fingerprint([{name: part[name] for name in part.files} for part in parts])

    return Case(make, again)


def _result(suffix: str) -> Case:
    whole = _sweep(suffix)

    def make(folder: Path) -> None:
        whole.again(folder)

    def again(folder: Path) -> str:
        return _fingerprint(cpjax.read_sweep(folder / f"runs{suffix}"))

    return Case(make, again)


def _reproduction() -> Case:
    setting = reproduction.EvaluationConfig(count=2, duration=1.5, dt=0.01)
    rows = reproduction.reproduce(setting)

    def reproduce(folder: Path, stop: int | None = None) -> str:
        numbers = iter(range(len(rows)))
        known = reproduction.evaluate

        def evaluate(*arguments: Any) -> Any:
            if next(numbers) == stop:
                raise StopError
            return known(*arguments)

        reproduction.evaluate = evaluate  # type: ignore[assignment]  # takes what it passes on
        try:
            return _fingerprint(reproduction.reproduce(setting, path=folder / "reproduction.json"))
        finally:
            reproduction.evaluate = known

    def make(folder: Path) -> None:
        with contextlib.suppress(StopError):
            reproduce(folder, stop=30)

    return Case(make, reproduce)


def _workspace() -> Case:
    """The parts of maps and fronts, which are arrays with a note."""

    def work(folder: Path, stop: bool = False) -> str:
        with Workspace(folder / "parts", {"seed": 1}) as memory:
            for name in ("first", "second"):
                if memory.load(name) is None:
                    memory.save(name, {"x": np.linspace(0.0, 1.0, 40), "ok": np.ones(40, bool)}, {"supplies": [12.0]})
            if stop:
                raise StopError
            found = [memory.load(name) for name in ("first", "second")]
        return _fingerprint(found)

    def make(folder: Path) -> None:
        with contextlib.suppress(StopError):
            work(folder, stop=True)

    return Case(make, work)


def _checkpoint() -> Case:
    optimiser = optax.adam(0.1)
    vectors = np.linspace(0.0, 1.0, 12).reshape(3, 4)
    state = TunerState(
        7, vectors, optimiser.init(jnp.asarray(vectors)), vectors, vectors[:, 0], 1, [{"score": -np.inf}], 10, 20
    )

    def make(folder: Path) -> None:
        store(folder / "checkpoint.npz", "this", state)

    def again(folder: Path) -> str:
        found = restore(folder / "checkpoint.npz", "this", optimiser)
        found = state if found is None else found  # a tuning begins anew, and ends in the same controller
        return _fingerprint([found.step, found.vectors, found.best, found.scores, found.history, found.stale])

    return Case(make, again)


CASES: dict[str, Callable[[], Case]] = {
    "sweep to NPZ, interrupted": lambda: _sweep(".npz"),
    "sweep to Parquet, interrupted": lambda: _sweep(".parquet"),
    "trajectories, interrupted": lambda: _sweep("", trajectories=True),
    "reproduction, interrupted": _reproduction,
    "maps and fronts, interrupted": _workspace,
    "tuning, its checkpoint": _checkpoint,
    "result in NPZ": lambda: _result(".npz"),
    "result in Parquet": lambda: _result(".parquet"),
    "result in JSON": lambda: _result(".json"),
}


def damage(path: Path, others: list[Path], kind: str, random: np.random.Generator) -> None:
    """Damages one file."""
    content = bytearray(path.read_bytes())
    place = int(random.integers(max(1, len(content))))
    if kind == "a bit" and content:
        content[place] ^= 1 << int(random.integers(8))
    elif kind == "end missing":
        del content[place:]
    elif kind == "zeros":
        content[place : place + 64] = bytes(len(content[place : place + 64]))
    elif kind == "swapped blocks" and len(content) > 128:
        first, second = sorted(random.integers(0, len(content) - 32, 2).tolist())
        content[first : first + 32], content[second : second + 32] = (
            content[second : second + 32],
            content[first : first + 32],
        )
    elif kind == "foreign":
        content = bytearray(random.bytes(place))
    elif kind == "another file" and others:
        content = bytearray(others[int(random.integers(len(others)))].read_bytes())
    elif kind in ("dangling link", "folder"):
        path.unlink()
        path.mkdir() if kind == "folder" else path.symlink_to(path.with_name("nowhere"))
        return
    path.write_bytes(content)


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes damages.json."""
    random = np.random.default_rng(seed)
    times = 12 if quick else 560
    rows = []
    for name, build in CASES.items():
        case = build()
        counts: collections.Counter[str] = collections.Counter()
        with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
            warnings.simplefilter("ignore", cpjax.DamagedFileWarning)
            template = Path(place) / "template"
            template.mkdir()
            case.make(template)
            undamaged = Path(place) / "undamaged"
            shutil.copytree(template, undamaged)
            expected = case.again(undamaged)
            for number in range(times):
                folder = Path(place) / str(number)
                shutil.copytree(template, folder)
                found = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
                path, kind = found[int(random.integers(len(found)))], KINDS[int(random.integers(len(KINDS)))]
                damage(path, [other for other in found if other != path], kind, random)
                try:
                    same = case.again(folder) == expected
                except cpjax.InputError:
                    counts[OUTCOMES[1]] += 1
                else:
                    counts[OUTCOMES[0] if same else OUTCOMES[2]] += 1
                    if not same:
                        print(f"{name}: {kind} in {path.name} was taken", file=sys.stderr)
                shutil.rmtree(folder)
        rows.append({"case": name, "damages": times, **{key: counts[key] for key in OUTCOMES}})
        print(f"{name}: {dict(counts)}", file=sys.stderr)
    print_table(
        "Damages", ("case", "damages", *OUTCOMES), [tuple(str(value) for value in row.values()) for row in rows], 1
    )
    files.write_json(out / "damages.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


if __name__ == "__main__":
    run(main, __doc__ or "")
