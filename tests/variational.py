"""Sensitivities of a hybrid closed loop, by SciPy: the variational equation between events, saltation matrices at them.

Written from the mathematics in NumPy. Derivatives of field and guards are differences of what `oracles.py` has.

    S' = f_s S + f_p,      at an event  g(s, p) = 0:   S+ = S- + (f- - f+) dt,   dt = -(g_s S- + g_p) / (g_s f-)
"""

import math
from dataclasses import replace

import numpy as np
from oracles import HybridOracle, derivative
from scipy.integrate import solve_ivp

from cpjax import CartPole, Motor

PLANT = ("cart_mass", "pole_mass", "pole_length", "cart_friction", "pivot_friction")
LAW = ("energy_gain", "cart_stiffness", "cart_damping")


class Loop:
    """A closed loop of one set of parameters: field, guards and what follows them. A mode is (regulating, clip)."""

    def __init__(self, p, gate):
        self.limit = p["voltage_limit"]
        self.plant = replace(CartPole(motor=Motor(voltage_limit=self.limit)), **{name: p[name] for name in PLANT})
        law = {name: p[name] for name in LAW}
        self.law = HybridOracle(self.plant, p["K"], 1.0, kick=0.5, kick_radius=0.02, **law)
        self.margin = lambda s, regulating: gate(p, s, regulating)

    def demand(self, s, regulating):
        return self.law.regulate(s) if regulating else self.law.swing_up(s)

    def field(self, s, mode):
        regulating, clip = mode
        return derivative(self.plant, s, clip * self.limit if clip else self.demand(s, regulating))

    def guards(self, s, mode):
        regulating, clip = mode
        relative = self.demand(s, regulating) / self.limit
        above, below = 1.0 - relative, 1.0 + relative
        gate = self.margin(s, regulating)
        return np.array([-above if clip > 0 else above, -below if clip < 0 else below, gate if regulating else -gate])

    def clip(self, s, regulating):
        demand = self.demand(s, regulating)
        return int(demand > self.limit) - int(demand < -self.limit)

    def after(self, s, mode, guard):
        regulating, clip = mode
        if guard == 2:
            return not regulating, self.clip(s, not regulating)
        return regulating, (0 if clip else 1 - 2 * guard)


def flat(p):
    """Parameters as (name, index) pairs; index None for a number."""
    return [(name, i) for name, value in p.items() for i in ([None] if np.ndim(value) == 0 else range(len(value)))]


def moved(p, name, i, step):
    if i is None:
        return {**p, name: p[name] + step}
    vector = np.array(p[name], dtype=float)
    vector[i] += step
    return {**p, name: vector}


def sensitivities(p, gate, start, duration):
    """The final state (4,), its derivatives in all parameters (4, d) in the order of `flat`, and the events."""
    loop, names = Loop(p, gate), flat(p)
    sizes = [1e-6 * max(abs(p[n] if i is None else p[n][i]), 1e-2) for n, i in names]
    near = [
        (Loop(moved(p, n, i, h), gate), Loop(moved(p, n, i, -h), gate)) for (n, i), h in zip(names, sizes, strict=True)
    ]

    def by_state(function, s, mode):
        columns = []
        for k in range(4):
            h = 1e-6 * max(abs(s[k]), 1e-1)
            columns.append((function(s + h * np.eye(4)[k], mode) - function(s - h * np.eye(4)[k], mode)) / (2 * h))
        return np.stack(columns, axis=-1)

    def by_parameter(what, s, mode):
        pairs = zip(near, sizes, strict=True)
        return np.stack(
            [(getattr(a, what)(s, mode) - getattr(b, what)(s, mode)) / (2 * h) for (a, b), h in pairs], axis=-1
        )

    def rates(_, z, mode):
        s, S = z[:4], z[4:].reshape(4, -1)
        slope = by_state(loop.field, s, mode) @ S + by_parameter("field", s, mode)
        return np.concatenate([loop.field(s, mode), slope.ravel()])

    def event(number):
        def guard(_, z, mode):
            return loop.guards(z[:4], mode)[number]

        guard.terminal, guard.direction = True, -1.0
        return guard

    regulating = loop.margin(start, False) >= 0.0
    mode = (regulating, loop.clip(start, regulating))
    time, z, events = 0.0, np.concatenate([start, np.zeros(4 * len(names))]), []
    while True:
        run = solve_ivp(
            rates,
            (time, duration),
            z,
            args=(mode,),
            method="DOP853",
            rtol=1e-10,
            atol=1e-11,
            events=[event(k) for k in range(3)],
        )
        assert run.success, run.message
        time, z = run.t[-1], run.y[:, -1].copy()
        if run.status == 0:
            return z[:4], z[4:].reshape(4, -1), events
        number = next(k for k in range(3) if len(run.t_events[k]))
        s, S = z[:4], z[4:].reshape(4, -1)
        slope = by_state(loop.guards, s, mode)[number]
        before = loop.field(s, mode)
        moment = -(slope @ S + by_parameter("guards", s, mode)[number]) / (slope @ before)
        following = loop.after(s, mode, number)
        z[4:] = (S + np.outer(before - loop.field(s, following), moment)).ravel()
        events.append((time, number))
        mode = following
        assert len(events) < 200


def angle(p, s, regulating):
    return math.cos(s[2]) - math.cos(p["half_angle"] * (1.0 + p.get("hysteresis", 0.0) * regulating))


def angle_rate(p, s, regulating):
    return 1.0 - (1.0 - math.cos(s[2])) / (1.0 - math.cos(p["half_angle"])) - (s[3] / p["rate"]) ** 2


def level_set(P):
    def margin(p, s, regulating):
        d = np.array([s[0], s[1], math.remainder(s[2], 2.0 * math.pi), s[3]])
        return 1.0 - d @ P @ d / p["level"]

    return margin
