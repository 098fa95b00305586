"""Every test runs in float64 with strict dtype promotion; what is about float32 asks for it by name."""

from types import SimpleNamespace

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


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
