"""Options that a flag or a TOML file can set.

One declaration serves both: section "plant", key "cart_mass" is `--cart-mass` on the command line and `cart_mass` under
`[plant]` in the file given with `--config`. A flag wins over the file.
"""

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

from cpjax import files
from cpjax.errors import InputError
from cpjax.fields import Choice, Count, Number, rules

Sections: TypeAlias = Mapping[str, Mapping[str, Any]]
"""Values given by the user, by section and key. Those not given are absent."""


@dataclasses.dataclass(frozen=True)
class Option:
    """One option; `flag` where it differs from the key."""

    section: str
    key: str
    help: str
    type: type = str
    choices: Sequence[str] | None = None
    count: int | tuple[int, int] | Literal["+"] | None = None
    """Number of values; "+" for one or more; a pair of numbers for either of the two."""
    flag: str | None = None
    numbers: bool = False
    """Whether a file may give a text as a number, or as a pair of real and imaginary part."""
    old: str | None = None
    """The key until the last release, which works for one more."""

    @property
    def name(self) -> str:
        """The flag, with its dashes."""
        return "--" + (self.flag or self.key.replace("_", "-"))


def options_of(section: str, cls: type, keys: Sequence[str] | None = None, *, defaults: bool = False) -> list[Option]:
    """Returns an option for each declared number or word of a class.

    Args:
      section: the options' section.
      cls: a class whose fields are declared (see `cpjax.fields`).
      keys: the fields to take; None for all.
      defaults: whether the help texts name the class's defaults.
    """
    types = {Number: float, Count: int, Choice: str}
    values = {field.name: field.default for field in dataclasses.fields(cls)}
    old = {new: name for name, new in getattr(cls, "RENAMED", {}).items()}
    return [
        Option(
            section,
            key,
            " ".join([rule.help, f"[{rule.unit}]" * bool(rule.unit), f"(default {values[key]})" * defaults]),
            types[type(rule)],
            choices=rule.options if isinstance(rule, Choice) else None,
            old=old.get(key),
        )
        for key, rule in rules(cls).items()
        if isinstance(rule, Number | Count | Choice) and (keys is None or key in keys)
    ]


def add_options(parser: argparse.ArgumentParser, options: Sequence[Option], *, out: str) -> None:
    """Declares the options, grouped by section, and those that every command has.

    Args:
      out: the default of --out.
    """
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="options from a file, in sections; flags win")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (default 1)")
    parser.add_argument("--out", type=Path, default=Path(out), help=f"folder for what is written (default {out})")
    for section in dict.fromkeys(option.section for option in options):
        group = parser.add_argument_group(f"[{section}]")
        for option in (o for o in options if o.section == section):
            group.add_argument(
                option.name,
                *(["--" + option.old.replace("_", "-")] if option.old else []),
                dest=f"{option.section}.{option.key}",
                type=option.type,
                choices=option.choices,
                nargs="+" if isinstance(option.count, tuple) else option.count,
                action=_one_of(option.count) if isinstance(option.count, tuple) else "store",
                metavar=None if option.choices else option.key.upper(),
                help=option.help + (f" (key: {option.key})" if option.flag else ""),
            )


def _one_of(counts: tuple[int, int]) -> type[argparse.Action]:
    """Returns an action that stores as many values as one of the two counts."""

    class Store(argparse.Action):
        def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
            if len(values) not in counts:
                raise argparse.ArgumentError(self, f"expected {counts[0]} arguments, or {counts[1]}")
            setattr(namespace, self.dest, values)

    return Store


def resolve(given: argparse.Namespace, options: Sequence[Option]) -> Sections:
    """Returns the values of the file and of the flags; flags win.

    Raises:
      InputError: a file that is no TOML, or a section, key or value in it that no option has.
    """
    sections: dict[str, dict[str, Any]] = {option.section: {} for option in options}
    if given.config is not None:
        _read_config(given.config, options, sections)
    for option in options:
        value = getattr(given, f"{option.section}.{option.key}")
        if value is not None:
            sections[option.section][option.key] = value
    return sections


def _counted(count: int | tuple[int, int] | Literal["+"] | None) -> str:
    if count == "+":
        return "a list of values"
    return f"a list of {' or '.join(map(str, count)) if isinstance(count, tuple) else count} values"


def _read_config(path: Path, options: Sequence[Option], sections: dict[str, dict[str, Any]]) -> None:
    if path.suffix.lower() != ".toml":
        raise InputError("--config", str(path), "a TOML file, with a name that ends in .toml")
    known = {(option.section, key): option for option in options for key in (option.key, option.old) if key}
    for section, table in files.read_table(path).items():
        if section not in sections:
            raise InputError(f"{path}: section", section, "one of " + ", ".join(sections))
        if not isinstance(table, dict):
            raise InputError(f"{path}: {section}", table, "a section, written [" + section + "]")
        for key, value in table.items():
            option = known.get((section, key))
            if option is None:
                keys = ", ".join(k for s, k in known if s == section)
                raise InputError(f"{path}: [{section}] key", key, f"one of {keys}")
            sections[section][option.key] = _checked_value(f"{path}: [{section}] {key}", value, option)


def _checked_value(field: str, value: Any, option: Option) -> Any:
    """Returns a value from a file as the flag would have been given it, checked as the flag's would be."""
    kinds = {float: ((int, float), "a number"), int: ((int,), "a whole number"), str: ((str,), "a text")}
    python_types, words = kinds[option.type]
    several = option.count is not None
    if isinstance(option.count, tuple) and isinstance(value, list) and any(isinstance(row, list) for row in value):
        size = math.isqrt(max(option.count))
        if len(value) != size or not all(isinstance(row, list) and len(row) == size for row in value):
            raise InputError(field, value, f"{size} rows of {size} values, or {_counted(option.count)}")
        value = [one for row in value for one in row]
    counts = option.count if isinstance(option.count, tuple) else (option.count,)
    if several and not (isinstance(value, list) and value and ("+" in counts or len(value) in counts)):
        raise InputError(field, value, _counted(option.count))
    if option.numbers:
        value = [_complex_text(one) for one in value]
        words = "texts such as '-5+2j', numbers, or pairs of numbers [real, imaginary]"
    for one in value if several else [value]:
        if isinstance(one, bool) or not isinstance(one, python_types):
            raise InputError(field, value, words)
        if option.type is float and isinstance(one, int) and abs(one) > 10**300:
            raise InputError(field, value, "a number that fits a float")
        if option.choices is not None and one not in option.choices:
            raise InputError(field, value, "one of " + ", ".join(option.choices))
    return value


def _complex_text(value: Any) -> Any:
    """Returns a number, or a pair of real and imaginary part, as text for the flag; other values unchanged."""
    parts = value if isinstance(value, list) and len(value) == 2 else [value]
    if any(isinstance(one, bool) or not isinstance(one, (int, float)) for one in parts):
        return value
    return str(value) if len(parts) == 1 else f"{parts[0]}{float(parts[1]):+}j"
