"""Audit of gradients through a swing-up, for a controller, its parameters, initial states and an objective.

Three derivatives are compared with the finite difference of the rollout with located switching: automatic
differentiation of that rollout, of the rollout that reads its mode once per step ("plain"), and of rollouts with smooth
surrogates. All are computed at several horizons, together with the causes of bad gradients: slow crossings of the gate,
and sensitivity that grows with time.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Real

from cpjax import files
from cpjax.controllers import Hybrid, SmoothClip, SmoothHybrid
from cpjax.errors import InputError
from cpjax.numeric.differences import Differences, central_differences
from cpjax.plant import CartPole
from cpjax.plant.state import NAMES, State
from cpjax.pytree import Scalar, is_traced
from cpjax.sim.flags import STOPPED, describe
from cpjax.sim.initial import checked_initial
from cpjax.sim.metrics import Metric, TimeOutside
from cpjax.sim.rollout import measure
from cpjax.sim.settings import Switching, check_settings
from cpjax.study.gradient_probe import HorizonRecorder, Probe
from cpjax.study.named_parameters import Build, as_matrix, as_tree, parameter_scales

Report: TypeAlias = Callable[[int, int, str], None]

SLOW_CROSSING = 0.1
"""Speed of the gate's margin [1/s] below which a crossing counts as grazing."""

LARGE_GROWTH = 1e4
"""Norm of d state / d start above which a run counts as chaotic."""

SMALL_SHARE = 1e-3
"""Errors are relative to the derivative, or to this share of the run's largest derivative, whichever is larger."""

RESOLUTION = 3e-7
"""Largest uncertainty at which a difference counts as resolved, relative to the same size as errors are."""

_STEPS = 1e-3 * 4.0 ** -np.arange(7)

Derivatives: TypeAlias = Float[np.ndarray, "starts horizons parameters"]
"""Derivatives of the objective with respect to relative changes of the parameters."""

Mask: TypeAlias = Bool[np.ndarray, "starts horizons parameters"]
"""Which of the `Derivatives` have a property."""


@dataclasses.dataclass(frozen=True)
class GradientAudit:
    """Result of `audit_gradients`.

    Derivatives are with respect to relative changes: |p| times the derivative in a parameter p, or its scale times the
    derivative if a scale was given.

    Attributes:
      names: of the parameters; "Q[0]" for an element.
      horizons: times at which the objective is read [s].
      temperatures: of the smooth surrogates.
      value: the objective.
      located: derivatives by automatic differentiation, with located switching.
      plain: the same, with switching per step.
      smooth: the same, one array for each temperature.
      difference: finite differences of the rollout with located switching; NaN where no stencil stays on one side of
        every kink.
      uncertainty: estimated error of the differences.
      crossings: number of gate crossings up to each horizon.
      speed: speed of the gate's margin at the slowest of those [1/s]; infinite if there is none.
      growth: spectral norm of d state / d start, in SI units.
      flag: bits of `Flag` of the run with located switching.
    """

    names: tuple[str, ...]
    horizons: Float[np.ndarray, " horizons"]
    temperatures: tuple[float, ...]
    value: Float[np.ndarray, "starts horizons"]
    located: Derivatives
    plain: Derivatives
    smooth: tuple[Derivatives, ...]
    difference: Derivatives
    uncertainty: Derivatives
    crossings: Int[np.ndarray, "starts horizons"]
    speed: Float[np.ndarray, "starts horizons"]
    growth: Float[np.ndarray, "starts horizons"]
    flag: Int[np.ndarray, " starts"]

    def errors(self, gradient: Derivatives) -> Derivatives:
        """Returns |gradient - difference| / |difference|, see `SMALL_SHARE`; NaN where the difference is."""
        size = np.abs(self.difference)
        distance = np.abs(gradient - self.difference)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(distance == 0.0, 0.0 * size, distance / np.maximum(size, SMALL_SHARE * self._largest()))

    def wrong_signs(self, gradient: Derivatives) -> Mask:
        """Returns where the gradient's sign (-1, 0, 1) differs from the difference's, if that is certain."""
        known = np.abs(self.difference) > np.maximum(self.uncertainty, SMALL_SHARE * self._largest())
        return known & (np.sign(gradient) != np.sign(self.difference))

    @property
    def resolved(self) -> Mask:
        """Whether the differences are certain to `RESOLUTION`.

        Next to a kink (a crossing that appears or vanishes with a small step of a parameter) only the smallest stencils
        stay on one side of it, and rounding dominates those.
        """
        with np.errstate(invalid="ignore"):
            size = np.maximum(np.abs(self.difference), SMALL_SHARE * self._largest())
            resolved: Mask = self.uncertainty <= RESOLUTION * size
            return resolved

    def _largest(self) -> Float[np.ndarray, "starts horizons 1"]:
        size = np.abs(self.difference)
        largest: Float[np.ndarray, "starts horizons 1"] = np.max(
            np.where(np.isnan(size), 0.0, size), axis=-1, keepdims=True
        )
        return largest

    @property
    def trusted(self) -> Bool[np.ndarray, " starts"]:
        """Whether the verdict on an initial state is "trustworthy"."""
        return np.array([kind == "trustworthy" for kind, _ in self.verdicts])

    @property
    def compared(self) -> Mask:
        """Which derivatives are compared: of trustworthy initial states, where the difference is resolved."""
        compared: Mask = self.trusted[:, None, None] & self.resolved
        return compared

    @property
    def undecided(self) -> int:
        """Number of derivatives of trustworthy initial states whose difference is not resolved, at the last horizon."""
        return int(np.sum(self.trusted[:, None] & ~self.resolved[:, -1]))

    @property
    def verdicts(self) -> list[tuple[str, str]]:
        """Verdict on each initial state (trustworthy, grazing, chaotic, stopped) and its reason, over all horizons."""
        found = []
        for flag, speed, growth, crossings in zip(
            self.flag, self.speed[:, -1], np.max(self.growth, axis=1), self.crossings[:, -1], strict=True
        ):
            if flag & STOPPED:
                found.append(("stopped", describe(flag)))
            elif not growth <= LARGE_GROWTH:
                found.append(("chaotic", f"a change of the initial state grows {growth:.2g} times"))
            elif speed < SLOW_CROSSING:
                found.append(("grazing", f"crosses the gate at {speed:.2g} / s"))
            else:
                reason = f"slowest of {crossings} crossings {speed:.2g} / s, " if crossings else "no crossing, "
                found.append(("trustworthy", reason + f"growth {growth:.2g}"))
        return found


