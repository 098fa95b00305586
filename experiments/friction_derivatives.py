"""Are derivatives through dry friction that sticks right? 200 random loops, on both clocks, against differences.

    python experiments/friction_derivatives.py

Every loop has a random plant, dry friction of cart and pivot, a ratio of static to sliding friction between 1 and 1.5,
a law and an initial state: a hybrid or a state feedback on the continuous clock, the energy law or a state feedback on
the sampled clock, always with located switching. The derivatives of the final state by forward and by reverse mode are
compared with Ridders' extrapolated central differences. An error counts relative to the largest derivative of that
component of the final state, each multiplied by the size of its parameter.

A difference counts only if both of its runs have the events of the unchanged run, in their order. Where too few do,
the run nearly touches an event that it does not have (a graze), and the difference's own estimate of its error says so:
such derivatives are counted apart. Where a loop slides, its derivatives in that friction must not be zero.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _common import run

import cpjax
from cpjax import files
from cpjax.cli.tables import print_table
from cpjax.numeric.differences import central_differences

DURATION, DT = 1.2, 2e-3
STEPS = 2.0 ** -np.arange(7.0, 22.0)
BOUND = 1e-6

_RANGES = {
    "cart_mass": (0.4, 1.2),
    "pole_mass": (0.1, 0.5),
    "pole_length": (0.2, 0.7),
    "cart_friction": (0.01, 0.5),
    "pivot_friction": (0.0005, 0.01),
    "coulomb_friction": (0.3, 4.0),
    "pivot_coulomb_friction": (0.003, 0.06),
    "static_friction_ratio": (1.0, 1.5),
    "voltage_limit": (6.0, 15.0),
    "energy_gain": (4.0, 30.0),
    "cart_stiffness": (1.0, 6.0),
    "cart_damping": (0.5, 4.0),
    "half_angle": (0.2, 0.6),
    "weight": (0.1, 2.0),
}
_PLANT = tuple(_RANGES)[:8]
_GROUPS: Mapping[str, dict[str, Any]] = {
    "hybrid": {"clock": "continuous"},
    "feedback, continuous": {"clock": "continuous"},
    "energy": {"clock": "sampled", "switching": "located", "control_period": 5 * DT},
    "feedback, sampled": {"clock": "sampled", "switching": "located", "control_period": 5 * DT},
}


class Events(NamedTuple):
    """A metric: the events of a run in order, as a number; whether cart and pole slide, and how often they stick."""

    def init(self, sample: Any) -> Any:
        count = jnp.zeros_like(sample.mode)
        return count, sample.plant_mode, (count, count), (count, count)

    def update(self, memory: Any, sample: Any) -> Any:
        order, before, slid, stuck = memory
        now = sample.plant_mode
        changed = (sample.crossing > 0) | (now.cart != before.cart) | (now.pole != before.pole)
        code = 1 + sample.crossing + 16 * (now.cart + 3) + 128 * (now.pole + 3)
        moving = sample.elapsed > 0.0
        slid = jax.tree.map(lambda s, m: s | (moving & (jnp.abs(m) == 1)).astype(s.dtype), slid, tuple(now))
        stops = [((b != 0) & (n == 0)).astype(n.dtype) for b, n in zip(before, now, strict=True)]
        stuck = jax.tree.map(jnp.add, stuck, tuple(stops))
        return jnp.where(changed, 1_000_003 * order + code, order), now, slid, stuck

    def finalize(self, memory: Any, last: Any) -> Any:
        order, _, slid, stuck = memory
        return order, slid, stuck, last.flag


def build(group: str, p: Mapping[str, Any]) -> tuple[cpjax.CartPole, Any]:
    """Returns plant and controller; the law's model of the plant is the plant without dry friction."""
    plant = cpjax.CartPole(**{k: p[k] for k in _PLANT}, motor=cpjax.Motor(voltage_limit=p["voltage_limit"]))
    smooth = dataclasses.replace(plant, coulomb_friction=None, pivot_coulomb_friction=None)
    feedback = cpjax.StateFeedback(
        cpjax.lqr(*cpjax.linearize(smooth), jnp.diag(jnp.array([20.0, 1.0, 50.0, 1.0])), p["weight"]).K
    )
    if group.startswith("feedback"):
        return plant, feedback
    law = cpjax.EnergySwingUp(smooth, **{k: p[k] for k in ("energy_gain", "cart_stiffness", "cart_damping")}, kick=0.0)
    return plant, law if group == "energy" else cpjax.Hybrid(law, feedback, cpjax.AngleGate(p["half_angle"]))


def draw(group: str, count: int, seed: int) -> dict[str, Any]:
    """Returns random parameters and initial states, each with a leading axis."""
    rng = np.random.default_rng(seed)
    p: dict[str, Any] = {
        k: np.exp(rng.uniform(math.log(ends[0]), math.log(ends[1]), count)) for k, ends in _RANGES.items()
    }
    upright = group.startswith("feedback")
    sizes = {"x": 0.15, "x_dot": 0.4, "theta": 0.25 if upright else 1.0, "theta_dot": 0.5 if upright else 2.0}
    start = {k: rng.uniform(-size, size, count) for k, size in sizes.items()}
    still = rng.uniform(size=(2, count)) < 0.25  # some begin at rest
    start["x_dot"][still[0]], start["theta_dot"][still[1]] = 0.0, 0.0
    if not upright:
        start["theta"] += math.pi
    return {**p, **start}


