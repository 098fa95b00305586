"""Plants, controllers and results as JSON or TOML files.

A file holds one component as a table of its fields, tagged with its `type`; the outermost table also has `schema`.
Python floats stay numbers, float64 arrays are plain lists, other arrays are tables of `dtype` and `values`. JSON has no
non-finite numbers; they are the strings "inf", "-inf" and "nan" there.
"""

import dataclasses
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w

from cpjax import files, workspace
from cpjax._moved import moved_attribute
from cpjax.controllers import (
    AngleGate,
    AngleRateGate,
    Digital,
    EnergySwingUp,
    FilteredDerivative,
    Hybrid,
    IntegralAction,
    KalmanFilter,
    LqrWeights,
    LyapunovGate,
    MovingReference,
    Observer,
    PoleFactors,
    SingleLaw,
    SmoothClip,
    SmoothHybrid,
    StateFeedback,
    VoltageSignal,
)
from cpjax.errors import InputError
from cpjax.files import dump_json, read_table, suffix_of, write_text
from cpjax.plant import AccelerationActuator, CartPole, ForceActuator, LumpedMotor, Motor
from cpjax.plant.state import State
from cpjax.pytree import is_traced
from cpjax.rig import (
    Disturbance,
    Drive,
    Encoders,
    Potentiometers,
    Pushes,
    RandomPushes,
    Rig,
    StateSensors,
    Track,
    Wind,
    plant_of,
)
from cpjax.sim.metrics import Metrics, ProtocolMetrics
from cpjax.sim.rollout import Trajectory

SCHEMA = 1
"""Version of the file layout."""

DTYPES = ("bool", "int32", "int64", "float32", "float64")
"""Allowed dtypes of the arrays in a file."""

_KINDS = {"b": "b", "i": "iu", "f": "fiu"}
"""For each kind of dtype, the kinds that the values of such an array may have in a file."""

TYPES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        State,
        Motor,
        CartPole,
        LqrWeights,
        PoleFactors,
        StateFeedback,
        EnergySwingUp,
        AngleGate,
        AngleRateGate,
        LyapunovGate,
        Hybrid,
        SingleLaw,
        SmoothHybrid,
        SmoothClip,
        LumpedMotor,
        ForceActuator,
        AccelerationActuator,
        Encoders,
        Potentiometers,
        StateSensors,
        Drive,
        Track,
        Disturbance,
        Pushes,
        RandomPushes,
        Wind,
        Rig,
        Digital,
        FilteredDerivative,
        Observer,
        IntegralAction,
        MovingReference,
        VoltageSignal,
        KalmanFilter,
        ProtocolMetrics,
        Metrics,
        Trajectory,
    )
}
"""Classes that can be saved, by their tag in the file; see `register`."""

_REGISTERING = ("cpjax.paper",)
"""Modules that register more types when they are imported; imported when a file holds an unknown type."""

_UNCHECKED = (State, Metrics, Trajectory)
"""Classes whose constructors accept any value."""


def register(cls: type) -> type:
    """Registers a class made by `cpjax.pytree.pytree` for saving and loading under its name, and returns the class.

    Raises:
      InputError: another class of that name is registered.
    """
    if TYPES.setdefault(cls.__name__, cls) is not cls:
        raise InputError("cls", cls, "a class with a name of its own")
    return cls


def _known_type(tag: Any) -> type | None:
    if isinstance(tag, str) and tag not in TYPES:
        for name in _REGISTERING:
            importlib.import_module(name)
    return TYPES.get(tag) if isinstance(tag, str) else None


def save(path: str | Path, thing: Any) -> None:
    """Writes a plant, controller, state or result to a file, as JSON or TOML by its extension.

    Args:
      path: a file name that ends in .json or .toml.
      thing: an instance of a class in `TYPES`.

    Raises:
      InputError: another extension, a class that is not in `TYPES`, values that JAX is tracing, or a path that cannot
        be written.
    """
    path = _checked_path(path)
    suffix = suffix_of(path)
    table = {"schema": SCHEMA, **encode(thing)}
    write_text(path, tomli_w.dumps(table) if suffix == ".toml" else dump_json(table))


