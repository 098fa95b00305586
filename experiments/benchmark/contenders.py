"""One contender of `benchmark.py`, in a process of its own: what it computes, how fast, and whether it is right.

Each does 10 s of the hybrid law from many starts near hanging, on the sampled clock at steps of 2 ms, by the classical
Runge-Kutta method, unless its line in `CONTENDERS` says otherwise. What is checked is how far each cart of 16 goes
within one second, before runs part by what rounding does to them.
"""

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from peers import (
    diffrax_steps,
    jaxonomy_simulator,
    mjx_scan,
    mujoco_rollout,
    numba_loops,
    plain_scan,
    python_control,
    scipy_solver,
)
from problem import CHECKED, CHECKED_STEPS, DT, Run, Task, problem, settings


def cpjax_sweep(task: Task, **options: Any) -> Run:
    """Metrics, or with `save_every` trajectories, by `cpjax.sweep`."""
    import cpjax

    plant, controller = problem()
    return lambda starts, steps: _travel(cpjax.sweep(plant, controller, starts, **settings(steps), **options))


def _travel(found: Any) -> Any:
    return getattr(found, "metrics", found).cart_travel


def cpjax_one(task: Task, compiled: bool = False, **other: Any) -> Run:
    """One start after another, by `cpjax.measure`, as it is or under the caller's `jax.jit`."""
    import jax

    import cpjax

    plant, controller = problem()

    def measure(start: Any, steps: int) -> Any:
        return cpjax.measure(plant, controller, start, **(settings(steps) | other))

    one = jax.jit(measure, static_argnums=1) if compiled else measure

    def run(starts: Any, steps: int) -> Any:
        columns = [jax.tree.map(lambda column, i=i: column[i], starts) for i in range(len(starts.x))]
        return [one(start, steps).cart_travel for start in columns]

    return run


class EffortAndTravel(NamedTuple):
    """The metrics of gradient.c: the integral of u^2 dt, and the largest abs(x), which is not differentiated."""

    def init(self, sample: Any) -> Any:
        return 0.0 * sample.time, 0.0 * sample.time

    def update(self, state: Any, sample: Any) -> Any:
        import jax
        import jax.numpy as jnp

        effort, travel = state
        effort = effort + sample.elapsed * sample.voltage_since * sample.voltage_since
        return effort, jnp.maximum(travel, jnp.abs(jax.lax.stop_gradient(sample.state.x)))

    def finalize(self, state: Any, last: Any) -> Any:
        return state


def cpjax_gradient(task: Task, reverse: bool = True, checkpoint: Any = "segments", few: bool = False) -> Run:
    """The mean effort and, in reverse mode, its gradient in all of the controller's numbers, or in gain and K alone."""
    import jax

    import cpjax

    plant, controller = problem()
    numbers = (controller.swing_up.energy_gain, controller.regulator.K) if few else controller

    def law(numbers: Any) -> Any:
        if not few:
            return numbers
        swing_up = dataclasses.replace(controller.swing_up, energy_gain=numbers[0])
        return dataclasses.replace(controller, swing_up=swing_up, regulator=cpjax.StateFeedback(numbers[1]))

    def cost(numbers: Any, starts: Any, steps: int) -> Any:
        options = settings(steps) | {"checkpoint": checkpoint, "derivative": "pathwise", "metrics": EffortAndTravel()}
        effort, travel = jax.vmap(lambda start: cpjax.measure(plant, law(numbers), start, **options))(starts)
        return effort.mean(), travel

    function = jax.value_and_grad(cost, has_aux=True) if reverse else cost
    compiled = jax.jit(function, static_argnums=2)

    def run(starts: Any, steps: int) -> Any:
        first, second = compiled(numbers, starts, steps)
        return first[1] if reverse else second

    def temporary(starts: Any, steps: int) -> Any:
        memory: Any = compiled.lower(numbers, starts, steps).compile().memory_analysis()
        return memory.temp_size_in_bytes

    run.temporary = temporary  # type: ignore[attr-defined]  # a function may have attributes
    return run


def c_roofline(task: Task) -> Run:
    """By hand in C: see roofline.c."""
    import jax
    import roofline

    import cpjax

    plant, controller = problem()
    trial = cpjax.sample_starts("hanging", 1 if task.starts == 1 else 4096, seed=task.seed)
    trial = jax.tree.map(lambda column: np.asarray(column, task.dtype), trial)
    library, form = roofline.build(task.dtype, plant, controller, trial, task.cores)

    def run(starts: Any, steps: int) -> Any:
        return roofline.run(library, plant, controller, starts, steps, DT, task.cores).cart_travel

    run.form = form.words  # type: ignore[attr-defined]  # a function may have attributes
    return run


def c_gradient(task: Task) -> Run:
    """Values and gradient by hand in C: see gradient.c. The effort and its derivatives in the law's numbers."""
    import jax
    import roofline

    import cpjax

    plant, controller = problem()
    trial = jax.tree.map(np.asarray, cpjax.sample_starts("hanging", task.starts, seed=task.seed))
    trial = jax.tree.map(lambda column: np.asarray(column, task.dtype), trial)
    library, form = roofline.build(task.dtype, plant, controller, trial, task.cores, roofline.GRADIENT)

    def run(starts: Any, steps: int) -> Any:
        return roofline.run_gradient(library, plant, controller, starts, steps, DT)[0]

    run.form = form.words  # type: ignore[attr-defined]  # a function may have attributes
    return run


LONG_STEPS: dict[str, Any] = {"dt": 0.01, "clock": "continuous", "switching": "located"}

