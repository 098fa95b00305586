"""Tunings killed (SIGKILL) at ten random moments and resumed, against one that was never stopped.

    python experiments/kill_and_resume.py

Each is a tuning of its own, in its own folder. All controllers have to be the same file, byte for byte.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import run

from cpjax import files

BUDGET = ("--design", "placement", "--candidates", "32", "--restarts", "4")
SMALL = ("--batch", "8", "--steps", "40", "--duration", "2")
TINY = ("--batch", "2", "--steps", "5", "--duration", "1")


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints what happened and writes kill_and_resume.json."""
    random = np.random.default_rng(seed)
    size = (*BUDGET, *(TINY if quick else SMALL))
    _run(out / "warm", size, out)  # fills the compiler's cache
    began = time.monotonic()
    _run(out / "whole", size, out)
    length = time.monotonic() - began
    expected = (out / "whole" / "tuned.json").read_bytes()
    kills: list[dict[str, Any]] = []
    for i in range(1 if quick else 10):
        folder, moment = out / f"killed-{i}", float(random.uniform(0.1, 0.8) * length)
        finished = _run(folder, size, out, until=moment)
        saved = (folder / "checkpoint.npz").exists()
        _run(folder, size, out)
        same = (folder / "tuned.json").read_bytes() == expected
        kills.append({"moment": moment, "killed": not finished, "checkpoint": saved, "identical": same})
        print(
            f"after {moment:5.1f} of {length:.1f} s: {'had finished' if finished else 'killed'}, "
            f"{'a' if saved else 'no'} checkpoint; resumed: {'identical' if same else 'DIFFERENT'}",
            flush=True,
        )
    same = all(kill["identical"] for kill in kills)
    result = {"versions": files.versions(), "length": length, "kills": kills, "identical": same}
    print(f"{sum(kill['killed'] for kill in kills)} kills; all ended {'identical' if same else 'NOT IDENTICAL'}")
    files.write_json(out / "kill_and_resume.json", result)
    return result


def _run(folder: Path, size: tuple[str, ...], out: Path, until: float | None = None) -> bool:
    """Runs a tuning to its end, or kills it after so many seconds; whether it ended by itself."""
    command = [sys.executable, "-m", "cpjax", "tune", *size, "--out", str(folder)]
    cache = {
        "JAX_COMPILATION_CACHE_DIR": str((out / "cache").absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    process = subprocess.Popen(
        command, env={**os.environ, **cache}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        code = process.wait(until)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False
    if code:
        raise RuntimeError(f"{' '.join(command)} ended with {code}")
    return True


if __name__ == "__main__":
    run(main, __doc__ or "")