@functools.cache
def compiled(group: str) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Returns final states and events, and their derivatives by forward and by reverse mode, for many loops."""

    def final(p: Mapping[str, Any]) -> Any:
        plant, controller = build(group, p)
        start = cpjax.State(*(p[k] for k in ("x", "x_dot", "theta", "theta_dot")))
        settings: dict[str, Any] = {"duration": DURATION, "dt": DT, "save_every": round(DURATION / DT)}
        found = cpjax.rollout(plant, controller, start, metrics=Events(), spare_steps=600, **settings, **_GROUPS[group])
        return found.state.vector()[-1], found.metrics

    def state(p: Mapping[str, Any]) -> Any:
        return final(p)[0]

    return jax.jit(jax.vmap(final)), jax.jit(jax.vmap(jax.jacfwd(state))), jax.jit(jax.vmap(jax.jacrev(state)))


def compare(group: str, count: int, seed: int) -> dict[str, Any]:
    """Returns what the comparison of one group's loops found."""
    p = jax.tree.map(jnp.asarray, draw(group, count, seed))
    final, forward, reverse = compiled(group)
    values, (order, slid, stuck, flag) = jax.tree.map(np.asarray, final(p))
    jacobians = [jax.tree.map(np.asarray, f(p)) for f in (forward, reverse)]
    fixed = ("x_dot", "theta_dot")  # a rest that is moved is none
    names = list(p)
    ad, backward, differences, doubts = [], [], [], []
    for name in names:
        size = np.maximum(np.abs(p[name]), 1e-2)

        def both(h: float, name: str = name, size: Any = size) -> Any:
            return tuple(np.asarray(final({**p, name: p[name] + sign * h * size})[0]) for sign in (1.0, -1.0))

        def valid(h: float, name: str = name, size: Any = size) -> Any:
            same = [np.asarray(final({**p, name: p[name] + s * h * size})[1][0]) == order for s in (1.0, -1.0)]
            return (same[0] & same[1])[:, None] & np.ones(4, bool)

        found = central_differences(both, STEPS, valid)
        rest = (np.asarray(p[name]) == 0.0)[:, None] if name in fixed else False
        ad.append(np.where(rest, 0.0, jacobians[0][name] * size[:, None]))
        backward.append(np.where(rest, 0.0, jacobians[1][name] * size[:, None]))
        differences.append(np.where(rest, 0.0, found.derivative))
        doubts.append(np.where(rest, 0.0, found.uncertainty))
    one, other, exact, doubt = (np.stack(x, axis=-1) for x in (ad, backward, differences, doubts))
    scale = np.max(np.abs(one), axis=-1, keepdims=True)
    scale = np.where(scale == 0.0, 1.0, scale)
    running = (flag == 0)[:, None, None]
    decided = running & (doubt <= 0.1 * BOUND * scale)
    error = np.where(decided, np.abs(one - exact) / scale, 0.0)
    disagree = np.where(running, np.abs(one - other) / scale, 0.0)
    index = {k: names.index(k) for k in ("coulomb_friction", "pivot_coulomb_friction")}
    zeros = [
        np.sum((flag == 0) & (s == 1) & np.all(one[..., index[k]] == 0.0, axis=-1))
        for s, k in zip(slid, index, strict=True)
    ]
    undecided = ~decided & running
    grazing = np.isinf(doubt) & running
    worst = np.unravel_index(np.argmax(error), error.shape)
    return {
        "group": group,
        "loops": count,
        "flagged": int(np.sum(flag != 0)),
        "slid": [int(np.sum(s)) for s in slid],
        "stuck": [int(np.sum(s)) for s in stuck],
        "compared": int(np.sum(decided)),
        "undecided": int(np.sum(undecided)),
        "grazing": int(np.sum(grazing)),
        "loops_with_undecided": int(np.sum(np.any(undecided, axis=(1, 2)))),
        "forward_against_reverse": float(np.max(disagree)),
        "worst": float(np.max(error)),
        "worst_of": [int(worst[0]), ("x", "x_dot", "theta", "theta_dot")[worst[1]], names[worst[2]]],
        "median": float(np.median(error[decided])),
        "beyond": int(np.sum(error > BOUND)),
        "zero_though_slid": [int(z) for z in zeros],
        "nonfinite": int(np.sum(~np.isfinite(one)) + np.sum(~np.isfinite(other)) + np.sum(~np.isfinite(values))),
        "largest_error_of_undecided": float(np.max(np.where(undecided & ~grazing, np.abs(one - exact) / scale, 0.0))),
        "largest_doubt_of_undecided": float(np.max(np.where(undecided & ~grazing, doubt / scale, 0.0))),
    }


def main(out: Path, quick: bool = False, seed: int = 1, count: int = 200) -> list[dict[str, Any]]:
    """Prints the table and writes friction_derivatives.json."""
    groups = ("feedback, sampled",) if quick else tuple(_GROUPS)
    share = 3 if quick else -(-count // len(groups))
    rows = [compare(group, share, seed + k) for k, group in enumerate(groups)]
    header = (
        *("loops", "number", "flagged", "slide: cart, pole", "stick: cart, pole", "compared", "undecided (graze)"),
        *("forward - reverse", "median error", "worst", f"beyond {BOUND:g}", "zero though slid", "NaN"),
    )
    texts = [
        (
            *(r["group"], str(r["loops"]), str(r["flagged"])),
            *("{}, {}".format(*r["slid"]), "{}, {}".format(*r["stuck"])),
            *(str(r["compared"]), f"{r['undecided']} ({r['grazing']})", f"{r['forward_against_reverse']:.1e}"),
            *(f"{r['median']:.1e}", f"{r['worst']:.1e}", str(r["beyond"]), str(sum(r["zero_though_slid"]))),
            str(r["nonfinite"]),
        )
        for r in rows
    ]
    print_table("Derivatives through dry friction", header, texts, 1)
    files.write_json(out / "friction_derivatives.json", {"versions": files.versions(), "seed": seed, "rows": rows})
    return rows


if __name__ == "__main__":
    run(main, __doc__ or "")
