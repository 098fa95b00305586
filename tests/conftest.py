"""Every test runs in float64 with strict dtype promotion; what is about float32 asks for it by name."""

import gc
import os
from pathlib import Path
from types import SimpleNamespace

# What one test, worker or process of the tests has compiled no other compiles again. With a bound on its size JAX locks
# the folder, so that workers can share it. Delete it at will.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / "build" / "compilations"))
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(1 << 32))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


# Tracing makes many objects and hardly any garbage: by default much of the time goes to searching for it.
gc.set_threshold(200_000, 20, 20)


@pytest.fixture(autouse=True, scope="module")
def forget_compilations():
    """What a file compiled no other uses; kept, it is gigabytes in the end."""
    yield
    jax.clear_caches()


@pytest.fixture
def command(capsys):
    """Runs a command; its exit code, standard output and standard error."""
    from cpjax.cli import main  # not before the settings above

    def call(*arguments):
        code = main([str(a) for a in arguments])
        out, err = capsys.readouterr()
        return SimpleNamespace(code=code, out=out, err=err)

    return call
