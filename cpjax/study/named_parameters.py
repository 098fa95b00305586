"""Parameters of a closed loop by name, untransformed: of plant, swing-up law, regulator and gate."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Real

from cpjax.controllers import Hybrid, LqrWeights, PoleFactors, StateFeedback
from cpjax.controllers.protocol import Controller, Law
from cpjax.errors import InputError
from cpjax.linear.lqr import lqr
from cpjax.linear.placement import place_polynomial
from cpjax.plant import CartPole, linearize, with_parameters
from cpjax.pytree import numbers, present

Build: TypeAlias = Callable[[Mapping[str, Float[Array, "..."]]], tuple[CartPole, Controller | Law]]
"""Function from parameters by name, possibly traced, to plant and controller."""


class Parametrisation(NamedTuple):
    """Arguments of `audit_gradients`."""

    build: Build
    parameters: dict[str, Float[ArrayLike, "..."]]
    scales: dict[str, float]


def parametrise(plant: CartPole, controller: Hybrid) -> Parametrisation:
    """Collects the parameters of a closed loop by name: of the plant, the swing-up law, the regulator and the gate.

    The plant's are those of its own (not the motor's) that are declared uncertain, and its voltage limit if finite. The
    law's are those that are not zero, without the kick. The regulator's are those of its design, the diagonal weights
    Q (4,) and R, or the characteristic polynomial (4,) of the four poles; or, without a design or with a full Q, its
    gain K (4,). The law's model of the plant, for which a gain is designed, does not change with the plant.

    Args:
      plant: the plant.
      controller: a `Hybrid` with a `StateFeedback`.

    Raises:
      InputError: a controller that is not a Hybrid with a StateFeedback.
    """
    if not isinstance(controller, Hybrid) or not isinstance(controller.regulator, StateFeedback):
        raise InputError("controller", controller, "a cpjax.Hybrid with a cpjax.StateFeedback")
    law, gate, reference = controller.swing_up, controller.gate, controller.regulator.reference
    of_plant = {name: rule for name, rule in present(plant).items() if rule.uncertain}
    parameters: dict[str, Any] = {name: float(getattr(plant, name)) for name in of_plant}
    if math.isfinite(float(plant.motor.voltage_limit)):
        parameters["voltage_limit"] = float(plant.motor.voltage_limit)
    of_law = [name for name in numbers(type(law)) if not name.startswith("kick")]
    of_gate = numbers(type(gate))
    of_law = [name for name in of_law if float(getattr(law, name)) != 0.0]
    parameters |= {name: float(getattr(law, name)) for name in of_law}
    parameters |= {name: float(getattr(gate, name)) for name in of_gate}
    A, B = linearize(getattr(law, "model", plant))
    design = controller.regulator.design
    if isinstance(design, LqrWeights) and np.array_equal(design.Q, np.diag(np.diagonal(design.Q))):
        parameters |= {"Q": np.diagonal(np.asarray(design.Q, dtype=np.float64)), "R": float(design.R)}
    elif isinstance(design, PoleFactors):
        parameters["polynomial"] = np.asarray(design.polynomial, dtype=np.float64)
    else:
        parameters["K"] = np.asarray(controller.regulator.K, dtype=np.float64)[0]

    def build(p: Mapping[str, Float[Array, "..."]]) -> tuple[CartPole, Hybrid]:
        if "Q" in p:
            K = lqr(A, B, jnp.diag(p["Q"]), p["R"]).K
        else:
            K = place_polynomial(A, B, p["polynomial"]) if "polynomial" in p else p["K"][None]
        changed = with_parameters(plant, {n: p[n] for n in (*of_plant, "voltage_limit") if n in p})
        swing_up: Any = dataclasses.replace(law, **{n: p[n] for n in of_law})  # type: ignore[type-var]  # a dataclass
        region: Any = dataclasses.replace(gate, **{n: p[n] for n in of_gate})  # type: ignore[type-var]  # a dataclass
        return changed, Hybrid(swing_up, StateFeedback(K, reference), region)

    scales = {
        name: rule.size(owner, "change")
        for owner, of_owner in ((plant, of_plant), (gate, of_gate))
        for name, rule in of_owner.items()
        if parameters[name] == 0.0
    }
    return Parametrisation(build, parameters, scales)


def as_matrix(
    parameters: Mapping[str, Real[ArrayLike, "..."]], n: int, each: bool
) -> tuple[tuple[str, ...], Float[np.ndarray, "starts parameters"], Any]:
    """Returns names of the elements, values, and the shapes from which `as_tree` restores the mapping.

    Args:
      parameters: numbers and vectors by name.
      n: number of initial states.
      each: whether the parameters have a leading axis n.

    Raises:
      InputError: no parameter, or one that is not a finite number or vector, with that axis if `each`.
    """
    names: list[str] = []
    columns, shapes = [], []
    for name, value in parameters.items():
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as problem:
            raise InputError(f"parameters[{name}]", value, "a finite number or vector") from problem
        array = array if each else np.broadcast_to(array, (n, *array.shape))
        if array.ndim not in (1, 2) or array.shape[0] != n or not np.all(np.isfinite(array)):
            raise InputError(
                f"parameters[{name}]", value, "a finite number or vector" + (", for each initial state" * each)
            )
        shapes.append((name, array.shape[1:]))
        names += [name] if array.ndim == 1 else [f"{name}[{i}]" for i in range(array.shape[1])]
        columns.append(array.reshape(n, -1))
    if not columns:
        raise InputError("parameters", parameters, "at least one")
    return tuple(names), np.concatenate(columns, axis=1), tuple(shapes)


def as_tree(vector: Float[Array, " parameters"], shapes: Any) -> dict[str, Float[Array, "..."]]:
    """Returns the mapping from one row of values and the shapes that `as_matrix` returned."""
    tree, at = {}, 0
    for name, shape in shapes:
        size = math.prod(shape)
        tree[name] = vector[at : at + size].reshape(shape)
        at += size
    return tree


def parameter_scales(
    names: tuple[str, ...], x: Float[np.ndarray, "starts parameters"], given: Mapping[str, float]
) -> Float[np.ndarray, "starts parameters"]:
    """Returns the change of each element that counts as a relative change by 1: given, or its magnitude.

    Args:
      names: of the elements.
      x: values.
      given: changes by name, of a parameter or of an element such as "Q[0]".

    Raises:
      InputError: an unknown name, a change that is not above 0, or a parameter that is zero without a given change.
    """
    scale = np.abs(x)
    known = {name.split("[")[0] for name in names} | set(names)
    for name, value in given.items():
        if name not in known:
            raise InputError(f"scales[{name}]", value, "the name of a parameter: " + ", ".join(sorted(known)))
        if isinstance(value, (bool, str)) or not (math.isfinite(value) and value > 0):
            raise InputError(f"scales[{name}]", value, "a finite number above 0")
        chosen = [i for i, one in enumerate(names) if name in (one, one.split("[")[0])]
        scale[:, chosen] = value
    zero = [name for name, column in zip(names, scale.T, strict=True) if np.any(column == 0.0)]
    if zero:
        raise InputError(f"scales[{zero[0]}]", given.get(zero[0]), "given, where a parameter is zero")
    return scale
