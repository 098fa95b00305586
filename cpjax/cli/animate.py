"""`cpjax animate`: an animation of one run, or of several side by side."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cpjax import files, io
from cpjax.cli.builders import PLANT_OPTIONS, START_OPTIONS, build_start, controller_title, named_hybrid
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.rigs import (
    BARE,
    FIRMWARE_OPTIONS,
    RIG_OPTIONS,
    Firmware,
    build_firmware,
    build_rig,
    split_period,
    with_usual_period,
)
from cpjax.controllers import Hybrid
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.plant.state import State
from cpjax.rig import Rig, plant_of
from cpjax.show import ANIMATION_FORMATS
from cpjax.sim.rollout import Trajectory, rollout

CONTROLLERS = ("corrected/lqr", "tuned_lqr")
_DT = 0.002  # integration step [s]; it divides _AFTER
_AFTER = 1.0  # simulated beyond the shown time [s]: success must hold that long

OPTIONS = [
    Option(
        "animation",
        "controllers",
        "side by side: tuned_lqr, tuned_place, a file, or a law of the paper with its regulator, such as "
        "as-printed/placement (default " + " ".join(CONTROLLERS) + ")",
        count="+",
    ),
    Option("animation", "format", "(default gif; mp4 needs ffmpeg, and is html without it)", choices=ANIMATION_FORMATS),
    Option("animation", "duration", "shown [s] (default 6)", float),
    Option("animation", "rate", "pictures per second, for a GIF at most 50 (default 20)", float),
    *START_OPTIONS,
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    *FIRMWARE_OPTIONS,
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "Shows controllers swinging the pendulum up from one initial state, in real time: cart, pole, trail, "
        "voltage and mode. Writes animation.gif (.mp4, .html) and animation.json."
    )
    parser = commands.add_parser("animate", help="runs as a moving picture", description=text)
    add_options(parser, OPTIONS, out="out/animate")
    parser.set_defaults(run=run)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    chosen = {"controllers": list(CONTROLLERS), "format": "gif", "duration": 6.0, "rate": 20.0, **sections["animation"]}
    if not 0.0 < chosen["duration"] <= 600.0:
        raise InputError("duration", chosen["duration"], "above 0 and at most 600 s")
    names = chosen["controllers"]
    if len(set(names)) < len(names):
        raise InputError("controllers", names, "each one once")
    controllers = {name: named_hybrid(name, plant) for name in names}
    stated, estimation = split_period({}, sections["firmware"])
    setting = with_usual_period({"dt": _DT, **stated}, stated, sections["plant"])
    firmware = build_firmware(estimation, rig, setting, given.seed)
    notes = [*notes_on(sections["plant"], plant, controllers), *firmware.notes]
    announce("animate", notes)
    start = build_start(sections["start"], given.seed)
    path, runs = run_animation(
        given.out, rig, controllers, start, chosen, firmware=firmware, seed=given.seed, notes=notes
    )
    for name, one in runs.items():
        say(f"{controller_title(name)}: {verdict(one, chosen['duration'])}")
    say(f"wrote {path} and animation.json")
    return 0


def run_animation(
    out: Path,
    rig: Rig | CartPole,
    controllers: Mapping[str, Hybrid],
    start: State,
    chosen: Mapping[str, Any],
    *,
    firmware: Firmware = BARE,
    **others: Any,
) -> tuple[Path, dict[str, Trajectory]]:
    """Simulates the controllers and writes the animation and animation.json.

    Args:
      controllers: by the names that `controller_title` puts into words.
      start: the initial state of all runs.
      chosen: format (gif, mp4 or html), duration [s] and rate [pictures/s].
      firmware: what runs around each controller.
      others: further entries of the JSON.

    Returns:
      The animation's file, and the runs by name.
    """
    plant = plant_of(rig)
    duration = _DT * round(chosen["duration"] / _DT)
    how: dict[str, Any] = {"duration": duration + _AFTER, "dt": _DT, "clock": "sampled", **firmware.simulation}
    runs = {name: rollout(rig, firmware(controller), start, **how) for name, controller in controllers.items()}

    from cpjax.show.animation import Scene, encoder, save_animation

    length = 2.0 * float(plant.pole_length) if float(plant.pole_inertia) > 0.0 else float(plant.pole_length)
    limit = float(plant.motor.voltage_limit)
    scenes = [
        Scene(controller_title(name), _colour(name, controllers[name]), one, length, limit)
        for name, one in runs.items()
    ]
    kind = chosen["format"]
    if kind == "mp4" and encoder() is None:
        kind = "html"
        say("no ffmpeg: writing a page of HTML instead of an MP4")
    path = out / f"animation.{kind}"
    with progress("animate") as report:
        save_animation(path, scenes, duration=duration, rate=chosen["rate"], report=report)
    document = {
        "what": "runs shown by the animation beside this file",
        "versions": files.versions(),
        "start": io.encode(start),
        **io.encode_bench(rig),
        **firmware.entries(),
        "file": path.name,
        "duration": duration,
        "metrics_over": duration + _AFTER,
        "rate": chosen["rate"],
        "runs": {
            name: {
                "controller": io.encode(controllers[name]),
                "success": bool(one.metrics.success),
                "settling_time": float(one.metrics.settling_time),
                "cart_travel": float(one.metrics.cart_travel),
                "effort": float(one.metrics.effort),
                "switches": int(one.metrics.switches),
            }
            for name, one in runs.items()
        },
        **others,
    }
    files.write_json(out / "animation.json", document)
    return path, runs


def verdict(run: Trajectory, duration: float) -> str:
    """Says whether a run, simulated a second longer than shown, settles within the shown `duration` [s]."""
    time = float(run.metrics.settling_time)
    settled = bool(run.metrics.success) and time <= duration
    return f"settles after {time:.2f} s" if settled else f"does not settle in {duration:g} s"


def _colour(name: str, controller: Hybrid) -> str:
    """Returns the colour of the controller's design; of a gain without a design, by the controller's name."""
    from cpjax.show.figures import DESIGN_COLOURS, design_colour

    return DESIGN_COLOURS["placement"] if "/placement" in name else design_colour(controller)
