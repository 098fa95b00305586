"""Shapes and dtypes in annotations, held against the code by a type checker at run time.

The checks run in another process, which executes this file: the checker must be there before cpjax is imported.
Annotations are checked while JAX traces, so nothing is compiled: what `jax.jit` would compute is replaced by ones.
"""

import dataclasses
import functools
import json
import subprocess
import sys
import tempfile
import traceback
import typing
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

PAPER = ("printed", "plant_fit", "gain_identification", "reproduction", "comparison", "initial")
PACKAGES = ("cpjax.sim", "cpjax.tune", "cpjax.study", "cpjax.bridges", *(f"cpjax.paper.{name}" for name in PAPER))
"""All but `printed_gains`, whose dataclass holds Python's numbers until JAX makes it again, of tracers."""

RUN = {"duration": 0.04, "dt": 0.02}


def checker(function):
    """The type checker, for which a whole number is a real number too, as for mypy."""
    from beartype import BeartypeConf, beartype

    return beartype(function, conf=BeartypeConf(is_pep484_tower=True))


def check_annotations():
    """From here on the packages' functions, dataclasses and named tuples refuse what their annotations exclude."""
    import jaxtyping

    jaxtyping.install_import_hook(PACKAGES, "__main__.checker")
    jit = jax.jit

    def traced(function, **options):
        compiled = jit(function, **options)
        if not function.__module__.startswith(PACKAGES):
            return compiled

        def call(*args, **more):
            if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((args, more))):
                return compiled(*args, **more)
            return jax.tree.map(lambda one: jnp.ones(one.shape, one.dtype), compiled.eval_shape(*args, **more))

        return call

    jax.jit = traced
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")


def check_named_tuples():
    """The hook sees dataclasses alone. A named tuple that JAX makes, of anything, is not checked."""
    for name in [name for name in sys.modules if name.startswith(PACKAGES)]:
        for cls in vars(sys.modules[name]).values():
            if isinstance(cls, type) and issubclass(cls, tuple) and cls.__module__ == name:

                def new(cls, *args, plain=cls.__new__, **more):
                    made = plain(cls, *args, **more)
                    return fitting(made) if sys._getframe(1).f_globals["__name__"].startswith(PACKAGES) else made

                cls.__new__ = new


hints_of = functools.cache(typing.get_type_hints)


def fitting(result):
    """Returns a result after comparing its fields with their annotations, in which one name is one length."""
    from beartype.door import die_if_unbearable
    from jaxtyping import jaxtyped

    names = result._fields if isinstance(result, tuple) else [f.name for f in dataclasses.fields(result)]
    with jaxtyped("context"):
        for name in names:
            die_if_unbearable(getattr(result, name), hints_of(type(result))[name])
    return result


def under_trace(function, *args):
    """Traces `function`, whose results are the arrays that annotations name only inside it."""
    return jax.eval_shape(function, *jax.tree.map(jnp.asarray, args))


def of_a_rollout():
    from extensions import pid, walled

    import cpjax

    plant, law, start = cpjax.CartPole(), cpjax.preset("lqr"), cpjax.State(0.1, 0.0, 3.0, 0.1)
    clocks = (
        {"save_every": 2},
        {"clock": "continuous"},
        {"switching": "located"},
        {"derivative": "mean", "control_period": 0.04},
    )
    for how in clocks:
        fitting(fitting(cpjax.rollout(plant, law, start, **RUN, **how)).metrics)
    fitting(cpjax.rollout(walled.Walled(plant, 0.2, 0.5), pid.example()[0], start, **RUN))

    def many(starts):
        found = jax.vmap(lambda start: cpjax.rollout(plant, law, start, **RUN))(starts)
        assert fitting(found).time.shape == (3, 3)
        assert fitting(found.metrics).success.shape == (3,)
        return found.cart_acceleration

    assert under_trace(many, cpjax.sample_starts("hanging", 3, seed=1)).shape == (3, 3)


def of_a_sweep():
    import cpjax
    from cpjax.study.basin import Axis, StartGrid, area
    from cpjax.study.basin import document as basin
    from cpjax.study.summary import summarise

    plant, law, starts = cpjax.CartPole(), cpjax.preset("placement"), cpjax.sample_starts("hanging", 3, seed=1)
    found = fitting(cpjax.sweep(plant, law, starts, save_every=1, **RUN))
    assert found.voltage.shape == (3, 3)
    assert fitting(found.metrics).success.shape == (3,)
    assert summarise(found.metrics)["count"] == 3
    under_trace(lambda starts: fitting(cpjax.sweep(plant, law, starts, **RUN)), starts)
    chart = StartGrid(Axis("x", -1.0, 1.0, 2), Axis("theta", -1.0, 1.0, 3))
    metrics = fitting(cpjax.sweep(plant, law, chart.starts(), **RUN))
    assert chart.across.edges().shape == (3,)
    assert area(chart, np.asarray(metrics.success)).share == basin(chart, metrics)["share"]


