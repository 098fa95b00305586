"""Long commands killed (SIGKILL) at random moments and started again, and two equal ones at once.

    python experiments/kill_and_resume.py

Ten kills of each command, each in a folder of its own. All results have to be those of a run that was never stopped,
byte for byte but for the times that a result tells. Of two equal commands at once in one folder, one may be refused.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import run

from cpjax import files
from cpjax.cli.tables import print_table

COMMANDS: dict[str, tuple[str, str, str]] = {
    "tune": (
        "tuned.json",
        "--design placement --candidates 32 --restarts 4 --batch 8 --steps 40 --duration 2",
        "--design placement --candidates 32 --restarts 4 --batch 2 --steps 5 --duration 1",
    ),
    "sweep": ("metrics.npz", "--count 600000 --duration 4 --precision float32", "--count 2000 --duration 0.5"),
    "basin": ("basin.json", "--cells 256 --duration 2", "--cells 16 --duration 0.5"),
    "reproduce": ("reproduction.json", "--count 2000 --duration 4", "--count 20 --duration 1.5"),
    "pareto": (
        "pareto.json",
        "--bounds 2 --candidates 256 --steps 4 --batch 8 --final 256 --supplies 12",
        "--bounds 2 --candidates 64 --steps 2 --batch 8 --final 16 --supplies 12",
    ),
}
"""By command: the file of its result, and its options for this experiment and for its quick version."""


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes kill_and_resume.json."""
    random = np.random.default_rng(seed)
    rows = []
    for command in ("tune",) if quick else COMMANDS:
        folder = out / command
        _end(_begin(command, folder / "warm", out, quick))  # fills the compiler's cache
        began = time.monotonic()
        _end(_begin(command, folder / "whole", out, quick))
        length = time.monotonic() - began
        expected = _result(command, folder / "whole")
        row: dict[str, Any] = {"command": command, "length": length, "kills": 0, "with_parts": 0, "identical": 0}
        for i in range(1 if quick else 10):
            place = folder / f"killed-{i}"
            process = _begin(command, place, out, quick)
            try:
                process.wait(float(random.uniform(0.1, 0.9) * length))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                row["kills"] += 1
                row["with_parts"] += any(place.rglob("*.npz"))
            _end(_begin(command, place, out, quick))
            row["identical"] += _result(command, place) == expected
        two = [_begin(command, folder / "two", out, quick) for _ in range(2)]
        codes = sorted(_end(process, refused_is_fine=True) for process in two)
        row |= {"two_at_once": codes, "result_of_two_identical": _result(command, folder / "two") == expected}
        rows.append(row)
        print(row, file=sys.stderr, flush=True)
    print_table("Killed and resumed", list(rows[0]), [tuple(map(_text, row.values())) for row in rows], 1)
    files.write_json(out / "kill_and_resume.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


def _text(value: Any) -> str:
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def _result(command: str, folder: Path) -> bytes:
    """The bytes of the result, without the times in it."""
    content = (folder / COMMANDS[command][0]).read_bytes()
    if command == "pareto":
        content = re.sub(rb'"seconds": [0-9.e+-]+', b"", json.dumps(json.loads(content)).encode())
    return content


def _begin(command: str, folder: Path, out: Path, quick: bool) -> "subprocess.Popen[bytes]":
    options = COMMANDS[command][2 if quick else 1].split()
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str((out / "cache").absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return subprocess.Popen(
        [sys.executable, "-m", "cpjax", command, *options, "--out", str(folder)],
        env={**os.environ, **cache},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def _end(process: "subprocess.Popen[bytes]", refused_is_fine: bool = False) -> int:
    code = process.wait()
    if code and not (code == 2 and refused_is_fine):
        raise RuntimeError(f"{process.args!r} ended with {code}")
    return code


if __name__ == "__main__":
    run(main, __doc__ or "")
