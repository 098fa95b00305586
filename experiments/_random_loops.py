"""Random closed loops of both designs and every gate, for what is compared over many of them."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import cpjax
from cpjax.sim.flags import STOPPED


@dataclasses.dataclass(frozen=True)
class Group:
    """Loops of one structure."""

    name: str
    design: str
    gate: Callable[[Mapping[str, Any], Any], Any]
    gate_ranges: Mapping[str, tuple[float, float]]

    def build(self, p: Mapping[str, Any]) -> tuple[cpjax.CartPole, cpjax.Hybrid]:
        """Plant and controller; the law's model of the plant is the plant."""
        plant = cpjax.CartPole(
            **{name: p[name] for name in ("cart_mass", "pole_mass", "pole_length", "cart_friction", "pivot_friction")},
            motor=cpjax.Motor(voltage_limit=p["voltage_limit"]),
        )
        A, B = cpjax.linearize(plant)
        P = None
        if self.design == "lqr":
            K, P = cpjax.lqr(A, B, jnp.diag(p["Q"]), p["R"])
        else:
            K = cpjax.place_polynomial(A, B, p["polynomial"])
        law = cpjax.EnergySwingUp(
            plant, **{name: p[name] for name in ("energy_gain", "cart_stiffness", "cart_damping")}
        )
        return plant, cpjax.Hybrid(law, cpjax.StateFeedback(K), self.gate(p, P))


def _angle(p: Mapping[str, Any], P: Any) -> Any:
    return cpjax.AngleGate(half_angle=p["half_angle"], hysteresis=p["hysteresis"])


def _angle_rate(p: Mapping[str, Any], P: Any) -> Any:
    return cpjax.AngleRateGate(half_angle=p["half_angle"], rate=p["rate"])


def _lyapunov(p: Mapping[str, Any], P: Any) -> Any:
    return cpjax.LyapunovGate(P=P, level=p["level"])


GROUPS = (
    Group("lqr, angle and rate", "lqr", _angle_rate, {"half_angle": (0.2, 0.6), "rate": (1.5, 5.0)}),
    Group("lqr, level set", "lqr", _lyapunov, {"level": (2.0, 30.0)}),
    Group("placement, angle and rate", "placement", _angle_rate, {"half_angle": (0.2, 0.6), "rate": (1.5, 5.0)}),
    Group("placement, angle", "placement", _angle, {"half_angle": (0.2, 0.6), "hysteresis": (0.02, 0.2)}),
)

_RANGES = {
    "energy_gain": (2.0, 8.0),
    "cart_stiffness": (1.0, 6.0),
    "cart_damping": (0.5, 4.0),
    "voltage_limit": (9.0, 15.0),
    "cart_mass": (0.8, 1.2),
    "pole_mass": (0.4, 0.6),
    "pole_length": (0.6, 0.8),
    "cart_friction": (0.01, 0.2),
    "pivot_friction": (0.001, 0.01),
}


def draw(
    group: Group, count: int, *, seed: int, duration: float, dt: float
) -> tuple[dict[str, np.ndarray[Any, Any]], cpjax.State, float]:
    """Parameters, each with a leading axis, `hanging` starts, and the share of all draws whose run is stopped.

    Of eight times as many draws, those whose run is not stopped, in equal parts runs that cross the gate once, twice
    and more; as far as there are so many, or else more of those that cross once.
    """
    rng = np.random.default_rng(seed)
    many = 8 * count

    def between(low: Any, high: Any) -> np.ndarray[Any, Any]:
        shape = (many, *np.shape(low))
        return np.exp(rng.uniform(np.log(low), np.log(high), shape))

    p = {name: between(*ends) for name, ends in {**_RANGES, **group.gate_ranges}.items()}
    if group.design == "lqr":
        p["Q"] = between(np.array([5.0, 0.5, 20.0, 0.5]), np.array([50.0, 5.0, 100.0, 5.0]))
        p["R"] = between(0.1, 2.0)
    else:
        a = between(np.array([3.0, 6.0]), np.array([6.0, 14.0]))  # two factors s^2 + a s + b
        b = between(np.array([4.0, 10.0]), np.array([10.0, 50.0]))
        factors = np.stack([np.ones_like(a), a, b], axis=-1)
        p["polynomial"] = np.array([np.polymul(*pair)[1:] for pair in factors])
    starts = cpjax.sample_starts("hanging", many, seed=seed)

    def seen(p: Any, start: cpjax.State) -> tuple[jax.Array, jax.Array]:
        plant, law = group.build(p)
        run = cpjax.measure(plant, law, start, duration=duration, dt=dt, switching="located")
        return run.switches, run.flag

    traced = jax.tree.map(jnp.asarray, (p, starts))
    switches, flags = (np.asarray(column) for column in jax.jit(jax.vmap(seen))(*traced))
    crossings = np.where(flags & STOPPED, -1, np.minimum(switches, 3))
    third = -(-count // 3)
    chosen = [*np.flatnonzero(crossings == 2)[:third], *np.flatnonzero(crossings == 3)[:third]]
    chosen = [*chosen, *np.flatnonzero(crossings == 1)][:count]
    chosen += [i for i in np.flatnonzero(crossings >= 0) if i not in chosen][: count - len(chosen)]
    rows = np.array(chosen)
    return {k: v[rows] for k, v in p.items()}, jax.tree.map(lambda c: c[rows], starts), float(np.mean(crossings < 0))