def audit_gradients(
    build: Build,
    parameters: Mapping[str, Real[ArrayLike, "..."]],
    starts: State,
    *,
    duration: float = 4.0,
    dt: float = 1e-3,
    horizons: Sequence[float] | None = None,
    objective: Metric | None = None,
    scales: Mapping[str, float] | None = None,
    temperatures: Sequence[float] = (0.1, 0.01),
    each: bool = False,
    progress: Report | None = None,
) -> GradientAudit:
    """Compares the gradients of an objective at every initial state.

    Args:
      build: returns the plant and a `cpjax.Hybrid` for the parameters; run designs such as `cpjax.lqr` in it.
      parameters: numbers and vectors by name.
      starts: the initial states, a State of float64 arrays (n,).
      duration: of the rollouts [s].
      dt: their step [s].
      horizons: times at which the objective is read, rising, each a whole number of steps [s]; by default quarters of
        the duration.
      objective: a metric whose result is a number; `TimeOutside()` by default.
      scales: change of a parameter, by name, that counts as a relative change by 1; by default its value.
      temperatures: of the smooth surrogates: of the gate's margin, and of the clip relative to the supply.
      each: whether the parameters have a leading axis n, one set for each initial state.
      progress: called with the number of parts done, their total, and the next one's name.

    Raises:
      InputError: arguments that no rollout takes, initial states that are not float64, or a controller that is not a
        Hybrid.
    """
    starts, dtype, _ = checked_initial(CartPole(), starts, "starts", batched=True)
    check_settings(duration=duration, dt=dt, switching="located")
    if dtype != jnp.float64:
        raise InputError("starts", f"State of {dtype}", "of float64: float32 has too few digits for differences")
    ends = _horizons(horizons, duration, dt)
    for temperature in temperatures:
        if isinstance(temperature, (bool, str)) or not 0.0 < temperature < math.inf:
            raise InputError("temperatures", temperature, "finite numbers above 0")
    n = int(jnp.shape(starts.x)[0])
    names, x, shapes = as_matrix(parameters, n, each)
    scale = parameter_scales(names, x, scales or {})
    metric = HorizonRecorder(
        TimeOutside() if objective is None else objective, jnp.asarray(ends + 0.25 * dt, dtype), jnp.asarray(dt, dtype)
    )

    def made(vector: Float[Array, " parameters"]) -> tuple[CartPole, Hybrid]:
        plant, controller = build(as_tree(vector, shapes))
        if not isinstance(controller, Hybrid):
            raise InputError("build", controller, "one that makes a cpjax.Hybrid")
        return plant, controller

    def probe(
        vector: Float[Array, " parameters"], start: State, switching: Switching, temperature: Scalar | None
    ) -> tuple[Probe, Int[Array, ""]]:
        plant, controller = made(vector)
        law: Any = controller
        if temperature is not None:
            law = SmoothHybrid(controller.swing_up, controller.regulator, controller.gate, temperature)
            limit = plant.motor.voltage_limit
            if is_traced(limit) or np.isfinite(limit):
                law = SmoothClip(law, limit, temperature * limit)
        how: dict[str, Any] = {"duration": duration, "dt": dt, "clock": "continuous", "switching": switching}
        if switching == "per_step":
            how["derivative"] = "pathwise"  # its error is what the audit measures
        found: tuple[Probe, Int[Array, ""]] = measure(plant, law, start, metrics=metric, **how)
        return found

    def jacobians(switching: Switching, arguments: tuple[int, ...]) -> Any:
        def of_all(
            vector: Float[Array, " parameters"], start: Float[Array, "4"], temperature: Scalar | None
        ) -> tuple[Any, Any]:
            found, flag = probe(vector, State.from_vector(start), switching, temperature)
            return (found.value, found.state), (found, flag)

        compiled = jax.jit(jax.vmap(jax.jacfwd(of_all, argnums=arguments, has_aux=True), in_axes=(0, 0, None)))
        return functools.partial(compiled, jnp.asarray(x, dtype), starts.vector())

    parts = 2 + len(temperatures) + len(_STEPS)
    done = 0

    def report(text: str) -> None:
        nonlocal done
        if progress is not None:
            progress(done, parts, text)
        done += 1

    report("located switching")
    (value, state), (found, flag) = jacobians("located", (0, 1))(None)
    located = np.asarray(value[0]) * scale[:, None]
    report("switching per step")
    per_step = jacobians("per_step", (0,))  # one program for all temperatures, and one without
    (rough, _), _ = per_step(None)
    smooth = []
    for temperature in temperatures:
        report(f"smooth, temperature {temperature:g}")
        (slope, _), _ = per_step(float(temperature))
        smooth.append(np.asarray(slope[0]) * scale[:, None])
    difference = _differences(probe, x, starts, scale, found, report)
    report("done")
    return GradientAudit(
        names=names,
        horizons=ends,
        temperatures=tuple(map(float, temperatures)),
        value=np.asarray(found.value),
        located=located,
        plain=np.asarray(rough[0]) * scale[:, None],
        smooth=tuple(smooth),
        difference=difference.derivative,
        uncertainty=difference.uncertainty,
        crossings=np.asarray(found.crossings),
        speed=np.asarray(found.speed),
        growth=np.linalg.norm(np.asarray(state[1]), ord=2, axis=(-2, -1)),
        flag=np.asarray(flag),
    )


