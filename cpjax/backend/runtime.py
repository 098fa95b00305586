"""Configuration of JAX for CPUs: cores as devices, and four options of XLA's compiler.

By default XLA's CPU compiler splits one step of a simulation into several functions, recomputes shared results in each,
and calls them one after the other, which takes most of the time. `backend/single_kernel.py` avoids this without
options, but two compiler options are more effective:

    xla_cpu_use_multi_output_fusion          what several results need is computed once
    xla_cpu_small_while_loop_byte_threshold  a whole loop becomes one function

A step of a derivative is hundreds of short loops over the initial states. Unrolled, they are more code than the first
cache holds, which takes longer to compile and to run. Two more options prevent that:

    xla_cpu_disable_loop_unrolling           loops stay short
    xla_cpu_disable_slp_vectorizer           nothing is searched for vectors that the loops have already

XLA does not document them, and they must be set before JAX starts, so a library should not set them unasked:
`configure_cpu` sets them on request, and the command line sets them for itself. They change speed, and results in the
last bits. With an untested jaxlib they are left out, and everything works without them.
"""

import functools
import hashlib
import os
import platform
import warnings
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from cpjax.errors import InputError, PerformanceWarning

TESTED = ("0.10.2",)
"""Versions of jaxlib with which the options were tested."""

_CONFIG: Any = jax.config  # its attributes have no annotations

_OPTIONS = (
    "xla_cpu_use_multi_output_fusion=true,xla_cpu_small_while_loop_byte_threshold=16777216,"
    "xla_cpu_disable_loop_unrolling=true,xla_cpu_disable_slp_vectorizer=true"
)
_FLAG = "--xla_backend_extra_options"


def configure_cpu(devices: int | None = None, *, gradients: bool = False) -> bool:
    """Configures JAX for fast simulations of many initial states on a CPU.

    Call it once, before JAX computes anything. Values, gradients and compiling become faster (docs/performance.md).

    Args:
      devices: number of devices that the CPU appears as, among which `sweep` divides its initial states; by default
        the number of cores that this process may use.
      gradients: without effect; accepted until the next version, because gradients once needed other options.

    Returns:
      Whether the compiler's options were set. They are not with an untested jaxlib, or where XLA_FLAGS has options of
        this kind already.

    Raises:
      InputError: `devices` is not a whole number of at least 1.
      RuntimeError: JAX has already started and can no longer be configured.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    devices = cores if devices is None else devices
    if isinstance(devices, bool) or not isinstance(devices, int) or devices < 1:
        raise InputError("devices", devices, "a whole number of devices, at least 1")
    flags = os.environ.get("XLA_FLAGS", "")
    try:
        if "xla_force_host_platform_device_count" not in flags:
            _CONFIG.update("jax_num_cpu_devices", devices)
        else:  # XLA_FLAGS takes precedence; this only tests whether JAX has started
            _CONFIG.update("jax_num_cpu_devices", _CONFIG.jax_num_cpu_devices)
    except RuntimeError as problem:
        message = "configure_cpu is too late: JAX has started. Call it before anything is computed with JAX"
        raise RuntimeError(message) from problem
    if not jaxlib_is_tested() or _FLAG in flags:
        return False
    os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}={_OPTIONS}".strip()
    return True


def keep_compilations() -> Path | None:
    """Makes JAX cache compiled code on disk for later processes; returns the folder, or None if that is impossible.

    The folder is in the user's cache folder ($XDG_CACHE_HOME or ~/.cache), unless JAX's own settings name another or
    disable the cache.
    """
    folder = _CONFIG.jax_compilation_cache_dir
    if not _CONFIG.jax_enable_compilation_cache:
        return None
    if folder is None:
        # Compiled code is specific to one kind of CPU, and several kinds may share a home folder.
        kind = hashlib.sha256(instruction_set().encode()).hexdigest()[:12]
        cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
        folder = os.path.join(cache, "cpjax", kind)
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return None
    if not os.access(folder, os.W_OK):
        return None
    for name, value in (
        ("jax_compilation_cache_dir", folder),
        ("jax_persistent_cache_min_compile_time_secs", 0.1),
        ("jax_persistent_cache_min_entry_size_bytes", 0),
    ):
        _CONFIG.update(name, value)
    return Path(folder)


def instruction_set() -> str:
    """Returns a text that identifies the instruction set of this CPU."""
    try:
        with open("/proc/cpuinfo") as lines:
            flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    except OSError:
        flags = platform.processor()
    return f"{platform.machine()} {flags}"


@functools.cache
def compiler_fuses_loops() -> bool:
    """Returns whether XLA compiles a small loop as one function, found by compiling one; starts JAX."""
    if jax.default_backend() != "cpu":
        return False

    def loop(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 8, lambda _, y: jnp.sin(y) + y, x)

    # 64 KiB: by default only loops over less than 1 KiB become one function.
    text = jax.jit(loop).lower(jnp.zeros((1 << 14,), jnp.float32)).compile().as_text() or ""
    return "xla_cpu_small_call" in text


@functools.cache
def jaxlib_is_tested() -> bool:
    """Returns whether this version of jaxlib was tested with the undocumented features used here; warns once if not."""
    tested = version("jaxlib") in TESTED
    if not tested:
        message = (
            f"jaxlib {version('jaxlib')} was not tested with cpjax's ways to make XLA fast on a CPU, so they are left "
            f"out: expect simulations to be several times slower than with jaxlib {' or '.join(TESTED)}"
        )
        warnings.warn(message, PerformanceWarning, stacklevel=2)
    return tested


def compiler_options(platform: str) -> dict[str, Any]:
    """Returns the options for `jax.jit` of a function that simulates a batch on `platform`."""
    # The widest vectors of the CPU; by default LLVM uses only half the width of AVX-512.
    return {"xla_cpu_prefer_vector_width": 512} if platform == "cpu" else {}
