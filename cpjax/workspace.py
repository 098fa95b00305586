"""Workspace of a long computation: a folder of partial results, from which an interrupted computation resumes."""

import hashlib
import os
import secrets
import shutil
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar

from cpjax.archive import Arrays, read_archive, write_archive
from cpjax.errors import DamagedFileWarning, InputError
from cpjax.files import dump_json, write_text

try:
    import fcntl
except ImportError:  # Windows: there, two equal computations at once do the same work twice
    fcntl = None  # type: ignore[assignment]  # a module elsewhere

Result = TypeVar("Result")

_LOCK = ".lock"
_DAMAGED = ".damaged"


class Workspace:
    """Folder for the partial results of one computation, as a context manager.

    When the context ends, the folder is removed. If it ends with an exception after something was saved, the partial
    results stay, and the next computation with the same request finds them. One process works in it at a time.

    Attributes:
      folder: the folder.
    """

    def __init__(
        self, folder: Path, request: Mapping[str, Any], *, record: str = "request.json", keep: bool = False
    ) -> None:
        """Reserves a folder, or takes it over from an interrupted computation with the same request.

        Args:
          folder: the folder, which need not exist.
          request: plain values that identify the computation, such as its options, seeds and versions.
          record: name of the file in the folder that records the request.
          keep: whether the folder stays when the context ends: the partial results are the result.

        Raises:
          InputError: the folder holds other files or partial results of another request, is in use by another process,
            or cannot be written.
        """
        text = dump_json(request)
        self.folder = folder
        self._keep = keep
        self._identity = hashlib.sha256(text.encode()).hexdigest()
        self._record, self._lock = folder / record, folder / _LOCK
        self._own = {self._record, self._lock}
        self._handle: int | None = None
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._acquire()
            if not self._record.is_file() or self._record.read_text(encoding="utf-8", errors="replace") != text:
                self._refuse_foreign()
                write_text(self._record, text)
        except BaseException as problem:
            self._leave()
            if isinstance(problem, OSError):
                raise InputError("path", str(folder), f"a place that can be written ({problem})") from problem
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if not self._keep and self.folder.exists():
            saved = {*self.folder.iterdir()} - {self._record, self._lock}
            if kind is None or not saved:
                self._remove()
        self._leave()

    def save(self, name: str, arrays: Mapping[str, Any], note: Any = None) -> None:
        """Writes a partial result to NAME.npz, atomically: arrays by name, and a note of plain values."""
        path = self._path(name)
        write_archive(path, arrays, {"request": self._identity, "name": name, "note": note})

    def load(self, name: str) -> tuple[Arrays, Any] | None:
        """Returns arrays and note of a partial result; None if it is missing or, with a warning, damaged."""
        return self.intact(self._path(name), self._read)

    def intact(self, path: Path, read: Callable[[Path], Result]) -> Result | None:
        """Returns what `read` makes of any file in the folder; None if it is missing or, with a warning, damaged."""
        self._own.add(path)
        return intact(path, read)

    def _path(self, name: str) -> Path:
        path = self.folder / f"{name}.npz"
        self._own.add(path)
        return path

    def _read(self, path: Path) -> tuple[Arrays, Any]:
        arrays, note = read_archive(path)
        if note.get("request") != self._identity or note.get("name") != path.stem:
            raise InputError("path", str(path), "a partial result of this computation")
        return arrays, note["note"]

    def _is_part(self, path: Path) -> bool:
        try:
            self._read(path)
        except InputError:
            return False
        return True

    def _acquire(self) -> None:
        if fcntl is None:
            return
        self._handle = os.open(self._lock, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as problem:
            os.close(self._handle)
            self._handle = None
            allowed = "a folder in which no other process works: wait for it, or choose another one"
            raise InputError("path", str(self.folder), allowed) from problem
        except OSError:
            pass  # a file system without locks: as on Windows

    def _leave(self) -> None:
        if self._handle is not None:
            self._lock.unlink(missing_ok=True)
            os.close(self._handle)
            self._handle = None

    def _refuse_foreign(self) -> None:
        """Raises InputError if the folder holds anything but partial results of this request."""
        for path in sorted(self.folder.iterdir()):
            if path == self._record or path.name.startswith(".") or path.suffix == _DAMAGED or self._is_part(path):
                continue
            allowed = (
                "a place without the parts of other work (other options, initial states or versions); "
                f"{path.name} in it is of such work: delete the folder first"
            )
            raise InputError("path", str(self.folder), allowed)

    def _remove(self) -> None:
        # Renamed first, so that an interruption leaves nothing under this name. Files of others stay. A name with a dot
        # is that of a file whose writing was interrupted.
        # A part that this run did not need is its own all the same.
        inside = {*self.folder.iterdir()}
        own = {path for path in inside if path in self._own or path.name.startswith(".") or self._is_part(path)}
        if own == inside:
            away = self.folder.with_name(f".{self.folder.name}.{os.getpid()}-{secrets.token_hex(4)}")
            self.folder.replace(away)
            shutil.rmtree(away)
        else:
            for path in own:
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def intact(path: Path, read: Callable[[Path], Result]) -> Result | None:
    """Returns what `read` makes of a file, or None if the file is missing or damaged.

    A damaged file is renamed, with a `DamagedFileWarning`, so that it is neither used nor lost.

    Args:
      path: the file.
      read: raises InputError for a damaged file.
    """
    if not os.path.lexists(path):
        return None
    try:
        if not path.is_file():
            raise InputError("path", str(path), "a file")
        return read(path)
    except InputError as problem:
        aside = path.with_name(f"{path.name}.{secrets.token_hex(4)}{_DAMAGED}")
        path.replace(aside)
        message = f"{problem}. It is {aside.name} now, and what it should hold is computed again"
        warnings.warn(message, DamagedFileWarning, stacklevel=2)
        return None
