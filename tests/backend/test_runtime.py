"""What has to be set before JAX starts, each in a process that has not started it."""

import os
import subprocess
import sys

import jax.numpy as jnp
import pytest

import cpjax

REPORT = """
import os, sys, jax, cpjax
from cpjax.backend import runtime
{before}
done = runtime.configure_cpu({arguments})
print(done, len(jax.devices()), runtime.compiler_fuses_loops(), os.environ.get("XLA_FLAGS", ""))
"""


def in_a_process(arguments="", before="", flags=None):
    """What `configure_cpu` returns, how many devices there are then, whether loops are fast, and XLA_FLAGS."""
    environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
    environment |= {} if flags is None else {"XLA_FLAGS": flags}
    script = REPORT.format(arguments=arguments, before=before)
    output = subprocess.run([sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True)
    return output.stdout.strip().split(" ", 3)


def test_cores_become_devices_and_loops_one_function():
    done, devices, fast, flags = in_a_process("devices=3")
    assert (done, devices, fast) == ("True", "3", "True")
    assert flags.startswith("--xla_backend_extra_options=")


def test_by_default_each_core_of_the_process_is_a_device():
    assert in_a_process()[1] == str(len(os.sched_getaffinity(0)))


def test_what_gradients_once_needed_is_accepted_and_without_effect():
    assert in_a_process("devices=2, gradients=True") == in_a_process("devices=2")


def test_another_jaxlib_than_the_tested_ones_keeps_its_own_options():
    assert in_a_process("devices=2", before="runtime.TESTED = ('0.0.1',)") == ["False", "2", "False"]


def test_what_a_user_has_set_stays():
    own = "--xla_force_host_platform_device_count=4 --xla_backend_extra_options=xla_cpu_use_multi_output_fusion=true"
    assert in_a_process("devices=2", flags=own) == ["False", "4", "False", own]


def test_once_jax_has_started_it_is_too_late():
    jnp.zeros(()).block_until_ready()
    with pytest.raises(RuntimeError, match="too late: JAX has started"):
        cpjax.configure_cpu()


@pytest.mark.parametrize("devices", [0, -1, 1.5, True, "2"])
def test_a_bad_number_of_devices_is_refused(devices):
    with pytest.raises(cpjax.InputError, match=r"devices .* a whole number of devices, at least 1"):
        cpjax.configure_cpu(devices)
