"""Tables and plain values as JSON and TOML files; every file is written atomically.

JSON has no non-finite numbers; they are the strings "inf", "-inf" and "nan" there.
"""

import importlib.metadata
import json
import math
import os
import re
import secrets
import stat
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cpjax.errors import InputError

_NON_FINITE = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def read_table(path: Path) -> dict[str, Any]:
    """Reads the outermost table of a JSON or TOML file.

    Raises:
      InputError: no such file, or not a table in the format of its extension.
    """
    suffix = suffix_of(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as problem:  # ValueError: not UTF-8, or a null byte in the path
        raise InputError("path", str(path), f"a readable text file ({problem})") from problem
    try:
        table = tomllib.loads(text) if suffix == ".toml" else parse_json(text)
    except (ValueError, RecursionError) as problem:
        raise InputError("path", str(path), f"a valid {suffix[1:].upper()} file ({problem})") from problem
    if not isinstance(table, dict):
        raise InputError("path", str(path), "a file that holds one table")
    return table


def write_json(path: Path, data: Any) -> None:
    """Writes plain values (dicts, lists, numbers, NumPy and JAX arrays) as JSON, atomically."""
    write_text(path, dump_json(data))


def dump_json(data: Any) -> str:
    """Formats plain values as strict JSON, with non-finite numbers as strings."""
    text = json.dumps(_plain(data), indent=1, allow_nan=False)
    # Puts each list of numbers on one line. JSON strings hold no raw line breaks, so none of them changes.
    return re.sub(r"\[[^][{}]*\]", lambda match: re.sub(r"\n\s*", " ", match[0]), text) + "\n"


def parse_json(text: str) -> Any:
    """Returns the plain values of JSON that `dump_json` wrote; ValueError or RecursionError for other text."""
    return _numbers(json.loads(text, object_pairs_hook=_once))


def write_text(path: Path, text: str) -> None:
    """Writes a UTF-8 file atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file atomically: even after an interruption it has either its old content or all of the new.

    Raises:
      InputError: the folder cannot be created, or the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}")
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)  # the umask applies
    except (OSError, ValueError) as problem:  # ValueError: a null byte in the path
        raise InputError("path", str(path), f"a place that can be written ({problem})") from problem
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.chmod(temporary, stat.S_IMODE(path.stat().st_mode))
        os.replace(temporary, path)
    except BaseException as problem:
        temporary.unlink(missing_ok=True)
        if isinstance(problem, OSError):
            raise InputError("path", str(path), f"a place that can be written ({problem})") from problem
        raise


def versions() -> dict[str, str]:
    """Returns the versions of cpjax, JAX, NumPy and SciPy; "0+unknown" for a package that is not installed."""
    return {name: _version(name) for name in ("cpjax", "jax", "jaxlib", "numpy", "scipy")}


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "0+unknown"


def suffix_of(path: Path) -> str:
    """Returns the extension of a file name, in lower case.

    Raises:
      InputError: another one than .json or .toml.
    """
    if path.suffix.lower() not in (".json", ".toml"):
        raise InputError("path", str(path), "a file name that ends in .json or .toml")
    return path.suffix.lower()


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Returns a JSON object as a table and refuses duplicate keys, as TOML does."""
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError("a key is given twice in one table: " + ", ".join(key for key, _ in pairs))
    return table


def _numbers(data: Any) -> Any:
    """Restores the non-finite numbers that `_plain` converted to strings."""
    if isinstance(data, dict):
        return {key: _numbers(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_numbers(value) for value in data]
    return _NON_FINITE.get(data, data) if isinstance(data, str) else data


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {str(key): _plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_plain(value) for value in data]
    if isinstance(data, (np.ndarray, np.generic, jax.Array)):
        return _plain(np.asarray(data).tolist())
    if isinstance(data, float) and not math.isfinite(data):
        return str(data)
    return data
