"""Times this commit against an older one, in turn, on this machine.

    python experiments/speed_against.py --against main~10

Checks the older commit out beside this one and gives each a process of its own, which stays. Every case is compiled in
both and then run in turn, old, new, new, old, so that a busy machine disturbs both alike. Prints the medians and the
median ratio of neighbouring laps: above 1 this commit is faster. The cases name every argument: defaults may differ.
Each case comes after `configure_cpu()`, and once more with nothing set but the devices.
"""

import argparse
import dataclasses
import functools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Cases = dict[str, tuple[Callable[[], Any], float, int]]
"""By name: what to call, its work (million steps, or calls), and how often a lap calls it."""


def cases(configured: bool = True) -> Cases:
    """Returns the cases with the package that this process has imported, with or without the compiler's options."""
    import jax
    import jax.numpy as jnp

    import cpjax
    from cpjax import paper

    if configured:
        cpjax.configure_cpu()
    else:
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)  # type: ignore[no-untyped-call]  # untyped in JAX

    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]  # untyped in JAX
    plant = paper.appendix_plant()
    controller: Any = cpjax.preset("lqr")
    common: dict[str, Any] = {"clock": "sampled", "duration": 4.0, "dt": 2e-3}
    located = common | {"clock": "continuous", "switching": "located"}
    # The argument is newer than the clock that it belongs to.
    declared = getattr(cpjax, "Simulation", None)
    plain = common | ({"derivative": "pathwise"} if declared and "derivative" in declared.__annotations__ else {})

    # Numbers and a vector: a derivative in one of them can miss what slows the others.
    laws = {"swing_up": ("energy_gain", "cart_stiffness", "cart_damping"), "regulator": ("K",), "gate": ("rate",)}
    numbers = {
        part: {name: jnp.asarray(getattr(getattr(controller, part), name)) for name in names}
        for part, names in laws.items()
    }

    def outside(numbers: Any, start: Any, settings: dict[str, Any]) -> Any:
        parts = {part: dataclasses.replace(getattr(controller, part), **of) for part, of in numbers.items()}
        law = dataclasses.replace(controller, **parts)
        return cpjax.measure(plant, law, start, metrics=cpjax.TimeOutside(), **settings)

    def batched(settings: dict[str, Any], differentiate: bool) -> Callable[..., Any]:
        def one(numbers: Any, start: Any) -> Any:
            return outside(numbers, start, settings)

        def gradients(numbers: Any, starts: Any) -> Any:
            return cpjax.gradients(one, numbers, starts)

        return jax.jit(gradients if differentiate else jax.vmap(one, in_axes=(None, 0)))

    found: Cases = {}
    drawn = {count: cpjax.sample_starts("hanging", count, seed=1) for count in (4096, 65_536)}
    for count in drawn:
        for dtype in (np.float32, np.float64):
            starts = jax.tree.map(functools.partial(jnp.asarray, dtype=dtype), drawn[count])
            sweep = functools.partial(cpjax.sweep, plant, controller, starts, **common)
            found[f"sweep of {count}, {dtype.__name__}"] = sweep, count * 2e-3, 65_536 // count // 4 or 1
    starts = cpjax.sample_starts("hanging", 64, seed=1)
    for name, settings, differentiate in (
        ("gradient of 64", plain, True),
        ("gradient of 64, every step kept", plain | {"checkpoint": "every_step"}, True),
        ("gradient of 64, continuous clock", plain | {"clock": "continuous"}, True),
        ("located values of 64", located, False),
        ("located gradient of 64", located, True),
    ):
        found[name] = functools.partial(batched(settings, differentiate), numbers, starts), 64 * 2e-3, 4
    start = cpjax.State(0.0, 0.0, np.pi - 0.01, 0.0)
    measure = jax.jit(lambda numbers: outside(numbers, start, plain))
    found["one measure under jit"] = lambda: measure(numbers), 1e-6, 100
    found["one measure"] = lambda: cpjax.measure(plant, controller, start, **common), 1e-6, 100
    found["one rollout"] = lambda: cpjax.rollout(plant, controller, start, **common).state.x, 1e-6, 100
    return found


def answer(known: Cases) -> None:
    """Runs the case named by each line of standard input and prints its seconds."""
    import jax

    import cpjax

    work = {name: work for name, (_, work, _) in known.items()}
    print(json.dumps({"from": cpjax.__file__, "work": work}), flush=True)
    begun: set[str] = set()
    for line in sys.stdin:
        call, _, calls = known[line.strip()]
        calls = calls if line in begun else 1
        begun.add(line)
        before = time.perf_counter()
        for _ in range(calls):
            jax.block_until_ready(call())  # type: ignore[no-untyped-call]  # untyped in JAX
        print((time.perf_counter() - before) / calls, flush=True)