def load(path: str | Path) -> Any:
    """Reads a file that `save` wrote, or one written by hand in the same layout; fields with a default may be left out.

    Args:
      path: a file name that ends in .json or .toml.

    Raises:
      InputError: no such file, not JSON or TOML, another schema, an unknown type or key, a missing key, or a value
        outside its range.
    """
    path = _checked_path(path)
    table = read_table(path)
    schema = table.pop("schema", SCHEMA)
    if isinstance(schema, bool) or schema != SCHEMA:
        raise InputError(f"{path}: schema", schema, f"{SCHEMA}, the layout that this version of cpjax reads")
    if "type" not in table and "what" in table:
        raise InputError("path", str(path), f"a file with one component; this one holds {contents(table)}")
    return _decode(table, str(path))


def load_part(path: str | Path, key: Literal["plant", "controller", "rig"], wanted: str) -> Any:
    """Reads a component as `load` does, or the plant, controller or rig of a result that a command wrote.

    A result without a rig was computed for its plant alone, which then stands for the rig.

    Args:
      path: a file name that ends in .json or .toml.
      key: the part of a result that is read, and the field that the error names.
      wanted: what the file should hold, in words, for the error.

    Raises:
      InputError: as for `load`, or the file holds something else.
    """
    path = _checked_path(path)
    table = read_table(path)
    for part in ("rig", "plant") if key == "rig" else (key,):
        if "type" not in table and isinstance(table.get(part), dict):
            return _decode(table[part], f"{path}: {part}")
    if _known_type(table.get("type")) is None:
        raise InputError(key, str(path), f"a file that holds {wanted}; this one holds {contents(table)}")
    return load(path)


def contents(table: Mapping[str, Any]) -> str:
    """Describes in words what a file's table holds."""
    if "type" in table:
        return f"a {table['type']}" if isinstance(table["type"], str) else "a table whose type is no text"
    if isinstance(table.get("what"), str):
        return f"a result ({table['what']})"
    keys = [*table][:4] + ["..."] * (len(table) > 4)
    return "a table without a type" + (f" (its keys: {', '.join(keys)})" if keys else ", which is empty")


def encode(thing: Any) -> dict[str, Any]:
    """Converts a component to a table of plain values.

    Raises:
      InputError: a class that is not in `TYPES`, values that JAX is tracing, or values that are not numbers.
    """
    name = type(thing).__name__
    if TYPES.get(name) is not type(thing):
        raise InputError("thing", thing, "one of " + ", ".join(TYPES))
    fields = {f.name: getattr(thing, f.name) for f in dataclasses.fields(TYPES[name])}
    if isinstance(thing, Trajectory):  # the plant's saved outputs become keys beside the other fields
        fields |= fields.pop("outputs")
    given = {key: value for key, value in fields.items() if value is not None}
    return {"type": name, **{key: _encode_value(f"{name}.{key}", value) for key, value in given.items()}}


def encode_bench(rig: Rig | CartPole) -> dict[str, Any]:
    """Returns the entries of a result that say what ran: `plant` and, of a rig, `rig`, which holds the plant too."""
    return {"plant": encode(plant_of(rig)), **({"rig": encode(rig)} if isinstance(rig, Rig) else {})}


def _checked_path(path: Any) -> Path:
    if not isinstance(path, (str, Path)):
        raise InputError("path", path, "a file name, as str or Path; it comes first")
    return Path(path)


