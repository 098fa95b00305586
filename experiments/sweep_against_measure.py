"""Does a sweep flag and judge every run as a rollout does? A million random plants, controllers and initial states.

    python experiments/sweep_against_measure.py

Each draw has a plant, a controller and an initial state of its own, from mild to absurd: masses and lengths over four
decades, supplies up to infinity, gains of either sign. `cpjax.sweep` (its fast path, and its second look at runs that
go wrong) is held against `jax.vmap(cpjax.measure)`, 3 s at 5 ms, in both precisions. Where flag or success differ, the
draw runs again: at a quarter of the step, and from initial states moved by up to sixteen units in the last place. A
difference counts as decided by the step if the former differs from the run at the full step in flag, in success, or by
as much in its travel as the two ways do from each other; and as decided by rounding if one of the latter differs in
flag or success.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

import cpjax
from cpjax import files, paper
from cpjax.cli.tables import print_table

DURATION, DT = 3.0, 5e-3
BLOCK = 50_000


def draws(count: int, seed: int, dtype: Any) -> tuple[cpjax.CartPole, cpjax.Hybrid, cpjax.State]:
    """Returns plants, controllers and initial states, one of each for each draw."""
    rng = np.random.default_rng(seed)

    def log(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(low), np.log(high), count)).astype(dtype)

    limit = np.where(rng.uniform(size=count) < 0.2, np.inf, log(1.0, 1e3)).astype(dtype)
    plant = cpjax.CartPole(
        cart_mass=log(0.01, 100.0),
        pole_mass=log(0.01, 100.0),
        pole_length=log(0.03, 30.0),
        pole_inertia=log(1e-6, 1.0),
        cart_friction=log(1e-4, 10.0),
        motor=cpjax.Motor(voltage_limit=limit),
    )
    law = cpjax.EnergySwingUp(
        paper.appendix_plant(), energy_gain=log(0.1, 1e3), cart_stiffness=log(0.1, 30.0), cart_damping=log(0.1, 30.0)
    )
    printed = np.asarray(paper.PRINTED_GAINS["placement"])
    K = (printed * rng.uniform(-1.0, 3.0, (count, 1, 4))).astype(dtype)
    controller = cpjax.Hybrid(law, cpjax.StateFeedback(K), cpjax.AngleGate(log(0.05, 3.0)))
    wide = (3.0, 5.0, 10.0, 10.0)
    columns = (rng.uniform(-w, w, count).astype(dtype) for w in wide)
    return plant, controller, cpjax.State(*columns)


@jax.jit
def _one_by_one(plant: Any, controller: Any, starts: Any) -> Any:
    return jax.vmap(lambda p, c, s: cpjax.measure(p, c, s, duration=DURATION, dt=DT))(plant, controller, starts)


@jax.jit
def _finer(plant: Any, controller: Any, starts: Any) -> Any:
    return jax.vmap(lambda p, c, s: cpjax.measure(p, c, s, duration=DURATION, dt=DT / 4))(plant, controller, starts)


@jax.jit
def _nudged(plant: Any, controller: Any, starts: Any) -> Any:
    """Returns flags and successes from 32 nearby initial states (n, 32)."""
    eps = float(np.finfo(starts.x.dtype).eps)
    shares = jnp.concatenate([jnp.arange(-16, 0), jnp.arange(1, 17)]).astype(starts.x.dtype) * eps

    def one(p: Any, c: Any, s: Any) -> Any:
        def moved(share: jax.Array) -> Any:
            near = jax.tree.map(lambda value: value * (1.0 + share), s)
            found = cpjax.measure(p, c, near, duration=DURATION, dt=DT)
            return found.flag, found.success

        return jax.vmap(moved)(shares)

    return jax.vmap(one)(plant, controller, starts)


def each_its_own(plant: Any, controller: Any, count: int) -> tuple[Any, Any]:
    """Returns plant and controller with every number repeated for each draw, as `vmap` wants them."""

    def spread(leaf: Any) -> Any:
        leaf = jnp.asarray(leaf)
        return leaf if leaf.ndim and leaf.shape[0] == count else jnp.broadcast_to(leaf, (count, *leaf.shape))

    return jax.tree.map(spread, plant), jax.tree.map(spread, controller)


def compared(count: int, seed: int, dtype: Any) -> dict[str, Any]:
    """Returns how many draws differ, and how many of these are explained."""
    differ = by_step = by_rounding = by_either = 0
    flags: dict[str, int] = {}
    for block in range(-(-count // BLOCK)):
        size = min(BLOCK, count - block * BLOCK)
        plant, controller, starts = draws(size, 1000 * seed + block, dtype)
        swept = cpjax.sweep(plant, controller, starts, duration=DURATION, dt=DT)
        many = each_its_own(plant, controller, size)
        mapped = _one_by_one(*many, starts)
        for flag, number in zip(*np.unique(np.asarray(mapped.flag), return_counts=True), strict=True):
            name = str(int(flag))
            flags[name] = flags.get(name, 0) + int(number)
        apart = np.flatnonzero(np.asarray((mapped.flag != swept.flag) | (mapped.success != swept.success)))
        differ += apart.size
        if apart.size:
            rows = np.resize(apart, 256 * -(-apart.size // 256))
            few = jax.tree.map(lambda leaf, rows=rows: leaf[rows], (*many, jax.tree.map(jnp.asarray, starts)))
            fine = _finer(*few)
            fine_flag, fine_success = np.asarray(fine.flag)[: apart.size], np.asarray(fine.success)[: apart.size]
            flag, success = np.asarray(mapped.flag)[apart], np.asarray(mapped.success)[apart]
            travel, fine_travel = np.asarray(mapped.cart_travel)[apart], np.asarray(fine.cart_travel)[: apart.size]
            other = np.asarray(swept.cart_travel)[apart]
            moved = np.abs(fine_travel - travel) >= np.abs(other - travel)
            stepped = (fine_flag != flag) | (fine_success != success) | moved
            near_flag, near_success = (np.asarray(x)[: apart.size] for x in _nudged(*few))
            rounded = np.any((near_flag != flag[:, None]) | (near_success != success[:, None]), axis=1)
            by_step += int(stepped.sum())
            by_rounding += int(rounded.sum())
            by_either += int((stepped | rounded).sum())
    found: dict[str, Any] = {"dtype": np.dtype(dtype).name, "draws": count, "flags": flags, "differ": differ}
    return found | {"by_step": by_step, "by_rounding": by_rounding, "by_either": by_either}


def main(out: Path, quick: bool = False, seed: int = 1) -> list[dict[str, Any]]:
    """Prints the table and writes sweep_against_measure.json."""
    count = 500 if quick else 1_000_000
    found = [compared(count, seed, dtype) for dtype in (np.float32, np.float64)]
    files.write_json(out / "sweep_against_measure.json", {"versions": files.versions(), "seed": seed, "found": found})
    rows = [
        (
            row["dtype"],
            f"{row['draws']:,}",
            f"{row['draws'] - row['flags'].get('0', 0):,}",
            *(str(row[key]) for key in ("differ", "by_step", "by_rounding", "by_either")),
        )
        for row in found
    ]
    head = (
        "precision",
        "draws",
        "flagged",
        "flag or success differs",
        "decided by the step",
        "by rounding",
        "by either",
    )
    print_table("A sweep against vmap of measure", head, rows, 1)
    return found


if __name__ == "__main__":
    run(main, __doc__.splitlines()[0])