class Child:
    """A process that imports the package from a tree."""

    def __init__(self, tree: Path, folder: str | Path, script: str = __file__, options: tuple[str, ...] = ()) -> None:
        self.process = subprocess.Popen(
            [sys.executable, script, "--child", *options],
            env=os.environ | {"PYTHONPATH": str(tree)},
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        first = json.loads(self._line())
        if not Path(first["from"]).is_relative_to(tree.resolve()):
            raise RuntimeError(f"{first['from']} is not in {tree}")
        self.work: dict[str, float] = first["work"]

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("a child has ended")
        return line

    def seconds(self, name: str) -> float:
        """Returns the seconds of one call in a lap."""
        assert self.process.stdin is not None
        self.process.stdin.write(name + "\n")
        self.process.stdin.flush()
        return float(self._line())

    def close(self) -> None:
        """Ends the process."""
        self.process.kill()
        self.process.communicate()


def main(out: Path, quick: bool = False, against: str = "HEAD", laps: int = 20, case: str = "") -> dict[str, Any]:
    """Runs both commits in turn, prints the table and writes speed_against.json."""
    # Not above: a child that takes its names from here has the older commit's package.
    from cpjax import files
    from cpjax.cli.tables import print_table

    here = Path(__file__).resolve().parents[1]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder) / "old"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(old), against], cwd=here, check=True)
        children: dict[tuple[str, ...], dict[str, Child]] = {}
        try:
            modes: list[tuple[str, ...]] = [(), ("--unconfigured",)]
            for options in modes:
                for which, tree in {"old": old, "new": here}.items():
                    children.setdefault(options, {})[which] = Child(tree, folder, options=options)
            work = children[()]["new"].work
            asked: list[tuple[str, tuple[str, ...]]] = [(name, ()) for name in work]
            asked += [(name, ("--unconfigured",)) for name in work if "gradient" in name]
            asked = [("one rollout", ()), ("gradient of 64", ("--unconfigured",))] if quick else asked
            for name, options in asked:
                label = f"{name}, no options" if options else name
                if case not in label:
                    continue
                both = children[options]
                row: dict[str, Any] = {"case": label}
                row |= {f"first_{which}": child.seconds(name) for which, child in both.items()}
                seconds: dict[str, list[float]] = {"old": [], "new": []}
                for lap in range(2 if quick else laps):
                    for which in ("old", "new") if lap % 2 else ("new", "old"):
                        seconds[which].append(both[which].seconds(name))
                ratios = np.divide(seconds["old"], seconds["new"])
                row |= {which: work[name] / float(np.median(seconds[which])) for which in both}
                row |= {"ratio": float(np.median(ratios)), "quartiles": np.quantile(ratios, (0.25, 0.75)).tolist()}
                rows.append(row)
                print(f"{row['case']}: {row['ratio']:.3f}", file=sys.stderr)
        finally:
            for child in [child for both in children.values() for child in both.values()]:
                child.close()
            subprocess.run(["git", "worktree", "remove", "--force", str(old)], cwd=here, check=True)
    files.write_json(out / "speed_against.json", {"versions": files.versions(), "against": against, "rows": rows})
    texts = [
        (
            row["case"],
            *(f"{row[key]:.4g}" for key in ("old", "new")),
            f"{row['ratio']:.3f}",
            "{:.2f} to {:.2f}".format(*row["quartiles"]),
            *(f"{row[key]:.2f}" for key in ("first_old", "first_new")),
        )
        for row in rows
    ]
    head = ("case", "old", "new", "new / old", "quartiles", "first call, old [s]", "new [s]")
    print_table(f"million steps/s (one: million calls/s), this commit against {against}", head, texts, 1)
    return {"rows": rows}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", default="HEAD~1", help="commit to compare with (HEAD~1)")
    parser.add_argument("--out", type=Path, default=Path("out/speed_against"), help="folder for the JSON")
    parser.add_argument("--laps", type=int, default=20, help="laps of each case and commit (20)")
    parser.add_argument("--case", default="", help="only the cases whose name holds this text")
    parser.add_argument("--quick", action="store_true", help="a small version that only shows that it works")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--unconfigured", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        answer(cases(not given.unconfigured))
    else:
        main(given.out, given.quick, given.against, given.laps, given.case)
