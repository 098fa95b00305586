"""One contender of `benchmark.py`, in a process of its own: what it computes, how fast, and whether it is right.

Each does 10 s of the hybrid law from many starts near hanging, on the sampled clock at steps of 2 ms, by the classical
Runge-Kutta method, unless its line in `CONTENDERS` says otherwise. What is checked is how far each cart of 16 goes
within one second, before runs part by what rounding does to them.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

DT = 2e-3
CHECKED, CHECKED_STEPS = 16, 500


class Task(NamedTuple):
    """What is asked of a contender."""

    dtype: str
    starts: int
    steps: int
    seed: int
    cores: int
    repeats: int


Run = Callable[[Any, int], Any]
"""Of starts and a number of steps: how far each cart goes [m], or for gradients anything."""


def problem() -> tuple[Any, Any]:
    """The plant and the controller of everybody: the paper's plant, the tuned LQR preset."""
    from cpjax import paper, presets

    return paper.appendix_plant(), presets.preset("lqr")


def settings(steps: int) -> dict[str, Any]:
    """Arguments of cpjax's rollouts."""
    return {"duration": steps * DT, "dt": DT, "clock": "sampled"}


def cpjax_sweep(task: Task, **options: Any) -> Run:
    """Metrics, or with `save_every` trajectories, by `cpjax.sweep`."""
    import cpjax

    plant, controller = problem()
    return lambda starts, steps: _travel(cpjax.sweep(plant, controller, starts, **settings(steps), **options))


def _travel(found: Any) -> Any:
    return getattr(found, "metrics", found).cart_travel


def cpjax_one(task: Task, compiled: bool = False) -> Run:
    """One start after another, by `cpjax.measure`, as it is or under the caller's `jax.jit`."""
    import jax

    import cpjax

    plant, controller = problem()

    def measure(start: Any, steps: int) -> Any:
        return cpjax.measure(plant, controller, start, **settings(steps))

    one = jax.jit(measure, static_argnums=1) if compiled else measure

    def run(starts: Any, steps: int) -> Any:
        columns = [jax.tree.map(lambda column, i=i: column[i], starts) for i in range(len(starts.x))]
        return [one(start, steps).cart_travel for start in columns]

    return run


def cpjax_gradient(task: Task, reverse: bool = True, checkpoint: Any = "segments") -> Run:
    """The mean voltage variation and, in reverse mode, its gradient in all of the controller's numbers."""
    import jax

    import cpjax

    plant, controller = problem()

    def cost(controller: Any, starts: Any, steps: int) -> Any:
        options = settings(steps) | {"checkpoint": checkpoint}
        metrics = jax.vmap(lambda start: cpjax.measure(plant, controller, start, **options))(starts)
        return metrics.effort.mean(), metrics.cart_travel

    function = jax.value_and_grad(cost, has_aux=True) if reverse else cost
    compiled = jax.jit(function, static_argnums=2)

    def run(starts: Any, steps: int) -> Any:
        first, second = compiled(controller, starts, steps)
        return first[1] if reverse else second

    def temporary(starts: Any, steps: int) -> Any:
        memory: Any = compiled.lower(controller, starts, steps).compile().memory_analysis()
        return memory.temp_size_in_bytes

    run.temporary = temporary  # type: ignore[attr-defined]  # a function may have attributes
    return run


def c_roofline(task: Task, one: bool = False) -> Run:
    """By hand in C: see roofline.c."""
    import roofline

    plant, controller = problem()
    library = roofline.build(Path(tempfile.mkdtemp()), task.dtype, one)
    threads = 1 if one else task.cores
    return lambda starts, steps: roofline.run(library, plant, controller, starts, steps, DT, threads).cart_travel