def _differences(
    probe: Callable[..., Any],
    x: Float[np.ndarray, "starts parameters"],
    starts: State,
    scale: Float[np.ndarray, "starts parameters"],
    found: Probe,
    report: Callable[[str], None],
) -> Differences:
    """Returns differences of the rollout with located switching, with respect to relative changes."""
    n, d = x.shape
    run = jax.jit(jax.vmap(lambda vector, start: probe(vector, start, "located", None)[0]))
    many = jax.tree.map(lambda column: jnp.repeat(column, 2 * d), starts)
    moves = np.stack([np.eye(d), -np.eye(d)])  # (2, d, d)
    same: dict[float, Mask] = {}

    def ends(step: float) -> tuple[Derivatives, Derivatives]:
        report(f"differences with steps of {step:.0e}")
        points = x[:, None, None] + step * scale[:, None, None] * moves
        there = run(jnp.asarray(points.reshape(n * 2 * d, d), jnp.asarray(starts.x).dtype), many)
        value, path = (np.asarray(part).reshape(n, 2, d, -1) for part in (there.value, there.path))
        same[step] = np.moveaxis(np.all(path == np.asarray(found.path)[:, None, None], axis=1), 1, 2)
        above, below = np.moveaxis(value, 2, 3).swapaxes(0, 1)
        return above, below

    return central_differences(ends, _STEPS, lambda step: same[step])


def _horizons(given: Sequence[float] | None, duration: float, dt: float) -> Float[np.ndarray, " horizons"]:
    steps = round(duration / dt)
    if given is None:
        return dt * np.unique(np.maximum(1, np.round(steps * np.arange(1, 5) / 4.0)))
    try:
        ends = np.asarray(given, dtype=np.float64)
        counts = np.round(ends / dt)
        fits = ends.ndim == 1 and ends.size > 0 and np.all(np.abs(ends / dt - counts) <= 1e-6 * counts)
        if fits and counts[0] >= 1 and counts[-1] <= steps and np.all(np.diff(counts) > 0):
            return ends
    except (TypeError, ValueError):
        pass
    allowed = f"rising times above 0 s, at most the duration, {duration:g} s, each a whole number of steps of {dt:g} s"
    raise InputError("horizons", given, allowed)


def document(audit: GradientAudit, starts: State, **setting: Any) -> dict[str, Any]:
    """Returns the audit as plain values, for JSON, beside the entries of `setting`."""
    columns = {name: np.asarray(getattr(starts, name)) for name in NAMES}
    fields = {f.name: getattr(audit, f.name) for f in dataclasses.fields(audit)}
    verdicts = [{"verdict": kind, "reason": reason} for kind, reason in audit.verdicts]
    return {"versions": files.versions(), **setting, "starts": columns, **fields, "verdicts": verdicts}
