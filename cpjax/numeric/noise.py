"""Counter-based random numbers: pure functions of a key and a counter, so that no chunk, device or resume changes them.

The generator is Threefry-2x32 with 20 rounds (Salmon and others, "Parallel random numbers: as easy as 1, 2, 3", 2011),
the one of `jax.random`, written out so that it becomes part of a loop's single kernel.
"""

import math
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from cpjax.backend.trigonometry import sin_cos

Word: TypeAlias = UInt32[Array, "*batch"]
"""32 random or counted bits."""

_ROTATIONS = (13, 15, 26, 6, 17, 29, 16, 24)
_PARITY = np.uint32(0x1BD11BDA)
_ULP = np.float32(2.0**-24)


def random_bits(key: tuple[Word, Word], counter: tuple[Word, Word]) -> tuple[Word, Word]:
    """Returns 64 random bits, as two words, for a key and a counter."""
    schedule = (*key, key[0] ^ key[1] ^ _PARITY)
    a, b = counter[0] + schedule[0], counter[1] + schedule[1]
    for group in range(5):
        for rotation in _ROTATIONS[4 * (group % 2) : 4 * (group % 2) + 4]:
            a = a + b
            b = ((b << np.uint32(rotation)) | (b >> np.uint32(32 - rotation))) ^ a
        a = a + schedule[(group + 1) % 3]
        b = b + schedule[(group + 2) % 3] + np.uint32(group + 1)
    return a, b


def standard_normals(
    key: tuple[Word, Word], counter: tuple[Word, Word], dtype: np.dtype
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Returns two independent standard normal numbers for a key and a counter (Box and Muller, 1958).

    Args:
      key: two words, such as a seed and a purpose.
      counter: two words, such as the number of a run and that of a step.
      dtype: of the result. It is computed in float32, so that both precisions see the same noise.
    """
    a, b = random_bits(key, counter)
    uniform, turn = ((word >> np.uint32(8)).astype(jnp.int32).astype(jnp.float32) * _ULP for word in (a, b))
    radius = jnp.sqrt(-2.0 * jnp.log(uniform + np.float32(2.0**-25)))
    sin, cos = sin_cos(np.float32(2.0 * math.pi) * turn - np.float32(math.pi))
    return (radius * cos).astype(dtype), (radius * sin).astype(dtype)