def plain_scan(task: Task) -> Run:
    """The textbook way in JAX: a step that is easy to read, `lax.scan` over it, `vmap` over that."""
    import jax
    import jax.numpy as jnp

    import cpjax

    plant, controller = problem()

    def derivative(s: Any, u: Any) -> Any:
        sin, cos = jnp.sin(s[2]), jnp.cos(s[2])
        x_ddot, theta_ddot = plant.acceleration(sin, cos, (s[1], s[3]), plant.motor.force(u, s[1]))
        return jnp.stack([s[1], x_ddot, s[3], theta_ddot])

    def step(carry: Any, _: None) -> Any:
        s, travel = carry
        state = cpjax.State(*s)
        mode = controller.next_mode(state, jnp.int32(0))
        u = plant.motor.saturate(controller.mode_voltage(state, mode)).astype(s.dtype)
        k1 = derivative(s, u)
        k2 = derivative(s + DT / 2 * k1, u)
        k3 = derivative(s + DT / 2 * k2, u)
        k4 = derivative(s + DT * k3, u)
        s = s + (DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).astype(s.dtype)
        return (s, jnp.maximum(travel, jnp.abs(s[0]))), None

    def one(start: Any, steps: int) -> Any:
        s = jnp.stack([start.x, start.x_dot, start.theta, start.theta_dot])
        return jax.lax.scan(step, (s, jnp.abs(s[0])), None, length=steps)[0][1]

    compiled = jax.jit(lambda starts, steps: jax.vmap(lambda s: one(s, steps))(starts), static_argnums=1)
    return lambda starts, steps: np.asarray(compiled(starts, steps))


def diffrax_steps(task: Task, solver: str = "Heun") -> Run:
    """Constant steps by diffrax, which has no hook for a held control: the law is evaluated in every stage."""
    import diffrax
    import jax
    import jax.numpy as jnp

    import cpjax

    plant, controller = problem()

    def field(t: Any, s: Any, _: Any) -> Any:
        state = cpjax.State(*s)
        mode = controller.next_mode(state, jnp.int32(0))
        u = plant.motor.saturate(controller.mode_voltage(state, mode))
        force = plant.motor.force(u, s[1])
        x_ddot, theta_ddot = plant.acceleration(jnp.sin(s[2]), jnp.cos(s[2]), (s[1], s[3]), force)
        return jnp.stack([s[1], x_ddot, s[3], theta_ddot]).astype(s.dtype)

    def one(start: Any, steps: int) -> Any:
        s = jnp.stack([start.x, start.x_dot, start.theta, start.theta_dot])
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            getattr(diffrax, solver)(),
            0.0,
            steps * DT,
            DT,
            s,
            saveat=diffrax.SaveAt(steps=True) if steps == CHECKED_STEPS else diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.ConstantStepSize(),
            max_steps=steps + 4 if steps == CHECKED_STEPS else None,
            adjoint=diffrax.DirectAdjoint() if steps == CHECKED_STEPS else diffrax.ForwardMode(),
        )
        x = found.ys[:, 0]
        return jnp.max(jnp.where(jnp.isfinite(x), jnp.abs(x), 0.0))

    compiled = jax.jit(lambda starts, steps: jax.vmap(lambda s: one(s, steps))(starts), static_argnums=1)
    return lambda starts, steps: np.asarray(compiled(starts, steps))


