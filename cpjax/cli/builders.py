"""Options of plants, controllers, initial states and runs, and what is built from their values.

Names, units and ranges of physical parameters come from the fields of the classes themselves.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from cpjax import io, paper
from cpjax.cli.notes import papers_own
from cpjax.cli.options import Option, options_of
from cpjax.controllers import (
    AngleGate,
    AngleRateGate,
    EnergySwingUp,
    Hybrid,
    LqrWeights,
    LyapunovGate,
    PoleFactors,
    StateFeedback,
)
from cpjax.controllers.gates import Gate
from cpjax.controllers.protocol import Controller, as_controller
from cpjax.errors import InputError, MissingError
from cpjax.linear.lqr import lqr
from cpjax.linear.placement import place
from cpjax.plant import CartPole, ForceActuator, LumpedMotor, Motor, linearize, with_parameters
from cpjax.plant.initial_states import START_SETS, sample_starts
from cpjax.plant.state import NAMES, UNITS, State
from cpjax.presets import PRESETS, preset
from cpjax.pytree import rules
from cpjax.rig import Rig
from cpjax.sim.integrators import INTEGRATORS

_LONG_NAME = 48  # characters of a file's name that fit above a picture

_PLANTS = ", ".join(paper.PLANTS)
_GATES: Mapping[str, type[AngleGate | AngleRateGate | LyapunovGate]] = {
    "angle": AngleGate,
    "angle-rate": AngleRateGate,
    "lyapunov": LyapunovGate,
}

_DRIVES = (Motor, LumpedMotor, ForceActuator)


def _drive_options() -> list[Option]:
    """Returns the options of all drives; of several that share a name, the first."""
    found: dict[str, Option] = {}
    for drive in _DRIVES:
        for option in options_of("plant", drive):
            whose = option.help if drive is Motor else f"{option.help}; of a {drive.__name__}"
            found.setdefault(option.key, dataclasses.replace(option, help=whose))
    return list(found.values())


PLANT_OPTIONS = [
    Option("plant", "base", f"{_PLANTS}, or a plant's file; other options change it (default appendix)", flag="plant"),
    *options_of("plant", CartPole),
    *_drive_options(),
]

CONTROLLER_OPTIONS = [
    Option(
        "controller",
        "file",
        "tuned_lqr, tuned_place, a controller saved by cpjax or a result with one, instead of all options below",
        flag="controller",
    ),
    Option("controller", "law", "swing-up law (default corrected-centred)", choices=tuple(paper.LAWS)),
    Option("controller", "design", "regulator (default placement)", choices=("placement", "lqr")),
    Option(
        "controller",
        "gains",
        "the paper's, or computed for the plant (default printed for the paper's plants, and else computed)",
        choices=("printed", "computed"),
    ),
    Option(
        "controller",
        "Q",
        "LQR for the plant: diagonal of the state weight, or all of its 16 numbers, row by row",
        float,
        count=(4, 16),
        flag="q",
    ),
    Option("controller", "R", "and the weight of the voltage (default the paper's 1e-4)", float, flag="r"),
    Option("controller", "poles", "placement for the plant: poles, such as -3 -4 -5+2j -5-2j", count=4, numbers=True),
    Option("controller", "K", "the regulator's gain itself, instead of all these", float, count=4, flag="gain"),
    *options_of("controller", EnergySwingUp),
    Option(
        "controller",
        "gate",
        "where the regulator takes over (default angle); lyapunov: a level set of the LQR of q, r; needs --level",
        choices=tuple(_GATES),
    ),
    *options_of("controller", AngleRateGate),
    *options_of("controller", LyapunovGate, ["level"]),
    Option("controller", "reference_x", "where the cart is to be held (default 0) [m]", float),
]

START_OPTIONS = [
    Option(
        "start",
        "set",
        "draw the initial state from this set with --seed (default rest)",
        choices=START_SETS,
        flag="start",
    ),
    *(Option("start", n, f"start at this {n} [{u}] instead", float) for n, u in zip(NAMES, UNITS, strict=True)),
]

RUN_OPTIONS = [
    Option("run", "duration", "length of the rollout [s] (default 20)", float),
    Option("run", "dt", "integration step [s] (default 0.002)", float),
    Option("run", "clock", "when the law is evaluated (default sampled)", choices=("sampled", "continuous")),
    Option("run", "control_period", "of the sampled clock [s] (default one step)", float),
    Option("run", "switching", "located: inside the steps of the continuous clock", choices=("per_step", "located")),
    Option("run", "integrator", "(default rk4)", choices=tuple(INTEGRATORS)),
]

EVALUATION_OPTIONS = [
    Option("evaluation", "starts", "set of initial states (default hanging)", choices=START_SETS),
    Option("evaluation", "count", "number of initial states (default 4096)", int),
    Option("evaluation", "duration", "length of each rollout [s] (default 20)", float),
    Option("evaluation", "dt", "integration step and control period [s] (default 0.002)", float),
]


def build_plant(given: Mapping[str, Any]) -> CartPole:
    """Builds the base plant with the given parameters changed.

    Args:
      given: the values of the section "plant".

    Raises:
      InputError: a base that is neither one of the paper's nor a file with a CartPole, or a value outside its range.
    """
    changes = dict(given)
    base = changes.pop("base", "appendix")
    if base in paper.PLANTS:
        plant = paper.PLANTS[base]()
    else:
        if Path(base).suffix.lower() not in (".json", ".toml"):
            raise InputError("plant", base, f"{_PLANTS}, or a file that ends in .json or .toml")
        plant = io.load_part(base, "plant", "a CartPole")
        if not isinstance(plant, CartPole):
            hint = ", for --rig" if isinstance(plant, Rig) else ""
            held = f"this one holds a {type(plant).__name__}{hint}"
            raise InputError("plant", base, f"a file that holds a CartPole; {held}")
    return with_parameters(plant, changes)


def build_controller(given: Mapping[str, Any], plant: CartPole) -> Controller:
    """Builds the hybrid controller that the options describe, or loads the one in the file.

    Args:
      given: the values of the section "controller".
      plant: the model of the swing-up law, and the plant for which gains are computed.

    Raises:
      InputError: options that are missing, exclude each other or do not belong to the chosen law or gate, a value
        outside its range, or a gain that cannot be computed.
    """
    changes = dict(given)
    file = changes.pop("file", None)
    if file is not None:
        if changes:
            raise InputError("controller", file, "alone, without " + ", ".join(changes))
        return saved_controller(file)
    name = changes.pop("law", "corrected-centred")
    law: Any = paper.LAWS[name](plant)  # a dataclass, which its protocol does not express
    law_changes = {key: changes.pop(key) for key in list(changes) if key in rules(EnergySwingUp)}
    for key in law_changes:
        if key not in rules(type(law)):
            raise InputError(key, law_changes[key], f"absent: the law {name} has no such term")
    swing_up = dataclasses.replace(law, **law_changes)
    reference = State(changes.pop("reference_x", 0.0), 0.0, 0.0, 0.0)
    weights: dict[str, Any] = {key: changes[key] for key in ("Q", "R") if key in changes}
    regulator = _build_regulator(changes, plant, reference)
    gate = _build_gate(changes, plant, reference, weights)
    return Hybrid(swing_up, regulator, gate)


def saved_controller(name: str, also: str = "") -> Controller:
    """Loads the preset or the file of this name.

    Args:
      name: a preset's, or a file's that ends in .json or .toml.
      also: what else is allowed, in words for the error.

    Raises:
      InputError: another name, or a file without a controller or law.
    """
    for design, known in PRESETS.items():
        if name == known:
            return preset(design)
    if Path(name).suffix.lower() not in (".json", ".toml"):
        presets = ", ".join(PRESETS.values())
        raise InputError("controller", name, f"{presets}, {also}or the name of a file that ends in .json or .toml")
    return saved(name, "controller")


def saved(path: str, field: str) -> Controller:
    """Loads the controller in a file, or in a result that a command wrote.

    Args:
      field: the name of the option, for the error.

    Raises:
      InputError: a file without a controller or law.
    """
    wanted = "a controller or a law"
    loaded = io.load_part(path, "controller", wanted)
    try:
        return as_controller(loaded)
    except InputError as problem:
        allowed = f"a file that holds {wanted}; this one holds a {type(loaded).__name__}"
        raise InputError(field, path, allowed) from problem


def named_controller(name: str, plant: CartPole) -> Controller:
    """Builds a controller from one word: a preset, a file, or the paper's LAW/DESIGN or LAW/DESIGN/GAINS.

    Args:
      plant: the model of the paper's laws, and the plant for which gains are computed.

    Raises:
      InputError: another name, or a file without a controller.
    """
    law, *others = name.split("/")
    if law in paper.LAWS and Path(name).suffix.lower() not in (".json", ".toml"):
        for design, gains in itertools.product(get_args(paper.Design), get_args(paper.Gains)):
            if others in ([design], [design, gains]):
                chosen = gains if len(others) == 2 else default_gains(plant)
                return paper.controller(law, design, plant, chosen)
        raise InputError("controller", name, f"{law}/lqr or {law}/placement, and after it /printed or /computed")
    return saved_controller(name, f"a law ({', '.join(paper.LAWS)}) with its regulator, such as corrected/lqr, ")


def named_hybrid(name: str, plant: CartPole) -> Hybrid:
    """Builds a controller as `named_controller` does, for commands that need a regulator behind a gate.

    Raises:
      InputError: as `named_controller` does, or a controller of another kind.
    """
    controller = named_controller(name, plant)
    if not isinstance(controller, Hybrid):
        raise InputError("controller", name, "a Hybrid: a regulator behind a gate")
    return controller


def controller_title(name: str) -> str:
    """Returns a name that `named_hybrid` takes as words for tables and figures."""
    law, *others = name.split("/")
    if law in paper.LAWS and others:
        from cpjax.show.figures import DESIGN_NAMES  # importing matplotlib is slow; parsing needs none

        rest = (DESIGN_NAMES.get(one, f"{one} gains") for one in others)
        return ", ".join([f"paper, {law.replace('-', ' ')}", *rest])
    known = {
        "tuned_lqr": "tuned, LQR",
        "tuned_place": "tuned, pole placement",
        "tuned_quanser_ip02_long": "tuned for quanser-ip02-long, LQR",
    }
    return known.get(name, name if len(name) <= _LONG_NAME else "..." + name[3 - _LONG_NAME :])


def build_hybrid(given: Mapping[str, Any], plant: CartPole) -> Hybrid:
    """Builds a controller as `build_controller` does, for commands that need a regulator behind a gate.

    Raises:
      InputError: as there, or a file without a Hybrid.
    """
    controller = build_controller(given, plant)
    if not isinstance(controller, Hybrid):
        raise InputError("controller", type(controller).__name__, "a Hybrid: a regulator behind a gate")
    return controller


def _build_regulator(changes: dict[str, Any], plant: CartPole, reference: State) -> StateFeedback:
    given = {key: changes.pop(key) for key in ("K", "design", "gains", "Q", "R", "poles") if key in changes}
    if changes.get("gate") == "lyapunov" and ("K" in given or "poles" in given):
        given = {key: value for key, value in given.items() if key not in ("Q", "R")}  # they are the gate's
    for alone in ("K", "poles"):
        others = [key for key in given if key not in (alone, "design", "gains")]
        if alone in given and others:
            raise InputError(others[0], given[others[0]], f"absent where {'gain' if alone == 'K' else alone} is given")
    if "K" in given:
        if len(given) > 1:
            raise InputError("gain", given["K"], "absent where design or gains is given")
        return StateFeedback(given["K"], reference)
    weights: dict[str, Any] = {key: given[key] for key in ("Q", "R") if key in given}
    if "poles" in given or weights:
        design, inputs = ("placement", "poles") if "poles" in given else ("lqr", "weights")
        if given.get("design", design) != design:
            raise InputError("design", given["design"], f"{design}, where {inputs} are given")
        if given.get("gains", "computed") != "computed":
            raise InputError("gains", given["gains"], f"computed, where {inputs} are given")
        if "poles" in given:
            poles = parse_poles(given["poles"])
            K = _designed("gain", plant, lambda A, B: place(A, B, poles))
            stable = all(pole.real < 0.0 for pole in poles)  # unstable poles are no design that can be tuned
            return StateFeedback(K, reference, PoleFactors.from_poles(poles) if stable else None)
        Q, R = _weights(weights)
        K = _designed("gain", plant, lambda A, B: lqr(A, B, Q, R).K)
        return StateFeedback(K, reference, LqrWeights(Q, R[0][0]))
    gains = given.get("gains") or default_gains(plant)
    try:
        regulator = paper.regulator(given.get("design", "placement"), gains, plant)
    except InputError as problem:
        if "gains" in given:
            raise
        hint = "; or give a gain of your own, or take the paper's with --gains printed"
        raise InputError(problem.field, problem.value, problem.allowed + hint) from problem
    return dataclasses.replace(regulator, reference=reference)


def default_gains(plant: CartPole) -> paper.Gains:
    """Returns "printed" for the paper's own plants, for which those gains are meant, and else "computed"."""
    return "computed" if papers_own(plant) is None else "printed"


