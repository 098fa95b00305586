"""Files of named arrays with a note: NPZ files with a checksum, so that no damaged file is taken for a whole one."""

import hashlib
import io as buffers
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cpjax.errors import InputError
from cpjax.files import dump_json, parse_json, write_bytes

Arrays = dict[str, np.ndarray]

_NOTE = "cpjax"  # key of the note in the file
_DIGEST = "digest"  # key of the checksum in the note


def write_archive(path: Path, arrays: Mapping[str, Any], note: Mapping[str, Any]) -> None:
    """Writes arrays and a note to an NPZ file, atomically. Equal content gives equal bytes.

    Args:
      path: the file.
      arrays: by name; any but "cpjax".
      note: plain values, stored as JSON.

    Raises:
      InputError: a place that cannot be written.
    """
    buffer = buffers.BytesIO()
    np.savez(buffer, **{_NOTE: np.asarray(dump_json({**note, _DIGEST: digest(arrays)})), **arrays})
    write_bytes(path, buffer.getvalue())


def read_archive(path: Path) -> tuple[Arrays, dict[str, Any]]:
    """Reads arrays and note of a file that `write_archive` wrote.

    Raises:
      InputError: no such file, another kind of file, or one whose content has changed since.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as content:
            arrays = dict(content)
        note = parse_json(str(arrays.pop(_NOTE)))
        # Files of cpjax 0.1 have no checksum.
        if note.pop(_DIGEST, None) not in (None, digest(arrays)):
            raise ValueError("its content was changed")
    except Exception as problem:  # zipfile and NumPy raise nearly anything for a damaged file
        raise InputError("path", str(path), f"a file of arrays that cpjax wrote ({problem})") from problem
    return arrays, note


def digest(arrays: Mapping[str, Any]) -> str:
    """Returns a checksum of arrays with their names, shapes and dtypes."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.shape} {array.dtype.str} ".encode())
        found.update(array.tobytes())
    return found.hexdigest()