def numba_loops(task: Task) -> Run:
    """Loops in Python over numbers, compiled by numba for all cores, with its fast arithmetic."""
    import numba
    import roofline

    plant, controller = problem()
    numba.set_num_threads(task.cores)
    p = np.asarray(roofline._parameters(plant, controller, DT), task.dtype)
    pi = p.dtype.type(np.pi)

    def rates_of(p: Any, sin: Any, cos: Any, v: Any, w: Any, u: Any) -> Any:
        push = p[10] * u - (p[11] + p[8]) * v - p[3] * w * w * sin
        torque = p[4] * sin - p[9] * w
        total, coupling = p[1] + p[2], p[3] * cos
        inverse = 1 / (total * p[5] - coupling * coupling)
        return (p[5] * push + coupling * torque) * inverse, (total * torque + coupling * push) * inverse

    rates = numba.njit(fastmath=True, inline="always")(rates_of)

    def law_of(p: Any, x: Any, v: Any, theta: Any, w: Any) -> Any:
        sin, cos = np.sin(theta), np.cos(theta)
        if 1 - (1 - cos) / p[22] - (w / p[23]) ** 2 >= 0:
            wrapped = theta - 2 * pi * np.rint(theta / (2 * pi))
            u = -(p[18] * x + p[19] * v + p[20] * wrapped + p[21] * w)
        else:
            kinetic = p.dtype.type(0.5) * p[5] * w * w
            depth = max(1 - (kinetic / p[4] + (1 + cos)) / p[17], 0)
            near = depth * depth * depth if p[16] != 0 else p.dtype.type(0)
            pump = -p[13] * (kinetic + p[4] * (cos - 1)) * w * cos
            wanted = pump - (1 - near) * (p[14] * x + p[15] * v) + near * p[16]
            theta_ddot = (p[3] * cos * wanted + p[4] * sin - p[9] * w) / p[5]
            force = (p[1] + p[2]) * wanted - p[3] * cos * theta_ddot + p[3] * sin * w * w + p[8] * v
            u = (force + p[11] * v) / p[10]
        return min(max(u, -p[12]), p[12])

    law = numba.njit(fastmath=True, inline="always")(law_of)

    def run_all(p: Any, columns: Any, steps: int) -> Any:
        travel = np.empty(columns.shape[1], columns.dtype)
        half, dt = p[0] / 2, p[0]
        for i in numba.prange(columns.shape[1]):
            x, v, theta, w = columns[0, i], columns[1, i], columns[2, i], columns[3, i]
            most = abs(x)
            for _ in range(steps):
                u = law(p, x, v, theta, w)
                a1, b1 = rates(p, np.sin(theta), np.cos(theta), v, w, u)
                v2, w2 = v + half * a1, w + half * b1
                t2 = theta + half * w
                a2, b2 = rates(p, np.sin(t2), np.cos(t2), v2, w2, u)
                v3, w3 = v + half * a2, w + half * b2
                t3 = theta + half * w2
                a3, b3 = rates(p, np.sin(t3), np.cos(t3), v3, w3, u)
                v4, w4 = v + dt * a3, w + dt * b3
                t4 = theta + dt * w3
                a4, b4 = rates(p, np.sin(t4), np.cos(t4), v4, w4, u)
                x += dt / 6 * (v + 2 * v2 + 2 * v3 + v4)
                theta += dt / 6 * (w + 2 * w2 + 2 * w3 + w4)
                v += dt / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
                w += dt / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
                most = max(most, abs(x))
            travel[i] = most
        return travel

    run = numba.njit(fastmath=True, parallel=True)(run_all)
    return lambda starts, steps: run(p, np.stack([np.asarray(column) for column in _columns(starts)]), steps)


def _columns(starts: Any) -> list[Any]:
    return [np.asarray(getattr(starts, name)) for name in ("x", "x_dot", "theta", "theta_dot")]


def python_control(task: Task) -> Run:
    """The closed loop as a system of python-control, which calls Python at every step."""
    import control

    from cpjax.bridges.python_control import closed_loop_system

    plant, controller = problem()
    system = closed_loop_system(plant, controller, control_period=DT)

    def run(starts: Any, steps: int) -> Any:
        times, found = np.arange(steps + 1) * DT, []
        for x in np.stack(_columns(starts), axis=1):
            response = control.input_output_response(system, times, 0, [*map(float, x), 0.0])
            found.append(np.abs(response.outputs[0]).max())
        return np.array(found)

    return run


