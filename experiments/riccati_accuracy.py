"""How accurate cpjax.care and cpjax.dare are: against fifty digits, beside SciPy's error on the same system.

    python experiments/riccati_accuracy.py

A thousand random systems of each equation, the paper's problem, and ten ill-conditioned ones. An error is the Frobenius
norm of the difference to the reference over that of the reference; a ratio is cpjax's error over SciPy's, or over 2^-53
where SciPy is luckier than that. float32 is held against the solution for the data rounded to float32. Ten minutes, of
which half is compilation; an interrupted run is taken up where it stopped.
"""

import hashlib
import math
import statistics
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeAlias

import _riccati_systems as systems
import jax
import jax.numpy as jnp
import numpy as np
from _common import run
from _riccati_systems import Equation, Matrix, System
from matplotlib.figure import Figure

import cpjax
from cpjax import files
from cpjax.cli.progress import progress
from cpjax.linear.riccati import solve_care, solve_dare
from cpjax.show.figures import save_figure

Solve: TypeAlias = Callable[[Equation, System, Any], tuple[Matrix, Matrix]]
"""Takes an equation, a system and a dtype to solve it in; returns P and the gain."""

EQUATIONS: tuple[Equation, ...] = ("care", "dare")
SOLVERS = {"cpjax": "cpjax", "scipy": "SciPy", "float32": "cpjax in float32"}
QUICK_SHAPES = ((4, 1),)  # one, because each is compiled
SAVE_EVERY = 25

_JITTED = {"care": jax.jit(solve_care), "dare": jax.jit(solve_dare)}


def cpjax_solution(equation: Equation, system: System, dtype: Any) -> tuple[Matrix, Matrix]:
    """What `jax.jit` makes of cpjax's solver."""
    P, K, _ = _JITTED[equation](*(jnp.asarray(matrix, dtype=dtype) for matrix in system[2:]))
    return np.asarray(P), np.asarray(K)


def scipy_solution(equation: Equation, system: System) -> tuple[Matrix, Matrix]:
    """SciPy has no gain of its own: it is computed from P as its users do."""
    P = systems.scipy_solution(equation, system)
    return P, systems.gain(equation, system, P)


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes riccati_accuracy.json and riccati_accuracy.png."""
    path = out / "riccati_accuracy.json"
    setting = {"random_systems": 10 if quick else 1000, "quick": quick, "seed": seed, "code": _code()}
    document: dict[str, Any] = {"versions": files.versions(), "setting": setting, "finished": False}
    measured = _unfinished(path, document)
    todo = [(equation, system) for equation in EQUATIONS for system in _chosen(equation, quick, seed)]
    with progress("Riccati equations") as report:
        for done in range(len(measured), len(todo)):
            equation, system = todo[done]
            if done % SAVE_EVERY == 0:
                report(done, len(todo), f"{equation} {system.name}")
                files.write_json(path, {**document, "systems": measured})
            measured.append(measure(equation, system, cpjax_solution))
    rows = summaries(measured)
    files.write_json(path, {**document, "finished": True, "rows": rows, "systems": measured})
    save_figure(out / "riccati_accuracy.png", _figure(measured))
    _print(rows)
    return rows


def measure(equation: Equation, system: System, solve: Solve) -> dict[str, Any]:
    """Errors of P and of the gain on one system, infinite where a solver has failed."""
    coarse = system.rounded()
    solved = (
        (system, {"cpjax": solve(equation, system, np.float64), "scipy": scipy_solution(equation, system)}),
        (coarse, {"float32": solve(equation, coarse, np.float32)}),
    )
    row: dict[str, Any] = {"equation": equation, "name": system.name, "kind": system.kind}
    for data, solutions in solved:
        right = systems.reference(equation, data)
        right_gain = systems.gain(equation, data, right)
        for solver, (P, K) in solutions.items():
            row[solver] = systems.relative_error(P, right)
            row[f"{solver}_gain"] = systems.relative_error(K, right_gain)
    row["ratio"] = systems.ratio(row["cpjax"], row["scipy"])
    return row


def summaries(measured: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per equation and kind: median and worst of each error where there is one, failures, and the worst ratio.

    A failure of cpjax makes the worst ratio infinite; one of SciPy counts in cpjax's favour.
    """
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for member in measured:
        groups.setdefault((member["equation"], member["kind"]), []).append(member)
    rows = []
    for (equation, kind), members in groups.items():
        row: dict[str, Any] = {"equation": equation, "kind": kind, "count": len(members)}
        for solver in SOLVERS:
            solved = [member for member in members if math.isfinite(member[solver])]
            errors, gains = ([member[key] for member in solved] or [math.inf] for key in (solver, f"{solver}_gain"))
            row[f"{solver}_median"], row[f"{solver}_worst"] = statistics.median(errors), max(errors)
            row[f"{solver}_gain_worst"] = max(gains)
            row[f"{solver}_failed"] = len(members) - len(solved)
        rows.append({**row, "worst_ratio": max(member["ratio"] for member in members)})
    return rows