def of_gradients():
    import cpjax

    def objective(gain, start):
        controller = cpjax.StateFeedback(gain)
        metric = cpjax.TimeOutside()
        return cpjax.measure(cpjax.CartPole(), controller, start, metrics=metric, derivative="pathwise", **RUN)

    gain, starts = jnp.ones((1, 4)), cpjax.sample_starts("anywhere", 3, seed=1)
    for direction in ("reverse", "forward"):
        found = fitting(cpjax.gradients(objective, gain, starts, direction=direction))
        assert found.finite.shape == (3,)


def of_a_tuning():
    import optax

    import cpjax
    from cpjax import files
    from cpjax.tune.checkpoint import restore
    from cpjax.tune.config import TuningConfig
    from cpjax.tune.objective import WEIGHTS, Goal
    from cpjax.tune.outcome import request
    from cpjax.tune.parameters import free_parameters
    from cpjax.tune.tuner import tune

    plant, weights = cpjax.CartPole(), dict.fromkeys(WEIGHTS, 1.0)
    small = dict.fromkeys(("candidates", "screening", "restarts", "batch", "steps", "validation", "final"), 2)
    short = dict.fromkeys(("duration", "dt", "horizon", "horizon_dt", "final_horizon", "final_dt"), 0.02)
    plan = TuningConfig(**small, **short, validate_every=1, goal=Goal(**weights, track_limit=1.0), plant_spread=0.1)
    free, path = free_parameters(cpjax.preset("placement")), Path("checkpoint.npz")
    found = fitting(tune(plant, free, plan, checkpoint=path))
    assert len(found.labels) == found.vector.size == found.physical.size
    fitting(restore(path, files.dump_json(request(plant, free, plan)), optax.adam(lambda step: 0.1)))


def of_free_parameters():
    import cpjax
    from cpjax.tune import objective
    from cpjax.tune.parameters import free_parameters
    from cpjax.tune.plants import sample_plants
    from cpjax.tune.tuner import fastest_pole_bound

    for full_q in (False, True):
        free = free_parameters(cpjax.preset("lqr"), full_q=full_q)
        under_trace(free.build, free.start())
        assert free.physical(free.start()).shape == free.start().shape
        assert free.draw(np.random.default_rng(1), 3).shape == (3, free.start().size)
    for aggregate in (objective.tail_mean(0.5), objective.soft_maximum(1.0), objective.success_weighted(1.0, 1.0)):
        under_trace(aggregate, jnp.ones(4))
    under_trace(fastest_pole_bound, jnp.eye(4))
    assert sample_plants(cpjax.CartPole(), 3, spread=0.1, seed=1).cart_mass.shape == (3,)


def of_a_design():
    import cpjax
    from cpjax.controllers import AngleGate
    from cpjax.study.design_check import check_design

    fitting(check_design(cpjax.CartPole(), cpjax.preset("placement").regulator, AngleGate(0.5)))


def of_an_audit():
    import cpjax
    from cpjax.study.gradient_audit import audit_gradients
    from cpjax.study.named_parameters import parametrise

    plant, law = cpjax.CartPole(), cpjax.preset("placement")
    build, parameters, scales = fitting(parametrise(plant, law))
    starts = cpjax.sample_starts("hanging", 2, seed=1)
    audit = audit_gradients(build, parameters, starts, scales=scales, temperatures=(0.1,), **RUN)
    assert fitting(audit).compared.shape == audit.errors(audit.plain).shape == audit.wrong_signs(audit.plain).shape


def of_fronts():
    import cpjax
    from cpjax.study.fronts.config import FrontConfig
    from cpjax.study.fronts.reference_point import objectives
    from cpjax.study.fronts.trace import trace_fronts

    counts = dict.fromkeys(
        ("candidates", "screening", "evaluation", "reevaluation", "final", "bounds", "batch", "steps"), 2
    )
    short = dict.fromkeys(("duration", "dt", "horizon", "evaluation_dt", "final_dt"), 0.02)
    plan = FrontConfig(**counts, **short, evaluate_every=1)
    plant = cpjax.CartPole()
    reference = {lane: np.ones(2) for lane in objectives(plant)}
    found = trace_fronts(plant, "placement", plan, reference, report=lambda *_: None)
    for front in (*found.traced.values(), *found.random.values()):
        fitting(front)


