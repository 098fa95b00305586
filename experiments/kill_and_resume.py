"""A tuning killed (SIGKILL) at ten random moments and resumed each time, against one that was never stopped.

    python experiments/kill_and_resume.py

Both write a controller; the two files have to be the same, byte for byte.
"""

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _common import run

from cpjax import io

BUDGET = ("--design", "placement", "--candidates", "32", "--restarts", "4")
SMALL = ("--batch", "8", "--steps", "40", "--duration", "2")
TINY = ("--batch", "2", "--steps", "5", "--duration", "1")


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints what happened and writes kill_and_resume.json."""
    random = np.random.default_rng(seed)
    size = (*BUDGET, *(TINY if quick else SMALL))
    whole, stopped = out / "whole", out / "stopped"
    began = time.monotonic()
    subprocess.run(_command(whole, size), check=True, capture_output=True)
    length = time.monotonic() - began
    kills = []
    for _ in range(1 if quick else 10):
        wait = float(random.uniform(0.3, 0.95) * length)
        process = subprocess.Popen(_command(stopped, size), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills.append(wait)
        print(f"after {wait:.1f} s: {'killed' if process.returncode else 'had finished'}", flush=True)
    subprocess.run(_command(stopped, size), check=True, capture_output=True)
    same = (whole / "tuned.json").read_bytes() == (stopped / "tuned.json").read_bytes()
    result = {"versions": io.versions(), "length": length, "kills": kills, "identical": same}
    print(f"{len(kills)} kills; the two controllers are {'identical' if same else 'DIFFERENT'}")
    io.write_json(out / "kill_and_resume.json", result)
    return result


def _command(out: Path, size: tuple[str, ...]) -> list[str]:
    return [sys.executable, "-m", "cpjax", "tune", *size, "--out", str(out)]


if __name__ == "__main__":
    run(main, __doc__ or "")
