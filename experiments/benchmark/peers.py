"""Other ways to simulate the same closed loop: what each does is said in `contenders.CONTENDERS`."""

from collections.abc import Callable
from typing import Any

import numpy as np
from problem import CHECKED_STEPS, DT, Run, Task, problem, settings


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


def closed_loop() -> Callable[[Any], Any]:
    """The closed loop as an ordinary differential equation: the law is evaluated wherever the derivative is."""
    import jax.numpy as jnp

    import cpjax

    plant, controller = problem()

    def field(s: Any) -> Any:
        state = cpjax.State(*s)
        mode = controller.next_mode(state, jnp.int32(0))
        u = plant.motor.saturate(controller.mode_voltage(state, mode))
        force = plant.motor.force(u, s[1])
        x_ddot, theta_ddot = plant.acceleration(jnp.sin(s[2]), jnp.cos(s[2]), (s[1], s[3]), force)
        return jnp.stack([s[1], x_ddot, s[3], theta_ddot]).astype(s.dtype)

    return field


def diffrax_steps(task: Task, solver: str = "Heun") -> Run:
    """Constant steps by diffrax, which has no hook for a held control."""
    import diffrax
    import jax
    import jax.numpy as jnp

    field = closed_loop()

    def one(start: Any, steps: int) -> Any:
        s = jnp.stack([start.x, start.x_dot, start.theta, start.theta_dot])
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, s, _: field(s)),
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


def mujoco_model() -> Any:
    """The plant as MuJoCo's model."""
    import mujoco

    from cpjax.bridges.mujoco import model_xml

    return mujoco.MjModel.from_xml_string(model_xml(problem()[0], DT))


def mujoco_rollout(task: Task) -> Run:
    """MuJoCo's threads in C++, which take voltages but no law: they get those that cpjax's law applied (not timed)."""
    import jax
    import mujoco
    from mujoco import rollout

    import cpjax

    plant, controller = problem()
    model = mujoco_model()
    threads = [mujoco.MjData(model) for _ in range(task.cores)]
    voltages: dict[tuple[int, int], Any] = {}

    def run(starts: Any, steps: int) -> Any:
        x, x_dot, theta, theta_dot = _columns(starts)
        key = len(x), steps
        if key not in voltages:
            one = jax.jit(jax.vmap(lambda start: cpjax.rollout(plant, controller, start, **settings(steps)).voltage))
            voltages[key] = np.asarray(one(starts))[:, :steps, None]
        first = np.stack([np.zeros_like(x), x, theta, x_dot, theta_dot], axis=1)
        states, _ = rollout.rollout(model, threads, first, voltages[key], persistent_pool=True)
        return np.abs(np.concatenate([first[:, None], states], axis=1)[:, :, 1]).max(1)

    return run


def mjx_scan(task: Task) -> Run:
    """MuJoCo's engine in JAX, the law before each of its steps."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    import cpjax

    _, controller = problem()
    jax.config.update("jax_enable_x64", task.dtype == "float64")  # type: ignore[no-untyped-call]  # untyped in JAX
    model = mjx.put_model(mujoco_model())

    def step(carry: Any, _: None) -> Any:
        data, travel = carry
        state = cpjax.State(data.qpos[0], data.qvel[0], data.qpos[1], data.qvel[1])
        mode = controller.next_mode(state, jnp.int32(0))
        u = jnp.asarray(controller.mode_voltage(state, mode), data.qpos.dtype)
        data = mjx.step(model, data.replace(ctrl=u[None]))
        return (data, jnp.maximum(travel, jnp.abs(data.qpos[0]))), None

    def one(start: Any, steps: int) -> Any:
        data = mjx.make_data(model).replace(
            qpos=jnp.stack([start.x, start.theta]), qvel=jnp.stack([start.x_dot, start.theta_dot])
        )
        return jax.lax.scan(step, (data, jnp.abs(start.x)), None, length=steps)[0][1]

    compiled = jax.jit(lambda starts, steps: jax.vmap(lambda s: one(s, steps))(starts), static_argnums=1)

    def run(starts: Any, steps: int) -> Any:
        return np.asarray(compiled(jax.tree.map(lambda column: column.astype(task.dtype), starts), steps))

    return run


def jaxonomy_simulator(task: Task, method: str = "rk4") -> Run:
    """jaxonomy's simulator, compiled once; the check goes step by step, to see how far the cart went."""
    import jax
    import jax.numpy as jnp
    import jaxonomy

    field = closed_loop()

    class Loop(jaxonomy.LeafSystem):  # type: ignore[misc]  # untyped
        def __init__(self) -> None:
            super().__init__(name="loop")
            self.declare_continuous_state(default_value=jnp.zeros(4), ode=self.ode)

        def ode(self, time: Any, state: Any, *inputs: Any, **parameters: Any) -> Any:
            return field(state.continuous_state)

    system = Loop()
    context = system.create_context()
    step = DT if method == "rk4" else None
    simulator = jaxonomy.Simulator(
        system, options=jaxonomy.SimulatorOptions(ode_solver_method=method, max_minor_step_size=step)
    )

    @jax.jit
    def advance(s: Any, duration: Any) -> Any:
        return simulator.advance_to(duration, context.with_continuous_state(s)).context.continuous_state

    def run(starts: Any, steps: int) -> Any:
        found = []
        pieces = steps if steps == CHECKED_STEPS else 1
        for s in np.stack(_columns(starts), axis=1):
            most = abs(s[0])
            for _ in range(pieces):
                s = np.asarray(advance(s, steps / pieces * DT))
                most = max(most, abs(s[0]))
            found.append(most)
        return np.array(found)

    return run


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
