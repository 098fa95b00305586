"""Files of arrays with a note: what was written comes back, and nothing else is taken."""

import numpy as np
import pytest
from tables import rows

from cpjax.archive import read_archive, write_archive
from cpjax.errors import InputError

ARRAYS = {
    "doubles": np.array([0.1 + 0.2, np.inf, -0.0, np.nan, 5e-324]),
    "singles": np.linspace(0.0, 1.0, 6, dtype=np.float32).reshape(2, 3),
    "flags": np.array([True, False]),
    "empty": np.zeros((0, 4)),
}
NOTE = {"name": "first", "history": [{"score": -np.inf, "best": 1 / 3}, {"score": np.nan}], "none": None}


@pytest.fixture
def path(tmp_path):
    write_archive(tmp_path / "a.npz", ARRAYS, NOTE)
    return tmp_path / "a.npz"


def test_arrays_and_note_come_back_to_the_last_bit_and_equal_content_is_equal_bytes(path):
    arrays, note = read_archive(path)
    assert list(arrays) == list(ARRAYS)
    for name, array in arrays.items():
        assert array.dtype == ARRAYS[name].dtype
        assert array.shape == ARRAYS[name].shape
        assert array.tobytes() == ARRAYS[name].tobytes()
    assert repr(note) == repr(NOTE)  # NaN is NaN there
    write_archive(path.with_name("b.npz"), ARRAYS, NOTE)
    assert path.with_name("b.npz").read_bytes() == path.read_bytes()


def damaged(content, random):
    """One of several damages to the bytes of a file, drawn at random."""
    kind, place = random.integers(5), int(random.integers(len(content)))
    if kind == 0:  # one bit
        return content[:place] + bytes([content[place] ^ 1 << int(random.integers(8))]) + content[place + 1 :]
    if kind == 1:  # its end is missing
        return content[:place]
    if kind == 2:  # a block of zeros, as after a crash of the machine
        return content[:place] + bytes(len(content[place : place + 64])) + content[place + 64 :]
    if kind == 3:  # two blocks in each other's place
        first, second = sorted(random.integers(0, len(content) - 32, 2))
        blocks = content[second : second + 32], content[first : first + 32]
        content = content[:first] + blocks[0] + content[first + 32 :]
        return content[:second] + blocks[1] + content[second + 32 :]
    return random.bytes(place)  # another file


def test_no_damage_is_taken_for_the_content(path):
    content, random, refused = path.read_bytes(), np.random.default_rng(1), 0
    for _ in range(500):
        path.write_bytes(damaged(content, random))
        try:
            arrays, note = read_archive(path)
        except InputError:
            refused += 1
        else:  # a bit of the container that says nothing, such as a date
            assert repr(note) == repr(NOTE)
            assert all(arrays[name].tobytes() == array.tobytes() for name, array in ARRAYS.items())
    assert refused > 400


@rows("change", [{"doubles": np.zeros(5)}, {"more": np.zeros(1)}, {"flags": np.array([1, 0], np.int8)}])
def test_an_array_that_was_changed_is_noticed(change, path):
    with np.load(path) as content:
        np.savez(path, **{**content, **change})
    with pytest.raises(InputError, match="its content was changed"):
        read_archive(path)
