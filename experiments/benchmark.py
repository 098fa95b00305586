"""How fast cpjax is on this machine, against hand-written C and against other ways to simulate many starts.

    python experiments/benchmark.py

Every contender runs in a process of its own (`benchmark/contenders.py`), on the same cores, one after another; the
best of at least three runs, and of at least two seconds, counts. C needs a C compiler, and is compiled in every form of
`roofline.c`, of which the fastest counts; where cpjax is faster still, C is not called a limit. The other packages are
optional, and those that are missing are named: `pip install --constraint constraints.txt '.[benchmark,peers]'`; for
jaxonomy, which needs an older JAX, an environment of its own with `pip install jaxonomy tomli-w rich optax`, whose
Python is named in JAXONOMY_PYTHON. Ratios are to the C code at the same precision, which does the same work as cpjax
(law, kick, gate, flags and all metrics); the others do less, as `contenders.py` says of each. Measured and written
after each contender: benchmark.json, benchmark.png.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from _common import run
from matplotlib.figure import Figure

from cpjax import files
from cpjax.cli.tables import print_table
from cpjax.show.figures import save_figure

CONTENDERS = Path(__file__).with_name("benchmark") / "contenders.py"
CORES = 2
STEPS = 5000
DTYPES = ("float32", "float64")

# Starts of each contender, both precisions: as many as it does in seconds.
MAIN: dict[str, tuple[int, ...]] = {
    "C": (4096, 65536),
    "cpjax": (4096, 65536),
    "cpjax, no options": (4096, 65536),
    "cpjax, every 10th sample": (65536,),
    "numba": (4096,),
    "plain JAX scan": (4096,),
    "diffrax, Heun": (4096,),
    "diffrax, Tsit5": (1024,),
    "MJX": (256,),
}
# In float64 only: number of starts, steps, cores.
OTHERS: dict[str, tuple[int, int, int]] = {
    "C, one start": (1, STEPS, 1),
    "cpjax, one start": (1, STEPS, 1),
    "cpjax, one start, under jit": (1, STEPS, 1),
    "cpjax, one start, 10 ms": (1, STEPS, 1),
    "C, gradient": (64, STEPS, 1),
    "cpjax, values of 64": (64, STEPS, 1),
    "cpjax, gradient": (64, STEPS, 1),
    "cpjax, values of 64, configured": (64, STEPS, 1),
    "cpjax, gradient, configured": (64, STEPS, 1),
    "cpjax, gradient, configured, every step": (64, STEPS, 1),
    "cpjax, gradient in 5, configured, every step": (64, STEPS, 1),
    "python-control": (2, STEPS, 1),
    "MuJoCo rollout": (256, STEPS, CORES),
    "jaxonomy, RK4": (1, STEPS, 1),
    "jaxonomy, its own steps": (1, STEPS, 1),
    "SciPy": (1, 1000, 1),
}
GROWTH = tuple(4**k for k in range(12))
"""1 to 4,194,304 starts; 1,000 steps each."""
LENGTHS = (50, 500, 50000)
"""Steps of 4,096 starts."""


def measured(name: str, dtype: str, count: int, steps: int, cores: int, seed: int, repeats: int) -> dict[str, Any]:
    """One run of a contender; with "problem" where it has none of its libraries, or failed."""
    numbers = {"dtype": dtype, "starts": count, "steps": steps, "seed": seed, "cores": cores, "repeats": repeats}
    python, environment = sys.executable, dict(os.environ)
    if name.startswith("jaxonomy") and "JAXONOMY_PYTHON" in environment:
        python = environment["JAXONOMY_PYTHON"]
        environment["PYTHONPATH"] = str(CONTENDERS.parents[2])  # for cpjax itself
    command = [python, str(CONTENDERS), name]
    command += [f"--{key}={value}" for key, value in numbers.items()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        return {"name": name, **numbers, "problem": (done.stderr.strip().splitlines() or ["no message"])[-1][:200]}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table, writes benchmark.json and benchmark.png."""
    repeats, shrink = (1, 64) if quick else (3, 1)
    steps = STEPS // min(shrink, 10)
    jobs = [
        (name, dtype, max(1, count // shrink), steps, CORES)
        for name, counts in MAIN.items()
        for count in counts
        for dtype in DTYPES
    ]
    jobs += [(name, "float64", count, each // min(shrink, 10), cores) for name, (count, each, cores) in OTHERS.items()]
    both = ("C", "cpjax")
    jobs += [(name, dtype, 65536 // shrink, steps, 1) for dtype in DTYPES for name in both]
    jobs += [
        (name, "float32", 4096 // shrink, length, CORES) for length in LENGTHS[: 1 if quick else None] for name in both
    ]
    jobs += [(name, "float32", count, 1000, CORES) for count in GROWTH[: 3 if quick else None] for name in both]
    rows: list[dict[str, Any]] = []
    for place, job in enumerate(jobs):
        print(f"{place + 1} of {len(jobs)}: {job}", file=sys.stderr, flush=True)
        rows.append(measured(*job, seed=seed, repeats=1 if job[2] * job[3] > 1e9 else repeats))
        _write(out, rows)
    _table(rows)
    _picture(out / "benchmark.png", rows)
    print(f"written: {out / 'benchmark.json'}, {out / 'benchmark.png'}")
    return rows


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    sound = [row for row in rows if "problem" not in row]
    c = {_task(row): row["steps_per_second"] for row in sound if row["name"] in ("C", "C, one start")}
    # A C program that cpjax outruns is no limit, and nothing is compared with it.
    outrun = {
        _task(row) for row in sound if row["name"].startswith("cpjax") and _rate(row) > c.get(_task(row), math.inf)
    }
    c = {task: rate for task, rate in c.items() if task not in outrun}
    fastest = {dtype: max((rate for (d, *_), rate in c.items() if d == dtype), default=None) for dtype in DTYPES}
    for row in sound:
        same = None if _task(row) in outrun else c.get(_task(row), fastest[row["dtype"]])
        row["of_C"] = None if same is None else _rate(row) / same
    files.write_json(out / "benchmark.json", {"versions": files.versions(), "rows": rows})


def _task(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["dtype"], row["starts"], row["steps"], row["cores"]


def _rate(row: dict[str, Any]) -> float:
    return float(row["steps_per_second"])


def _table(rows: list[dict[str, Any]]) -> None:
    def cells(row: dict[str, Any]) -> list[str]:
        head = [row["name"], row["dtype"], f"{row['starts']:,}", str(row["steps"]), str(row["cores"])]
        if "problem" in row:
            return [*head, "-", "-", "-", "-", "-", row["problem"][:40]]
        temporary = row["temporary_MiB"]
        return [
            *head,
            f"{row['steps_per_second'] / 1e6:.4g}",
            "-" if row["of_C"] is None else f"{row['of_C']:.3g}",
            f"{row['compile_s']:.2f}",
            f"{row['peak_MiB']:.0f}",
            "-" if temporary is None else f"{temporary:.1f}",
            f"{row['error_m']:.0e}",
        ]

    titles = ["contender", "dtype", "starts", "steps", "cores", "M steps/s", "of C", "compile s", "peak MiB"]
    title = "Steps per second; every contender's answer is off by at most the last column after 1 s"
    print_table(title, [*titles, "temp. MiB", "error m"], [cells(row) for row in rows], text_columns=2)
    for row in rows:
        if row.get("form") and row["steps"] == STEPS:
            none = "" if row["of_C"] is not None else "; cpjax is faster, so it is no limit"
            print(f"{row['name']}, {row['dtype']}, {row['starts']:,}, {row['cores']} cores: {row['form']}{none}")


def _picture(path: Path, rows: list[dict[str, Any]]) -> None:
    figure = Figure(figsize=(13, 9), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name in ("C", "cpjax"):
        grown = [row for row in rows if row["name"] == name and row["steps"] == 1000 and "problem" not in row]
        left.loglog([row["starts"] for row in grown], [row["steps_per_second"] for row in grown], "o-", label=name)
    left.set(xlabel="starts", ylabel="steps per second", title="float32, 1,000 steps, all cores")
    left.legend()
    bars = [row for row in rows if "problem" not in row and (row["steps"] == STEPS or row["name"] == "SciPy")]
    labels = [f"{row['name']} ({row['starts']:,}, {row['dtype'][5:]} bit, {row['cores']})" for row in bars]
    right.barh(labels, [row["steps_per_second"] for row in bars])
    right.set(xscale="log", xlabel="steps per second", title="all contenders (starts, precision, cores)")
    right.invert_yaxis()
    save_figure(path, figure)


if __name__ == "__main__":
    run(main, __doc__ or "")