def of_the_paper():
    import cpjax.paper
    from cpjax.paper.gain_identification import audit_gains
    from cpjax.paper.printed_gains import printed_in_the_paper
    from cpjax.paper.reproduction import EvaluationConfig, evaluate, trajectory, variants

    plant, setting = cpjax.paper.appendix_plant(), EvaluationConfig(count=3, duration=0.04, dt=0.02)
    for design in ("lqr", "placement"):
        under_trace(lambda mass, d=design: cpjax.paper.computed_gain(d, cpjax.CartPole(cart_mass=mass)), 1.0)
    under_trace(lambda mass: cpjax.paper.riccati_solution(cpjax.CartPole(cart_mass=mass)), 1.0)
    assert fitting(evaluate(variants()[0], setting)).success.shape == (3,)
    fitting(trajectory("corrected", "lqr", "identified", cpjax.HANGING, setting))
    found = audit_gains(printed_in_the_paper(), plant, parameters=("cart_mass", "resistance"), most=2, starts=2)
    assert len(fitting(found).fits) == 3


def of_the_bridge_to_python_control():
    import control

    import cpjax
    from cpjax.bridges import python_control

    plant, law = cpjax.CartPole(), cpjax.preset("lqr")
    python_control.state_space(plant)
    gain = python_control.gain_array(python_control.state_feedback([[1.0, 2.0, 3.0, 4.0]] * np.ones((1, 1))))
    assert python_control.state_feedback(python_control.feedback_system(cpjax.StateFeedback(gain))).K.shape == (1, 4)
    plain = python_control.plant_system(plant)
    assert plain.dynamics(0.0, np.ones(4), np.ones(1)).shape == plain.output(0.0, np.ones(4), np.ones(1)).shape
    for period in (None, 0.02):
        loop = python_control.closed_loop_system(plant, law, period)
        assert loop.dynamics(0.0, np.ones(loop.nstates), np.zeros(0)).shape == (loop.nstates,)
        assert loop.output(0.0, np.ones(loop.nstates), np.zeros(0)).shape == (6,)
    assert isinstance(plain, control.NonlinearIOSystem)


def of_values_that_do_not_fit():
    """What the checks above would not notice, if the checker were not there."""
    from beartype.roar import BeartypeDoorHintViolation
    from jaxtyping import TypeCheckError

    import cpjax
    from cpjax.sim.flags import nonfinite_input
    from cpjax.sim.gradients import Gradients
    from cpjax.tune.descent import clip_factors

    zeros = jnp.zeros(3)
    metrics = cpjax.Metrics(zeros > 0.0, *[zeros] * 6, *[jnp.zeros(3, jnp.int32)] * 2)
    wrong = {
        "a batch for one number": lambda: nonfinite_input(zeros),
        "an integer for a real number": lambda: nonfinite_input(jnp.asarray(1)),
        "two lengths of one axis": lambda: clip_factors(jnp.ones((2, 4)), zeros > 0.0, 1.0),
        "two lengths in the fields of one result": lambda: dataclasses.replace(metrics, flag=jnp.zeros(2, jnp.int32)),
        "an integer in a named tuple": lambda: fitting(Gradients(jnp.zeros(3, jnp.int32), None)),
    }

    def accepted(call):
        try:
            call()
        except (TypeCheckError, BeartypeDoorHintViolation):
            return False
        return True

    assert [what for what, call in wrong.items() if accepted(call)] == []


CHECKS = {name for name in globals() if name.startswith("of_")}
SLOW = {"of_a_design", "of_a_rollout", "of_a_tuning", "of_an_audit", "of_fronts", "of_values_that_do_not_fit"}


def problems_of(checks):
    """Returns the traceback of each of the checks that failed, by name."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, *checks]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_every_value_has_the_shape_and_dtype_of_its_annotation():
    assert problems_of(sorted(CHECKS - SLOW)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("check", sorted(SLOW))
def test_so_has_every_value_that_takes_longer_to_compute(check):
    assert problems_of([check]) == {}


def run_checks(names):
    problems = {}
    for name in names:
        try:
            globals()[name]()
        except Exception:
            problems[name] = traceback.format_exc()
    return problems


if __name__ == "__main__":
    check_annotations()
    import cpjax.paper.reproduction
    import cpjax.study.fronts.trace
    import cpjax.study.gradient_audit  # noqa: F401  # with all that they import

    check_named_tuples()
    print(json.dumps(run_checks(sys.argv[1:])))
