"""The text of a rig's file, in TOML with comments: what each field means, and what the rig could have beside it."""

import dataclasses
import inspect
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any

import tomli_w

from cpjax import io
from cpjax.errors import printable
from cpjax.fields import Choice, Part, numbers, rules
from cpjax.rig import Rig

_WIDTH = 100
_COLUMN = 36  # where comments beside values begin, at the latest


def rig_text(rig: Rig, heading: Sequence[str] = ()) -> str:
    """Returns the text of a TOML file that `cpjax.load` reads as this rig.

    Units and meanings are those of the fields' declarations. Optional parts that the rig does not have are there as
    comments, with their defaults.

    Args:
      rig: the rig.
      heading: paragraphs for the top.
    """
    lines = [line for text in heading for line in _comment(text)]
    lines += ["", f"schema = {io.SCHEMA}", *_table("", rig)]
    return "\n".join(lines) + "\n"


def _comment(text: str) -> list[str]:
    return ["# " + line for line in textwrap.wrap(printable(text), _WIDTH - 2)]


def _table(path: str, thing: Any) -> Iterator[str]:
    """Yields the lines of a component: its values, then its parts as tables of their own."""
    plain = io.encode(thing)
    values = {key: value for key, value in plain.items() if not _is_component(value)}
    if path:
        yield from _comment(_summary(type(thing)))
        yield f"[{path}]"
    yield from _rows({key: _toml(value) for key, value in values.items()}, type(thing))
    absent = {key: "?" for key in numbers(type(thing)) if getattr(thing, key) is None}
    yield from ("# " + row for row in _rows(absent, type(thing)))
    for field in dataclasses.fields(thing):
        below = f"{path}.{field.name}" if path else field.name
        part, kind = getattr(thing, field.name), _optional_component(type(thing), field.name)
        if dataclasses.is_dataclass(part):
            yield ""
            rule = rules(type(thing)).get(field.name)
            if isinstance(rule, Part) and " or " in rule.help:
                yield from _comment(f"{field.name}: {rule.help}")
            yield from _table(below, part)
        elif part is None and kind is not None:
            yield ""
            yield from _comment(f"No {field.name}. To add: uncomment the lines below, and fill in each ?")
            yield from _absent(below, kind)


def _absent(path: str, kind: type) -> Iterator[str]:
    """Yields the commented lines of a part that is not there, with its defaults."""
    values = {"type": _toml(kind.__name__)}
    for field in dataclasses.fields(kind):
        if field.default_factory is not dataclasses.MISSING or field.default is None:
            continue
        values[field.name] = "?" if field.default is dataclasses.MISSING else _toml(field.default)
    yield from _comment(_summary(kind))
    yield f"# [{path}]"
    yield from ("# " + row for row in _rows(values, kind))
    absent = {key: "?" for key in numbers(kind) if key not in values}
    yield from ("# # " + row for row in _rows(absent, kind))


def _rows(values: dict[str, str], kind: type) -> Iterator[str]:
    """Yields `key = value`, with what a declaration says of the field as a comment beside it."""
    texts = {key: f"{key} = {value}" for key, value in values.items()}
    column = min(_COLUMN, max(map(len, texts.values()), default=0))
    for key, text in texts.items():
        rule = rules(kind).get(key)
        if rule is None:
            yield text
            continue
        unit = f" [{rule.unit}]" if rule.unit else ""
        more = f" ({rule.allowed()})" if isinstance(rule, Choice) else ""
        yield f"{text.ljust(column)}  # {rule.help}{unit}{more}"


def _toml(value: Any) -> str:
    """Returns a plain value as TOML; a table on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + " }"
    text = tomli_w.dumps({"key": value}).removeprefix("key = ").strip()
    return " ".join(text.split()) if isinstance(value, list) else text


def _is_component(value: Any) -> bool:
    return isinstance(value, dict) and "type" in value


def _summary(kind: type) -> str:
    return (inspect.getdoc(kind) or kind.__name__).splitlines()[0]


def _optional_component(owner: type, name: str) -> type | None:
    """Returns the class of an optional part, from its annotation `Class | None`; None for other fields."""
    hint = typing.get_type_hints(owner).get(name)
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return None
    kinds = [kind for kind in typing.get_args(hint) if dataclasses.is_dataclass(kind)]
    return kinds[0] if kinds and isinstance(kinds[0], type) else None