def _chosen(equation: Equation, quick: bool, seed: int) -> list[System]:
    if quick:
        special = [system for system in systems.special_systems(equation) if system.B.shape in QUICK_SHAPES]
        return systems.random_systems(equation, 10, seed, QUICK_SHAPES) + special
    return systems.random_systems(equation, 1000, seed) + systems.special_systems(equation)


def _unfinished(path: Path, document: dict[str, Any]) -> list[dict[str, Any]]:
    """What an interrupted run with the same setting, code and versions has left."""
    if not path.exists():
        return []
    saved = files.read_table(path)
    same = all(saved.get(key) == value for key, value in document.items())
    return saved["systems"] if same else []


def _code() -> str:
    """Fingerprint of the sources that the figures depend on."""
    sources = [*Path(cpjax.__file__).parent.rglob("*.py"), Path(__file__), Path(systems.__file__)]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sorted(sources))).hexdigest()


def _print(rows: list[dict[str, Any]]) -> None:
    pair = f"{'median':>9} {'worst':>7}"
    print(f"{'relative errors':46} {'cpjax':>17} {'SciPy':>17} {'':7} {'cpjax in float32':>17}   worst of the gain")
    print(f"{'':40} {'count':>5} {pair} {pair} {'ratio':>7} {pair}   cpjax   SciPy   float32")
    for row in rows:
        cells = [f"{row['equation']} {row['kind']:35} {row['count']:5d}"]
        for solver in SOLVERS:
            cells.append(f" {_error(row[f'{solver}_median'])}  {_error(row[f'{solver}_worst'])}")
            if solver == "scipy":
                cells.append(f"{row['worst_ratio']:7.2g}")
        cells.append("  " + " ".join(_error(row[f"{solver}_gain_worst"]) for solver in SOLVERS))
        for solver, name in SOLVERS.items():
            if row[f"{solver}_failed"]:
                cells.append(f"  {name} failed on {row[f'{solver}_failed']}")
        print(" ".join(cells))


def _error(value: float) -> str:
    return f"{value:7.1e}" if math.isfinite(value) else "  fails"


def _figure(measured: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    line = np.geomspace(1e-17, 1e-6, 200)
    for axes, equation in zip(panels, EQUATIONS, strict=True):
        for random, marker, colour, label in ((True, ".", "#0072B2", "random"), (False, "D", "#D55E00", "special")):
            members = [
                row for row in measured if row["equation"] == equation and row["kind"].startswith("random") == random
            ]
            points = np.array([[row["scipy"], row["cpjax"]] for row in members]).T
            axes.loglog(*np.maximum(points, 1e-17), marker, color=colour, label=label, markersize=4)
        axes.loglog(line, line, color="#999999", label="as accurate as SciPy")
        axes.loglog(line, 10 * np.maximum(line, systems.UNIT), "--", color="#999999", label="ten times its error")
        axes.set_title(equation, loc="left")
        axes.set_xlabel("SciPy's relative error of P")
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("cpjax's relative error of P")
    panels[0].legend()
    return figure


if __name__ == "__main__":
    run(main, __doc__ or "")
