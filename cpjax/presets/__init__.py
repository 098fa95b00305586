"""Tuned controllers that come with the package: for the plant of the paper's appendix, and for public rigs."""

import importlib.resources
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from cpjax import io
from cpjax.controllers import Hybrid
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.pytree import numbers

PRESETS: Mapping[str, str] = {
    "lqr": "tuned_lqr",
    "placement": "tuned_place",
    "quanser-ip02-long": "tuned_quanser_ip02_long",
}
"""File name, without extension, of each preset in this folder; written by `cpjax tune`. See docs/results.md."""


def preset(design: str) -> Hybrid:
    """Loads a tuned hybrid controller.

    "lqr" and "placement", by the design of their regulators, were tuned for `cpjax.paper.appendix_plant()`, with its
    supply of 12 V; "quanser-ip02-long" for the public rig of that name, within its track. On another plant they may
    fail: `model_differences(controller, plant)` lists the differences.

    Args:
      design: "lqr", "placement" or "quanser-ip02-long".

    Raises:
      InputError: another name.
    """
    if design not in PRESETS:
        raise InputError("design", design, "one of " + ", ".join(PRESETS))
    with importlib.resources.as_file(importlib.resources.files(__name__) / f"{PRESETS[design]}.json") as path:
        loaded: Hybrid = io.load(path)
    return loaded


def model_differences(controller: Any, plant: CartPole) -> list[str]:
    """Lists the parameters, with both values, in which the plant of a controller's design differs from `plant`.

    The plant that a controller was designed for is the model in its swing-up law. The list is empty where the two
    agree, and where the controller contains no model: a linear regulator alone does not.
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
    """Returns both values of each number of plant and drive that differs by more than a rounding to float32.

    Drives of different kinds are compared by what they do to the cart.
    """
    pairs = [(a, b, name) for a, b in ((one, other), (one.motor, other.motor)) for name in _comparable(a, b)]
    values = {name: (_known(a, name), _known(b, name)) for a, b, name in pairs}
    return {name: two for name, two in values.items() if not np.allclose(*two, rtol=1e-6, atol=0.0)}


def _comparable(one: Any, other: Any) -> tuple[str, ...]:
    """Returns the names of the numbers that two plants or two drives are compared by."""
    if isinstance(one, type(other)) or isinstance(other, type(one)):
        return tuple(name for name in numbers(type(one)) if name in numbers(type(other)))
    return ("force_per_voltage", "damping", "reflected_mass", "voltage_limit")


def _known(part: Any, name: str) -> Any:
    value, rule = getattr(part, name), numbers(type(part)).get(name)
    return rule.neutral if value is None and rule is not None else value


def _text(value: Any) -> str:
    return f"{float(value):g}" if np.ndim(value) == 0 else "several"
