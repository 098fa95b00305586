"""The compiler's code gives an initial state the same bits in every whole vector, wherever it is in a sweep."""

import jax
import numpy as np

import cpjax
from cpjax import paper

PLANT = paper.appendix_plant()
CENTRED = paper.controller("corrected-centred", "placement", PLANT)


def test_the_result_does_not_depend_on_chunks_and_blocks():
    starts = cpjax.sample_starts("anywhere", 70, seed=4)

    def swept(**division):
        return jax.tree.leaves(cpjax.sweep(PLANT, CENTRED, starts, duration=0.4, dt=0.002, **division))

    whole = swept()
    for division in ({"chunk": 16}, {"block": 32}, {"chunk": 16, "block": 48}):
        for part, expected in zip(swept(**division), whole, strict=True):
            np.testing.assert_array_equal(part, expected)
    for part, expected in zip(swept(chunk=3), whole, strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-12)
