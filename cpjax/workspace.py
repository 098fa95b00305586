"""Folders for the partial results of long computations."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cpjax.errors import InputError
from cpjax.files import dump_json, write_text


@contextlib.contextmanager
def parts_of(folder: Path, request: Mapping[str, Any]) -> Iterator[Path]:
    """Provides a folder for the partial results of a long computation, as a context manager.

    The folder is removed when the computation completes, or stops before it has saved anything. If it stops later, the
    partial results stay for the next call with the same request.

    Args:
      folder: the folder, which need not exist.
      request: plain values that identify the computation, such as its options, seeds and versions.

    Raises:
      InputError: as for `claim`.
    """
    path = folder / "request.json"
    claim(path, request)
    try:
        yield folder
    except BaseException:
        if [*folder.iterdir()] == [path]:
            release(folder)
        raise
    release(folder)


def claim(path: Path, request: Mapping[str, Any]) -> None:
    """Reserves a folder for the partial results of a computation, or checks that it is reserved for the same one.

    Args:
      path: the file in this folder that records the request.
      request: plain values that identify the computation.

    Raises:
      InputError: the folder holds partial results of another request, or cannot be written.
    """
    asked = dump_json(request)
    try:
        others = [one for one in path.parent.iterdir() if one != path] if path.parent.exists() else []
        same = path.exists() and path.read_text(encoding="utf-8", errors="replace") == asked
    except OSError as problem:
        raise InputError("path", str(path), f"a place that can be written ({problem})") from problem
    if others and not same:
        allowed = "a place without the parts of other work (other options, starts or versions); delete them first"
        raise InputError("path", str(path.parent), allowed)
    if not same:
        write_text(path, asked)


def release(folder: Path) -> None:
    """Removes a claimed folder, after renaming it, so that an interruption leaves no partial results under its name."""
    away = folder.with_name(f".{folder.name}.{os.getpid()}-{secrets.token_hex(4)}")
    folder.replace(away)
    shutil.rmtree(away)
