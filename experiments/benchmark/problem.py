"""What every contender does, and from what."""

from collections.abc import Callable
from typing import Any, NamedTuple

DT = 2e-3
CHECKED, CHECKED_STEPS = 16, 500


class Task(NamedTuple):
    """What is asked of a contender."""

    dtype: str
    starts: int
    steps: int
    seed: int
    cores: int
    repeats: int


Run = Callable[[Any, int], Any]
"""Of starts and a number of steps: how far each cart goes [m], or for gradients anything."""


def problem() -> tuple[Any, Any]:
    """The plant and the controller of everybody: the paper's plant, the tuned LQR preset."""
    from cpjax import paper, presets

    return paper.appendix_plant(), presets.preset("lqr")


def settings(steps: int) -> dict[str, Any]:
    """Arguments of cpjax's rollouts."""
    return {"duration": steps * DT, "dt": DT, "clock": "sampled"}