CONTENDERS: dict[str, tuple[Callable[[Task], Run], str]] = {
    "C": (c_roofline, "by hand in C"),
    "C, one start": (c_roofline, "by hand in C, compiled for one start"),
    "C, gradient": (c_gradient, "the effort and its gradient in the law's numbers, by hand in C"),
    "cpjax": (cpjax_sweep, "metrics"),
    "cpjax, no options": (cpjax_sweep, "metrics, on as many devices but without options of the compiler"),
    "cpjax, every 10th sample": (partial(cpjax_sweep, save_every=10), "trajectories"),
    "cpjax, every sample": (partial(cpjax_sweep, save_every=1), "trajectories"),
    "cpjax, one start": (cpjax_one, "cpjax.measure, one start after another"),
    "cpjax, one start, under jit": (partial(cpjax_one, compiled=True), "cpjax.measure under jax.jit"),
    "cpjax, one start, 10 ms": (partial(cpjax_one, compiled=True, **LONG_STEPS), "continuous clock, steps of 10 ms"),
    "cpjax, values of 64": (partial(cpjax_gradient, reverse=False), "a cost, under vmap"),
    "cpjax, gradient": (cpjax_gradient, "a cost and its gradient, reverse mode"),
    "cpjax, values of 64, configured": (partial(cpjax_gradient, reverse=False), "after cpjax.configure_cpu"),
    "cpjax, gradient, configured": (cpjax_gradient, "the same after cpjax.configure_cpu"),
    "cpjax, gradient, configured, every step": (
        partial(cpjax_gradient, checkpoint="every_step"),
        "likewise, more remembered",
    ),
    "cpjax, gradient in 5, configured, every step": (
        partial(cpjax_gradient, checkpoint="every_step", few=True),
        "likewise, in the energy gain and K alone",
    ),
    "plain JAX scan": (plain_scan, "lax.scan under vmap, largest |x| only"),
    "diffrax, Heun": (diffrax_steps, "2nd order, continuous clock, no metrics"),
    "diffrax, Tsit5": (partial(diffrax_steps, solver="Tsit5"), "5th order, continuous clock, no metrics"),
    "numba": (numba_loops, "largest |x| only"),
    "MuJoCo rollout": (mujoco_rollout, "voltages given, trajectories"),
    "MJX": (mjx_scan, "largest |x| only"),
    "jaxonomy, RK4": (jaxonomy_simulator, "continuous clock, no metrics"),
    "jaxonomy, its own steps": (partial(jaxonomy_simulator, method="auto"), "likewise, Dopri5, fewer and longer steps"),
    "python-control": (python_control, "trajectories"),
    "SciPy": (scipy_solver, "DOP853, largest |x| only"),
}
CONFIGURED = ("cpjax", "cpjax, every 10th sample", "cpjax, every sample")
"""Those after `cpjax.configure_cpu`, beside those that say so in their names."""

CONTINUOUS = ("cpjax, one start, 10 ms", "diffrax, Heun", "diffrax, Tsit5", "jaxonomy, RK4", "jaxonomy, its own steps")
"""Those on the other clock, checked on it against steps of 2 ms through located switches."""


SECONDS = 2.0
"""So long each is repeated at least: runs of milliseconds are disturbed more easily."""


def measure(name: str, task: Task) -> dict[str, Any]:
    """Times one contender and checks its answer."""
    import jax

    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]  # untyped in JAX
    import cpjax

    if name in CONFIGURED or "configured" in name:
        cpjax.configure_cpu(devices=task.cores)
    else:
        jax.config.update("jax_num_cpu_devices", task.cores)  # type: ignore[no-untyped-call]  # untyped in JAX
    starts = jax.tree.map(
        lambda column: np.asarray(column, task.dtype), cpjax.sample_starts("hanging", task.starts, seed=task.seed)
    )
    run = CONTENDERS[name][0](task)
    begin = time.perf_counter()
    np.asarray(run(starts, task.steps))
    first = time.perf_counter() - begin
    peak = _peak_mebibytes()
    seconds: list[float] = []
    while len(seconds) < task.repeats or (task.repeats > 1 and sum(seconds) < SECONDS):
        begin = time.perf_counter()
        np.asarray(run(starts, task.steps))
        seconds.append(time.perf_counter() - begin)
    temporary = getattr(run, "temporary", lambda *_: None)(starts, task.steps)

    few = jax.tree.map(lambda column: column[:CHECKED], starts)
    found = np.asarray(run(few, CHECKED_STEPS), float)
    exact = jax.tree.map(lambda column: np.asarray(column, float), few)
    plant, controller = problem()
    clock = {"clock": "continuous", "switching": "located"} if name in CONTINUOUS else {}
    right = np.asarray(cpjax.sweep(plant, controller, exact, **(settings(CHECKED_STEPS) | clock)).cart_travel)
    return {
        "name": name,
        **task._asdict(),
        "steps_per_second": task.starts * task.steps / min(seconds),
        "seconds": min(seconds),
        "form": getattr(run, "form", ""),
        "compile_s": max(0.0, first - min(seconds)),
        "peak_MiB": peak,
        "temporary_MiB": None if temporary is None else temporary / 2**20,
        "error_m": float(np.max(np.abs(found - right))),
    }


def _peak_mebibytes() -> float:
    with open("/proc/self/status") as status:
        return int(status.read().split("VmHWM:")[1].split()[0]) / 1024


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=CONTENDERS)
    for field in Task._fields:
        parser.add_argument(f"--{field}", type=str if field == "dtype" else int, required=True)
    given = vars(parser.parse_args())
    chosen = given.pop("name")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: given["cores"]])
    json.dump(measure(chosen, Task(**given)), sys.stdout)
