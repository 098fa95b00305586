"""Access by name to the numbers of a plant and its motor."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from cpjax.errors import InputError
from cpjax.plant.cartpole import CartPole
from cpjax.pytree import Number, Scalars, numbers, present


def parameters_of(plant: CartPole) -> dict[str, Number]:
    """Returns the declarations of the numbers that the plant and its motor have, by name, in order."""
    return present(plant) | (present(plant.motor) if dataclasses.is_dataclass(plant.motor) else {})


def parameter(plant: CartPole, name: str) -> Scalars:
    """Returns the value of a number of the plant or of its motor, in the unit of its declaration."""
    value: Scalars = getattr(plant if name in numbers(type(plant)) else plant.motor, name)
    return value


def with_parameters(plant: CartPole, values: Mapping[str, Scalars]) -> CartPole:
    """Returns the plant with some of its or its motor's numbers replaced.

    Args:
      plant: the plant, which stays as it is.
      values: the new numbers by name, each in the unit of its declaration.

    Raises:
      InputError: a name that neither of them declares, or a concrete value outside its range.
    """
    own, motor = numbers(type(plant)), numbers(type(plant.motor))
    for name in values:
        if name not in own and name not in motor:
            raise InputError(name, values[name], "the value of one of " + ", ".join((*own, *motor)))
    changes: dict[str, Any] = {name: value for name, value in values.items() if name in own}
    others = {name: value for name, value in values.items() if name not in own}
    if others:
        changes["motor"] = dataclasses.replace(plant.motor, **others)
    return dataclasses.replace(plant, **changes)
