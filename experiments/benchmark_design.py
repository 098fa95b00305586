"""What a regulator's gain costs: 10,000 designs at once, with and without gradients, against loops over other tools.

    python experiments/benchmark_design.py

Every tool solves the same problems, the appendix's plant with parameters and weights drawn around the paper's, and is
held to the same gains. Figures are per design, after compilation, the best and the median of several repeats within one
run; ratios are the result. The loops run over fewer designs. contrax is timed if it is installed.
"""

import importlib.util
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run
from rich.console import Console
from rich.table import Table

import cpjax
from cpjax import files, paper

Arrays = tuple[np.ndarray[Any, Any], ...]


def problems(count: int, seed: int) -> Arrays:
    """A (count, 4, 4), B (count, 4, 1), Q (count, 4, 4) and R (count, 1, 1), all of them different."""
    generator = np.random.default_rng(seed)

    def around(value: float, spread: float) -> np.ndarray[Any, Any]:
        return value * np.exp(generator.uniform(-spread, spread, count))

    plants = cpjax.CartPole(
        cart_mass=around(1.0, 0.5),
        pole_mass=around(0.5, 0.5),
        pole_length=around(0.7, 0.5),
        motor=cpjax.Motor(torque_constant=around(1.25, 0.5), resistance=around(1.25, 0.5)),
    )
    axes = jax.tree.map(lambda leaf: 0 if np.ndim(leaf) else None, plants)
    A, B = jax.jit(jax.vmap(cpjax.linearize, in_axes=(axes,)))(plants)
    Q = np.zeros((count, 4, 4))
    for i, weight in enumerate(paper.Q):
        Q[:, i, i] = around(weight, 2.0)
    return np.asarray(A), np.asarray(B), Q, around(1e-2, 4.0)[:, None, None]


def ready(result: Any) -> Any:
    """The result, once it is there."""
    return jax.block_until_ready(result)  # type: ignore[no-untyped-call]  # untyped in JAX


def timed(work: Callable[[], Any], repeats: int) -> dict[str, Any]:
    """Seconds of the first call and of the best and the median of the others."""
    begin = time.perf_counter()
    result = work()
    first = time.perf_counter() - begin
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - begin)
    return {"first_s": first, "best_s": min(seconds), "median_s": statistics.median(seconds), "result": result}


def looped(design: Callable[..., Any], given: Arrays, count: int) -> Callable[[], np.ndarray[Any, Any]]:
    """One design after the other."""
    return lambda: np.stack([np.asarray(design(*(x[i] for x in given))) for i in range(count)])


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints the table and writes benchmark_design.json."""
    import control
    import scipy.linalg

    count, few, repeats = (200, 20, 2) if quick else (10_000, 500, 7)
    given = problems(count, seed)
    on_device = tuple(jnp.asarray(x) for x in given)

    def gain(*problem: Any) -> jax.Array:
        return cpjax.lqr(*problem).K

    def loss(*problem: Any) -> jax.Array:
        K = gain(*problem)
        return jnp.sum(K * K)

    def scipy_gain(A: Any, B: Any, Q: Any, R: Any) -> Any:
        return np.linalg.solve(R, B.T @ scipy.linalg.solve_continuous_are(A, B, Q, R))

    values = jax.jit(jax.vmap(gain))
    gradients = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1, 2, 3))))
    work: dict[str, tuple[int, Callable[[], Any]]] = {
        "cpjax.lqr under vmap": (count, lambda: ready(values(*on_device))),
        "the same with its gradient in A, B, Q and R": (
            count,
            lambda: ready(gradients(*on_device)),
        ),
        "loop over scipy.linalg.solve_continuous_are": (few, looped(scipy_gain, given, few)),
        "loop over control.lqr": (few, looped(lambda *p: control.lqr(*p)[0], given, few)),
    }
    if importlib.util.find_spec("contrax") is not None:
        work |= _contrax(on_device, count)
    rows, reference, losses = [], None, None
    for name, (designs, function) in work.items():
        measured = timed(function, repeats)
        result = measured.pop("result")
        if reference is None:
            reference = np.asarray(result)
            losses = np.sum(reference**2, axis=(1, 2))
        # A gradient comes with the loss that it belongs to.
        found, right = (result[0], losses) if isinstance(result, tuple) else (result, reference[:designs])
        error = np.max(np.abs(np.asarray(found) / right - 1.0))
        rows.append({"tool": name, "designs": designs, **measured, "us_per_design": 1e6 * measured["best_s"] / designs})
        rows[-1] |= {"median_us_per_design": 1e6 * measured["median_s"] / designs, "largest_relative_difference": error}
    ours = rows[0]["us_per_design"]
    for row in rows:
        row["ratio"] = row["us_per_design"] / ours
    result = {"versions": files.versions(), "device": str(jax.devices()[0]), "seed": seed, "rows": rows}
    files.write_json(out / "benchmark_design.json", result)
    _print(rows)
    return result


def _contrax(given: tuple[jax.Array, ...], count: int) -> dict[str, tuple[int, Callable[[], Any]]]:
    """contrax's LQR on the same problems, under vmap."""
    import contrax

    def loss(*problem: Any) -> jax.Array:
        K = contrax.care(*problem).K
        return jnp.sum(K * K)

    values = jax.jit(jax.vmap(lambda *problem: contrax.care(*problem).K))
    gradients = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1, 2, 3))))
    return {
        "contrax.care under vmap": (count, lambda: ready(values(*given))),
        "the same with its gradient": (count, lambda: ready(gradients(*given))),
    }


def _print(rows: list[dict[str, Any]]) -> None:
    table = Table(title="LQR designs, n = 4, float64", title_justify="left")
    for name in ("tool", "designs", "first call [s]", "best [us]", "median [us]", "times cpjax", "differs by"):
        table.add_column(name, justify="left" if name == "tool" else "right")
    for row in rows:
        table.add_row(
            row["tool"],
            str(row["designs"]),
            f"{row['first_s']:.2f}",
            f"{row['us_per_design']:.2f}",
            f"{row['median_us_per_design']:.2f}",
            f"{row['ratio']:.2f}",
            f"{row['largest_relative_difference']:.1e}",
        )
    Console(width=150).print(table)


if __name__ == "__main__":
    run(main, __doc__ or "")
