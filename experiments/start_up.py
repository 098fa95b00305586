"""Time to begin: imports, the first swing-up on the command line, first designs and gradients, memory of a large sweep.

    python experiments/start_up.py

Each figure is of fresh processes, several times, with the median quoted; the imports of jax and of
cpjax are timed in turn.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from _common import run

from cpjax import files

IMPORT = "import time; t = time.perf_counter(); import {}; print(time.perf_counter() - t)"
CALLS = """
import dataclasses, json, time, jax
jax.config.update("jax_enable_x64", True)
import cpjax

plant, law, start = cpjax.CartPole(), cpjax.preset("lqr"), cpjax.State(0.0, 0.0, 3.1, 0.0)
seconds = {{}}


def timed(name, call):
    begin = time.perf_counter()
    result = jax.block_until_ready(call())
    seconds[name] = time.perf_counter() - begin
    return result


def cost(mass):
    settings = dict(duration={duration}, dt=0.002, clock="continuous", switching="located")
    moved = dataclasses.replace(plant, cart_mass=mass)
    return cpjax.measure(moved, law, start, metrics=cpjax.TimeOutside(), **settings)


A, B = timed("linearize", lambda: cpjax.linearize(plant))
timed("linearize again", lambda: cpjax.linearize(plant))
timed("lqr", lambda: cpjax.lqr(A, B, jax.numpy.eye(4), 1.0))
timed("dlqr", lambda: cpjax.dlqr(0.1 * A, B, jax.numpy.eye(4), 1.0))
timed("gradient through located switches", lambda: jax.grad(cost)(1.0))
print(json.dumps(seconds))
"""
SWEEP = """
import json, resource, time, jax
jax.config.update("jax_enable_x64", True)
import cpjax
from cpjax import paper

def peak_mebibytes():
    # Of this process; ru_maxrss would also count what its parent held when it was started.
    try:
        status = open("/proc/self/status").read()
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


plant = paper.appendix_plant()
controller = paper.controller("corrected-centred", "placement", plant)
starts = cpjax.sample_starts("hanging", {count}, seed={seed})
settings = dict(duration={duration}, dt=0.002, clock="sampled")
run = jax.jit(jax.vmap(lambda start: cpjax.measure(plant, controller, start, **settings)))
seconds = []
for _ in range(2):
    begin = time.perf_counter()
    metrics = jax.block_until_ready(run(starts))
    seconds.append(time.perf_counter() - begin)
times = dict(first_s=seconds[0], second_s=seconds[1])
print(json.dumps(dict(**times, peak_MiB=peak_mebibytes(), success=float(metrics.success.mean()))))
"""


def python(code: str) -> str:
    """Returns what a fresh interpreter prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the figures and writes start_up.json."""
    repeats = 1 if quick else 5
    imports: dict[str, list[float]] = {"jax, jax.numpy": [], "cpjax": []}
    first: dict[str, list[float]] = {"cold": [], "warm": []}
    for _ in range(repeats):
        for name, times in imports.items():
            times.append(float(python(IMPORT.format(name))))
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "cpjax", "swingup", "--out", f"{folder}/out"]
            environment = os.environ | {"XDG_CACHE_HOME": f"{folder}/cache"}
            for found in first.values():
                begin = time.perf_counter()
                subprocess.run(command, capture_output=True, check=True, env=environment)
                found.append(time.perf_counter() - begin)
    count, duration = (64, 1.0) if quick else (4096, 10.0)
    measured = json.loads(python(SWEEP.format(count=count, seed=seed, duration=duration)))
    sweep = {"starts": count, "duration_s": duration, **measured}
    calls = [json.loads(python(CALLS.format(duration=duration))) for _ in range(repeats)]
    result: dict[str, Any] = {
        "versions": files.versions(),
        "import_jax_s": statistics.median(imports["jax, jax.numpy"]),
        "import_cpjax_s": statistics.median(imports["cpjax"]),
        "first_swingup_s": {kept: statistics.median(found) for kept, found in first.items()},
        "first_calls_s": {name: statistics.median(one[name] for one in calls) for name in calls[0]},
        "sweep": sweep,
    }
    files.write_json(out / "start_up.json", result)
    print(f"import jax     {result['import_jax_s']:.2f} s")
    print(f"import cpjax   {result['import_cpjax_s']:.2f} s, jax included")
    for kept, seconds in result["first_swingup_s"].items():
        print(f"cpjax swingup  {seconds:.2f} s, from the shell's prompt to the files, {kept} compilation cache")
    for name, seconds in result["first_calls_s"].items():
        print(f"{name:34s} {seconds:.4f} s in a fresh process, compilation included")
    print(
        f"{count} starts x {duration:g} s at 2 ms: {sweep['first_s']:.2f} s with compilation, "
        f"{sweep['second_s']:.2f} s without, peak memory of the process {sweep['peak_MiB']:.0f} MiB"
    )
    return result


if __name__ == "__main__":
    run(main, __doc__ or "")