def scipy_solver(task: Task) -> Run:
    """SciPy's DOP853, at its default accuracy and with its own steps, from control instant to control instant."""
    from scipy.integrate import solve_ivp

    import cpjax

    plant, controller = problem()
    motor = plant.motor

    def run(starts: Any, steps: int) -> Any:
        import jax

        @jax.jit
        def voltage(s: Any) -> Any:
            state = cpjax.State(*s)
            mode = controller.next_mode(state, np.int32(0))
            return motor.saturate(controller.mode_voltage(state, mode))

        def field(t: float, s: Any, u: float) -> Any:
            sin, cos = np.sin(s[2]), np.cos(s[2])
            x_ddot, theta_ddot = plant.acceleration(sin, cos, (s[1], s[3]), motor.force(u, s[1]))
            return [s[1], float(x_ddot), s[3], float(theta_ddot)]

        found = []
        for s in np.stack(_columns(starts), axis=1).astype(float):
            most = abs(s[0])
            for _ in range(steps):
                u = float(voltage(s))
                s = solve_ivp(field, (0.0, DT), s, method="DOP853", args=(u,), rtol=1e-6, atol=1e-9).y[:, -1]
                most = max(most, abs(s[0]))
            found.append(most)
        return np.array(found)

    return run


CONTENDERS: dict[str, tuple[Callable[[Task], Run], str]] = {
    "C": (c_roofline, "by hand in C"),
    "C, one start": (partial(c_roofline, one=True), "by hand in C, compiled for one start"),
    "cpjax": (cpjax_sweep, "metrics"),
    "cpjax, no options": (cpjax_sweep, "metrics, on as many devices but without options of the compiler"),
    "cpjax, every 10th sample": (partial(cpjax_sweep, save_every=10), "trajectories"),
    "cpjax, every sample": (partial(cpjax_sweep, save_every=1), "trajectories"),
    "cpjax, one start": (cpjax_one, "cpjax.measure, one start after another"),
    "cpjax, one start, under jit": (partial(cpjax_one, compiled=True), "cpjax.measure under jax.jit"),
    "cpjax, values of 64": (partial(cpjax_gradient, reverse=False), "a cost, under vmap"),
    "cpjax, gradient": (cpjax_gradient, "a cost and its gradient, reverse mode"),
    "cpjax, gradient with options": (cpjax_gradient, "the same after cpjax.configure_cpu"),
    "cpjax, gradient, every step": (partial(cpjax_gradient, checkpoint="every_step"), "likewise, more remembered"),
    "plain JAX scan": (plain_scan, "lax.scan under vmap, largest |x| only"),
    "diffrax, Heun": (diffrax_steps, "2nd order, continuous clock, no metrics"),
    "diffrax, Tsit5": (partial(diffrax_steps, solver="Tsit5"), "5th order, continuous clock, no metrics"),
    "numba": (numba_loops, "largest |x| only"),
    "python-control": (python_control, "trajectories"),
    "SciPy": (scipy_solver, "DOP853, largest |x| only"),
}
CONFIGURED = ("cpjax", "cpjax, every 10th sample", "cpjax, every sample", "cpjax, gradient with options")
"""Those after `cpjax.configure_cpu`, which is for all of them but the gradient."""

CONTINUOUS = ("diffrax, Heun", "diffrax, Tsit5")
"""Those on the other clock: their carts go nearly as far."""


def measure(name: str, task: Task) -> dict[str, Any]:
    """Times one contender and checks its answer."""
    import jax

    jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]  # untyped in JAX
    import cpjax

    if name in CONFIGURED:
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
    seconds = []
    for _ in range(task.repeats):
        begin = time.perf_counter()
        np.asarray(run(starts, task.steps))
        seconds.append(time.perf_counter() - begin)
    temporary = getattr(run, "temporary", lambda *_: None)(starts, task.steps)

    few = jax.tree.map(lambda column: column[:CHECKED], starts)
    found = np.asarray(run(few, CHECKED_STEPS), float)
    exact = jax.tree.map(lambda column: np.asarray(column, float), few)
    plant, controller = problem()
    clock = {"clock": "continuous"} if name in CONTINUOUS else {}
    right = np.asarray(cpjax.sweep(plant, controller, exact, **(settings(CHECKED_STEPS) | clock)).cart_travel)
    return {
        "name": name,
        **task._asdict(),
        "steps_per_second": task.starts * task.steps / min(seconds),
        "seconds": min(seconds),
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