def _designed(what: str, plant: CartPole, design: Callable[[Any, Any], Any]) -> Any:
    """Applies `design` to the linear model (A, B); if that is impossible, the error names the plant."""
    try:
        return design(*linearize(plant))
    except (InputError, np.linalg.LinAlgError) as problem:
        if isinstance(problem, InputError) and problem.field not in ("A", "B"):
            raise
        raise InputError("plant", plant, f"one for which this {what} can be computed ({problem})") from problem


def _weights(given: Mapping[str, Any]) -> tuple[np.ndarray[Any, Any], list[list[float]]]:
    numbers = np.asarray(given.get("Q", paper.Q), dtype=float)
    Q = np.diag(numbers) if numbers.size == 4 else numbers.reshape(4, 4)
    if not np.array_equal(Q, Q.T, equal_nan=True):
        raise InputError("Q", given["Q"], "a symmetric matrix")
    return Q, [[float(given.get("R", paper.R))]]


def parse_poles(texts: Sequence[str]) -> list[complex]:
    """Parses poles [1/s] written as -3, -5+2j, or with i for j.

    Raises:
      InputError: one that is no number.
    """
    poles = []
    for text in texts:
        try:
            poles.append(complex(str(text).replace("i", "j").replace(" ", "")))
        except ValueError as problem:
            raise InputError("poles", text, "a number such as -3 or -5+2j") from problem
    return poles


def _build_gate(changes: dict[str, Any], plant: CartPole, reference: State, weights: Mapping[str, Any]) -> Gate:
    name = changes.pop("gate", "angle")
    cls = _GATES[name]
    for key in changes:
        if key not in rules(cls):
            raise InputError(key, changes[key], f"absent: the gate {name} has no such term")
    for key in ("rate", "level"):
        if key in rules(cls) and key not in changes:
            raise MissingError(key, f"the gate {name} needs it")
    if cls is LyapunovGate:
        P = _designed("lyapunov gate", plant, lambda A, B: lqr(A, B, *_weights(weights)).P)
        return LyapunovGate(P, reference=reference, **changes)
    return cls(**{"half_angle": paper.SWITCH_ANGLE, **changes})


def build_start(given: Mapping[str, Any], seed: int) -> State:
    """Builds one initial state: drawn from a set, then the given components changed.

    Args:
      given: the values of the section "start".
    """
    changes = dict(given)
    drawn = sample_starts(changes.pop("set", "rest"), 1, seed=seed)
    return State(**{name: float(changes.get(name, getattr(drawn, name)[0])) for name in NAMES})
