"""The tuned controllers that come with the package, for the appendix's plant at 12 V; see docs/results.md."""

import importlib.resources
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from cpjax import io
from cpjax.controllers import DesignName, Hybrid
from cpjax.errors import InputError
from cpjax.plant import CartPole, Motor
from cpjax.pytree import Number, rules

PRESETS: Mapping[DesignName, str] = {"lqr": "tuned_lqr", "placement": "tuned_place"}
"""The name of each design's; `cpjax.save` wrote the file of that name in this folder."""


def preset(design: DesignName) -> Hybrid:
    """Loads the tuned hybrid controller whose regulator comes from "lqr" or "placement".

    Both were made for `cpjax.paper.appendix_plant()`, with its supply of 12 V. On another plant they may fail:
    `model_differences(controller, plant)` says whether it is another.

    Raises:
      InputError: another design.
    """
    if design not in PRESETS:
        raise InputError("design", design, "one of " + ", ".join(PRESETS))
    with importlib.resources.as_file(importlib.resources.files(__name__) / f"{PRESETS[design]}.json") as path:
        loaded: Hybrid = io.load(path)
    return loaded


def model_differences(controller: Any, plant: CartPole) -> list[str]:
    """Lists the parameters in which the plant that a controller was made for differs from `plant`, with both values.

    What a controller was made for is the model in its swing-up law. The list is empty where the two agree, and where
    the controller has no model: a linear regulator alone does not know its plant.
    """
    models = [
        leaf
        for leaf in jax.tree.leaves(controller, is_leaf=lambda node: isinstance(node, CartPole))
        if isinstance(leaf, CartPole)
    ]
    found = {}
    for model in models:
        for name, (ours, theirs) in differences(model, plant).items():
            found[name] = f"{name} ({_text(ours)} there, {_text(theirs)} here)"
    return list(found.values())


def differences(one: CartPole, other: CartPole) -> dict[str, tuple[Any, Any]]:
    """The parameters in which two plants differ by more than a rounding to float32, motor included: both values."""
    pairs = [(cls, a, b) for cls, a, b in ((CartPole, one, other), (Motor, one.motor, other.motor))]
    values = {
        name: (getattr(a, name), getattr(b, name))
        for cls, a, b in pairs
        for name, rule in rules(cls).items()
        if isinstance(rule, Number)
    }
    return {name: two for name, two in values.items() if not np.allclose(*two, rtol=1e-6, atol=0.0)}


def _text(value: Any) -> str:
    return f"{float(value):g}" if np.ndim(value) == 0 else "several"
