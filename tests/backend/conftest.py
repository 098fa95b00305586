"""What the backend makes of a loop is looked at as users have it: compiled with all optimisations."""

import jax
import pytest


@pytest.fixture(autouse=True, scope="module")
def optimised():
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