def _encode_value(name: str, value: Any) -> Any:
    if is_traced(value):
        raise InputError(name, value, "a value outside jit, vmap and grad")
    if dataclasses.is_dataclass(value):
        return encode(value)
    if isinstance(value, (bool, int, float, str)):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise InputError(name, value, "a number, an array of numbers, or one of " + ", ".join(TYPES))
    if array.dtype.name not in DTYPES:
        raise InputError(name, f"array of dtype {array.dtype}", "of dtype " + ", ".join(DTYPES))
    if array.dtype == np.float64:
        return array.tolist()
    return {"dtype": str(array.dtype), "values": array.tolist()}


def _decode(table: dict[str, Any], path: str) -> Any:
    table = dict(table)
    tag = table.pop("type", None)
    cls = _known_type(tag)
    if cls is None:
        raise InputError(f"{path}: type", tag, "one of " + ", ".join(TYPES))
    fields = {f.name: f for f in dataclasses.fields(cls)}
    if cls is Trajectory:
        table["outputs"] = {key: table.pop(key) for key in list(table) if key not in fields}
    for key in table:
        if key not in fields:
            raise InputError(f"{path}: key", key, f"one of {tag}'s fields: " + ", ".join(fields))
    optional = (dataclasses.MISSING, dataclasses.MISSING)
    for name, field in fields.items():
        if name not in table and (field.default, field.default_factory) == optional:
            raise InputError(f"{path}: key", name, f"present: {tag} has no default for it")
    outputs = table.pop("outputs", {})
    values = {key: _decode_value(value, f"{path}: {key}") for key, value in (table | outputs).items()}
    if cls in _UNCHECKED:
        _check_numbers(cls, values, path)
    if cls is Trajectory:
        values["outputs"] = {key: values.pop(key) for key in outputs}
    try:
        return cls(**values)
    except InputError as problem:
        raise InputError(f"{path}: {problem.field}", problem.value, problem.allowed) from problem


def _check_numbers(cls: type, values: Mapping[str, Any], path: str) -> None:
    """Refuses values that JAX cannot compute with, in a class whose constructor accepts any value."""
    for key, value in values.items():
        name = f"{path}: {cls.__name__}.{key}"
        number = isinstance(value, (int, float, np.ndarray)) and not (cls is State and isinstance(value, bool))
        if key == "state":
            good, allowed = isinstance(value, State), "a table of the type State"
        elif key == "metrics":
            good, allowed = number or dataclasses.is_dataclass(value), "the result of a rollout's metrics"
        else:
            good, allowed = number, "a number or an array of numbers"
        if not good:
            raise InputError(name, value, allowed)


def _decode_value(value: Any, path: str) -> Any:
    if isinstance(value, dict):
        if set(value) != {"dtype", "values"}:
            return _decode(value, path)
        return _array(value["values"], value["dtype"], path, value)
    if isinstance(value, list):
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "fiu" and array.size:
                raise ValueError("text, booleans or an uneven nesting")
            return array.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as problem:
            raise InputError(path, value, f"a list of numbers, nested evenly ({problem})") from problem
    return value


def _array(values: Any, dtype: Any, path: str, shown: Any) -> np.ndarray[Any, Any]:
    """Returns the array of a table of `dtype` and `values`; the values must be numbers of that kind already."""
    try:
        given = np.asarray(values)
        named = np.dtype(dtype) if isinstance(dtype, str) else None
        if named is None or named.name != dtype or dtype not in DTYPES:
            raise ValueError("another dtype")
        if given.size and given.dtype.kind not in _KINDS[named.kind]:
            raise ValueError("values of another kind")
        with np.errstate(over="raise"):
            array = given.astype(named)
        if named.kind == "i" and not np.array_equal(array, given):
            raise ValueError("whole numbers that do not fit")
        return array
    except (TypeError, ValueError, OverflowError, FloatingPointError) as problem:
        allowed = f"a table of dtype and values that fit each other; dtype one of {', '.join(DTYPES)}"
        raise InputError(path, shown, allowed) from problem


def __getattr__(name: str) -> Any:
    """Returns a function that moved from here to `cpjax.files` or `cpjax.workspace`, until version 0.3."""
    return moved_attribute(__name__, name, (files, workspace))
