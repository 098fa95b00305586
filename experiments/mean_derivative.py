"""The derivative of the mean on the sampled clock, held against located derivatives and against finite differences.

    python experiments/mean_derivative.py

Three controllers: the paper's corrected, centred law with its printed gain, and the two tuned ones of the package.
Every derivative is of the time outside the target over 3 s, relative to a whole change of its parameter.

1. Order: derivatives of single runs at control periods of 4, 2, 1 and 0.5 ms against the located derivative of the
   continuous clock, on `hanging` states whose sampled and located runs change their mode as often. The median error
   and the order fitted to it.
2. Mean: one million initial states about one hanging state, all of which change their mode equally often, also with
   the parameter moved either way. The derivative of the mean by finite differences with common random numbers, with
   its standard error, beside the mean of derivative="mean" and of derivative="pathwise".
3. Flux: the same over a tenth as many of the sets `hanging` and `anywhere`, where a moved parameter also moves initial
   states from one course to another: the share of the mean's change that no pathwise derivative sees.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table
from cpjax.sim.metrics import Sample
from cpjax.study.named_parameters import as_matrix, as_tree, parametrise

DURATION, DT = 3.0, 2e-3
PERIODS = (4e-3, 2e-3, 1e-3, 5e-4)
CENTRE = (0.03, 0.0, np.pi - 0.5, -0.5)
"""About which all initial states change their mode equally often."""
WIDTH = 0.05
NAMES = ("energy_gain", "cart_stiffness", "cart_damping", "half_angle", "rate", "Q", "polynomial", "K")
"""Parameters that derivatives are taken in, of those that a controller has."""
MOVE = 1e-3
"""By which share of itself a parameter is moved for differences."""


@cpjax.pytree.pytree
class Counted:
    """Folds the time outside the target and the number of mode changes."""

    outside: cpjax.TimeOutside = cpjax.pytree.part("a metric", "init", "update", default=cpjax.TimeOutside())

    def init(self, sample: Sample) -> Any:
        return self.outside.init(sample), jnp.zeros_like(sample.mode)

    def update(self, memory: Any, sample: Sample) -> Any:
        changes = memory[1] + (sample.mode != sample.mode_before).astype(memory[1].dtype)
        return self.outside.update(memory[0], sample), changes

    def finalize(self, memory: Any, last: Sample) -> Any:
        return self.outside.finalize(memory[0], last), memory[1], last.flag


class Loop:
    """A controller as a function of its named numbers, each in units of a whole change."""

    def __init__(
        self,
        controller: cpjax.Hybrid,
    ) -> None:
        self.plant = paper.appendix_plant()
        chosen = parametrise(self.plant, controller)
        mine = {name: value for name, value in chosen.parameters.items() if name in NAMES}
        rest = {name: jnp.asarray(value) for name, value in chosen.parameters.items() if name not in mine}
        self.names, values, shapes = as_matrix(mine, 1, each=False)
        self.values, self.shapes = jnp.asarray(values[0]), shapes
        self.built: Callable[[Any], Any] = lambda p: chosen.build({**rest, **p})

    def controller(self, moves: jax.Array) -> Any:
        """Returns the controller with each number moved by a share of itself (d,)."""
        return self.built(as_tree(self.values * (1.0 + moves), self.shapes))[1]

    @functools.cache  # noqa: B019  # so that the same settings are compiled once
    def _objective(self, **settings: Any) -> Callable[[jax.Array, cpjax.State], Any]:
        def outside(moves: jax.Array, start: cpjax.State) -> Any:
            moved = self.controller(moves)
            return cpjax.measure(self.plant, moved, start, metrics=cpjax.TimeOutside(), duration=DURATION, **settings)

        return outside

    def gradient(self, starts: cpjax.State, chunk: int = 64, **settings: Any) -> np.ndarray:
        """Returns derivatives of single runs (n, d)."""
        objective = self._objective(**settings)
        return np.asarray(cpjax.gradients(objective, jnp.zeros(len(self.names)), starts, chunk=chunk).gradient)

    def values_at(self, moves: np.ndarray, starts: cpjax.State, **settings: Any) -> tuple[np.ndarray, np.ndarray]:
        """Returns the time outside (n,) and the number of mode changes (n,)."""
        settings = {"duration": DURATION, "dt": DT} | settings
        value, changes, _ = cpjax.sweep(
            self.plant, self.controller(jnp.asarray(moves)), starts, metrics=Counted(), **settings
        )
        return np.asarray(value), np.asarray(changes)


def about_the_centre(count: int, seed: int) -> cpjax.State:
    """Returns initial states uniform in a small box."""
    unit = np.random.default_rng(seed).uniform(-WIDTH, WIDTH, (4, count))
    return cpjax.State(*(middle + column for middle, column in zip(CENTRE, unit, strict=True)))


def order_rows(name: str, loop: Loop, count: int, seed: int) -> list[dict[str, Any]]:
    """Compares with located derivatives at several control periods."""
    starts = cpjax.sample_starts("hanging", count, seed=seed)
    still = np.zeros(len(loop.names))
    counts = [loop.values_at(still, starts, **s)[1] for s in ({}, {"switching": "located", "dt": 1e-3})]
    kept = counts[0] == counts[1]
    starts = jax.tree.map(lambda column: jnp.asarray(column[kept]), starts)
    exact = loop.gradient(starts, switching="located", dt=1e-3)
    errors = {
        kind: [
            np.median(np.abs(loop.gradient(starts, derivative=kind, dt=period) - exact), axis=0) for period in PERIODS
        ]
        for kind in ("mean", "pathwise")
    }
    size = np.median(np.abs(exact), axis=0)
    rows = []
    for i, parameter in enumerate(loop.names):
        mean, plain = (np.array([row[i] for row in errors[kind]]) / size[i] for kind in ("mean", "pathwise"))
        order = np.polyfit(np.log(PERIODS), np.log(np.maximum(mean, 1e-12)), 1)[0]
        row = {"controller": name, "parameter": parameter, "runs": int(kept.sum()), "order": float(order)}
        rows.append(row | {"mean": mean.tolist(), "pathwise": plain.tolist()})
    return rows


def difference(loop: Loop, i: int, starts: cpjax.State, move: float) -> tuple[np.ndarray, list[int]]:
    """Returns derivatives of single runs by differences (n,), and which counts of mode changes occur.

    Differences at two moves are extrapolated to none (Richardson), which removes their curvature.
    """
    counts: set[int] = set()

    def central(size: float) -> np.ndarray:
        moves = np.zeros(len(loop.names))
        moves[i] = size
        up, changes_up = loop.values_at(moves, starts)
        down, changes_down = loop.values_at(-moves, starts)
        counts.update(changes_up.tolist(), changes_down.tolist())
        return (up - down) / (2.0 * size)

    return (4.0 * central(move) - central(2.0 * move)) / 3.0, sorted(counts)


def mean_rows(name: str, loop: Loop, of: str, starts: cpjax.State, few: int, move: float) -> list[dict[str, Any]]:
    """Compares with differences of the mean; derivatives are of the first `few` initial states."""
    first = jax.tree.map(lambda column: jnp.asarray(column[:few]), starts)
    found = {kind: loop.gradient(first, derivative=kind, dt=DT) for kind in ("mean", "pathwise")}
    rows = []
    for i, parameter in enumerate(loop.names):
        each, counts = difference(loop, i, starts, move)
        by_difference, error = float(each.mean()), float(each.std() / np.sqrt(each.size))
        row: dict[str, Any] = {"controller": name, "of": of, "parameter": parameter, "changes": counts}
        row |= {"difference": by_difference, "standard_error": error}
        for kind, gradient in found.items():
            row |= {kind: float(gradient[:, i].mean()), f"{kind}_error": float(gradient[:, i].std() / np.sqrt(few))}
        # On the same initial states, so that their spread counts once.
        apart = each[:few] - found["mean"][:, i]
        flux, flux_error = float(apart.mean()), float(apart.std() / np.sqrt(few))
        row |= {"flux": flux, "flux_error": flux_error, "deviations": abs(flux) / flux_error}
        rows.append(row)
    return rows


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the tables and writes mean_derivative.json."""
    plant = paper.appendix_plant()
    controllers = {
        "tuned, LQR": cpjax.preset("lqr"),
        "tuned, placement": cpjax.preset("placement"),
        "paper, corrected": paper.controller("corrected-centred", "placement", plant),
    }
    few, many, gradients = (8, 64, 4) if quick else (256, 1_000_000, 30_000)
    found: dict[str, list[dict[str, Any]]] = {"order": [], "mean": [], "flux": []}
    for name, controller in controllers.items():
        loop = Loop(controller)
        found["order"] += order_rows(name, loop, few, seed)
        found["mean"] += mean_rows(name, loop, "box", about_the_centre(many, seed), gradients, MOVE)
        for of in ("hanging", "anywhere"):
            starts = cpjax.sample_starts(of, many // 10, seed=seed)
            found["flux"] += mean_rows(name, loop, of, starts, gradients, MOVE)
        files.write_json(out / "mean_derivative.json", {"versions": files.versions(), "seed": seed, **found})
        show(name, found)
    return found


def show(name: str, found: dict[str, list[dict[str, Any]]]) -> None:
    """Prints the tables of one controller."""
    of_order = [row for row in found["order"] if row["controller"] == name]
    head = ("parameter", *(f"{1e3 * period:g} ms" for period in PERIODS), "order", "pathwise, 2 ms")
    texts = [
        (row["parameter"], *(f"{e:.1e}" for e in row["mean"]), f"{row['order']:.2f}", f"{row['pathwise'][1]:.1e}")
        for row in of_order
    ]
    print_table(f"{name}: median error relative to the located derivative, by control period", head, texts, 1)
    head = ("of", "parameter", "changes", "differences", "+-", "mean", "+-", "pathwise", "deviations", "rest", "+-")
    for kind in ("mean", "flux"):
        texts = [
            (
                row["of"],
                row["parameter"],
                ",".join(map(str, row["changes"][:4])),
                *(f"{row[key]:+.2e}" for key in ("difference", "standard_error", "mean", "mean_error", "pathwise")),
                f"{row['deviations']:.1f}",
                f"{row['flux']:+.1e}",
                f"{row['flux_error']:.1e}",
            )
            for row in found[kind]
            if row["controller"] == name
        ]
        title = f"{name}: derivative of the mean over initial states" + ", flux included" * (kind == "flux")
        print_table(title, head, texts, 3)


if __name__ == "__main__":
    cpjax.configure_cpu()
    run(main, __doc__.splitlines()[0])
