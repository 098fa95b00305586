"""Measures what each part of `cpjax/backend/`, and each of a sweep's ways to spare work, gains in speed.

    python experiments/ablation.py

Each part is taken out in a process of its own, by replacing it with what anybody would write first, and the cases of
`speed_against.py` are run in turn with and without it: with the compiler's options that `configure_cpu` sets, and
without. Prints the median ratio of neighbouring laps: by how
much the part makes the case faster. A part that gains less than 5 % everywhere should go.
"""

import argparse
import importlib
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from speed_against import Child, answer, cases

from cpjax import files
from cpjax.cli.tables import print_table

CASES = {
    True: ("sweep of 4096, float32", "sweep of 65536, float64", "gradient of 64", "located gradient of 64"),
    False: ("sweep of 4096, float32", "gradient of 64", "located gradient of 64", "one measure under jit"),
}
"""By whether the compiler's options are set."""


def replace(modules: str, name: str, new: Any) -> Any:
    """Puts `new` in the place of a name in modules of cpjax; returns what it was in the last of them."""
    old = None
    for module in map(importlib.import_module, (f"cpjax.{each}" for each in modules.split())):
        old = getattr(module, name)
        setattr(module, name, new)
    return old


def _outline() -> None:
    kernels = importlib.import_module("cpjax.backend.single_kernel")
    called = kernels._called
    replace(
        "backend.single_kernel", "_called", lambda f, marks, s: f if marks is kernels._part else called(f, marks, s)
    )


def _incremental() -> None:
    whole = importlib.import_module("cpjax.sim.stepper").step_held

    def step(plant: Any, method: Any, state: Any, geometry: Any, *others: Any) -> tuple[Any, Any]:
        return whole(plant, method, state, *others), np.bool_(True)

    replace("sim.per_step", "step_held_incremental", step)


def _fast_path() -> None:
    prepare = importlib.import_module("cpjax.sim.sweep").prepare

    def careful(*args: Any, **others: Any) -> Any:
        plan = prepare(*args, **others)
        return plan._replace(kind=plan.kind._replace(settings=plan.kind.settings._replace(fast_path=False)))

    replace("sim.sweep", "prepare", careful)


def _stacked() -> None:
    replace("sim.sweep", "_stacked", jax.tree.leaves)
    replace("sim.sweep", "_unstacked", lambda stacks, like: jax.tree.unflatten(jax.tree.structure(like), stacks))


def _sin_cos() -> None:
    modules = "controllers.energy controllers.gates plant.cartpole sim.metrics"
    replace(modules, "sin_cos", lambda angle: (jnp.sin(angle), jnp.cos(angle)))


def _invariants() -> None:
    replace("sim.scan", "hoisted", lambda function, *_: function)


def _stacks() -> None:
    replace("sim.scan", "apart", jax.tree.leaves)
    replace("sim.scan", "together", lambda leaves, like: jax.tree.unflatten(jax.tree.structure(like), leaves))


PARTS: dict[str, Callable[[], Any]] = {
    "loops as one function": lambda: replace("backend.single_kernel", "_called", lambda function, *_: function),
    "parts of a step as functions": _outline,
    "stacks of shapes of their own": _stacks,
    "own sine and cosine": _sin_cos,
    "invariants outside the loop": _invariants,
    "angles turned between stages": _incremental,
    "failures outside the loop": _fast_path,
    "results of a kind in one array": _stacked,
    "results in aligned memory": lambda: replace("sim.sweep", "_unwritten", np.empty),
}
"""What takes each part out."""


def main(out: Path, quick: bool = False, laps: int = 12) -> dict[str, Any]:
    """Prints the table and writes ablation.json."""
    here, rows = Path(__file__).resolve().parents[1], []
    for configured, names in CASES.items():
        options = ("--configured",) if configured else ()
        with tempfile.TemporaryDirectory() as folder:
            whole = Child(here, folder, __file__, options)
            parts = list(PARTS)[:: 4 if quick else 1]
            for name in names[: 1 if quick else None]:
                whole.seconds(name)  # compiles
            for part in parts:
                without = Child(here, folder, __file__, (*options, "--without", part))
                for name in names[: 1 if quick else None]:
                    without.seconds(name)
                    ratios = [without.seconds(name) / whole.seconds(name) for _ in range(2 if quick else laps)]
                    row = {"part": part, "configured": configured, "case": name, "gain": float(np.median(ratios))}
                    rows.append(row | {"quartiles": np.quantile(ratios, (0.25, 0.75)).tolist()})
                    print(f"{part}, {name}: {row['gain']:.2f}", file=sys.stderr)
                without.close()
            whole.close()
        files.write_json(out / "ablation.json", {"versions": files.versions(), "rows": rows})
    for configured, names in CASES.items():
        gains = {(row["part"], row["case"]): row["gain"] for row in rows if row["configured"] == configured}
        texts = [
            (part, *(f"{gains[part, name]:.2f}" for name in names if (part, name) in gains))
            for part in PARTS
            if any(key[0] == part for key in gains)
        ]
        head = ("part", *(name for name in names if any(key[1] == name for key in gains)))
        title = f"times as long without it, {'with' if configured else 'without'} the compiler's options"
        print_table(title, head, texts, 1)
    return {"rows": rows}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/ablation"), help="folder for the JSON")
    parser.add_argument("--laps", type=int, default=12, help="laps of each case, with and without (12)")
    parser.add_argument("--quick", action="store_true", help="a small version that only shows that it works")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--configured", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--without", default="", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        if given.without:
            PARTS[given.without]()
        answer(cases(given.configured))
    else:
        main(given.out, given.quick, given.laps)
