"""What every experiment shares: its options, float64, and where results go."""

import argparse
import inspect
from collections.abc import Callable
from pathlib import Path

import jax


def run(main: Callable[..., object], description: str) -> None:
    """Runs `main(out, quick=..., seed=...)` from the command line, with `count=...` if it takes one."""
    parser = argparse.ArgumentParser(description=description)
    name = Path(main.__code__.co_filename).stem
    parser.add_argument("--out", type=Path, default=Path("out") / name, help=f"folder for JSON and PNG (out/{name})")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (1)")
    parser.add_argument("--quick", action="store_true", help="a small version that only shows that it works")
    count = inspect.signature(main).parameters.get("count")
    if count is not None:
        parser.add_argument("--count", type=int, default=count.default, help=f"how many of each ({count.default})")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]  # untyped in JAX
    more = {} if count is None else {"count": given.count}
    main(given.out, quick=given.quick, seed=given.seed, **more)
