"""`cpjax robustness`: the robustness cards of controllers on one rig, as a table, a picture and JSON."""

import argparse
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpjax import files, io
from cpjax.cli.builders import PLANT_OPTIONS, controller_title, named_controller
from cpjax.cli.notes import announce, notes_on
from cpjax.cli.options import Option, add_options, options_of, resolve
from cpjax.cli.output import say
from cpjax.cli.progress import progress
from cpjax.cli.rigs import (
    BARE,
    FIRMWARE_OPTIONS,
    RIG_OPTIONS,
    TRACK_OPTION,
    Firmware,
    build_firmware,
    build_rig,
    with_usual_period,
)
from cpjax.cli.tables import print_table
from cpjax.controllers import Digital
from cpjax.controllers.protocol import Controller
from cpjax.errors import InputError
from cpjax.plant import CartPole
from cpjax.presets import PRESETS
from cpjax.rig import Rig, plant_of
from cpjax.study.robustness import (
    RobustnessCard,
    RobustnessConfig,
    document,
    duration_of,
    robustness_card,
    target_bands,
)

_LAWS = ("corrected-centred/lqr", "corrected-centred/placement")
_TUNED = (PRESETS["lqr"], PRESETS["placement"])
DEFAULT = (*_LAWS, *_TUNED)
"""Controllers that are compared on a rig without a tuned controller of its own."""
_PICTURE, _JSON = "robustness.png", "robustness.json"

OPTIONS = [
    Option(
        "card",
        "controllers",
        "one card each: tuned_lqr, tuned_place, a file, or a law of the paper with its regulator, such as "
        f"corrected/lqr/computed (default {' '.join(_LAWS)} and {' '.join(_TUNED)}, or on a public rig with a tuned "
        "controller of its own that one)",
        count="+",
    ),
    *(
        option
        for option in options_of("card", RobustnessConfig, defaults=True)
        if option.key not in ("seed", "control_period")
    ),
    *PLANT_OPTIONS,
    *RIG_OPTIONS,
    TRACK_OPTION,
    *FIRMWARE_OPTIONS,
]


def add_command(commands: Any) -> None:
    """Declares the command."""
    text = (
        "How far a rig may differ from the one that a controller was made for: success rates over grids of wrong "
        "parameters, noise, lag, delay and pushes, and with all parameters wrong at once. Controllers are compared on "
        f"one rig, never across rigs. Writes {_PICTURE} and {_JSON}."
    )
    parser = commands.add_parser("robustness", help="what a controller bears, on one rig", description=text)
    add_options(parser, OPTIONS, out="out/robustness")
    parser.set_defaults(run=run, many_starts=True)


def run(given: argparse.Namespace) -> int:
    """Runs the command."""
    sections = resolve(given, OPTIONS)
    rig = build_rig(sections["plant"])
    plant = plant_of(rig)
    chosen = dict(sections["card"])
    own = PRESETS.get(sections["plant"].get("rig", ""))
    names = chosen.pop("controllers", list(DEFAULT) if own is None else [*_LAWS, own])
    if len(set(names)) < len(names):
        raise InputError("controllers", names, "each one once")
    controllers = {name: named_controller(name, plant) for name in names}
    estimation = dict(sections["firmware"])
    stated = {key: chosen[key] for key in ("dt",) if key in chosen}
    if "control_period" in estimation:
        stated["control_period"] = estimation.pop("control_period")
    timing = with_usual_period({"dt": 0.002, **stated}, stated, sections["plant"])
    bare = [one for one in controllers.values() if not isinstance(one, Digital)]
    firmware = build_firmware(estimation, rig, timing, given.seed, (bare or [*controllers.values()])[0])
    period = timing.get("control_period", timing["dt"])
    settings = RobustnessConfig(seed=given.seed, control_period=period, **{**chosen, "dt": timing["dt"]})
    notes = [*notes_on(sections["plant"], plant, controllers), *firmware.notes]
    announce("robustness", notes)
    begin = time.perf_counter()
    cards, _ = run_robustness(given.out, rig, controllers, settings, notes, firmware)
    seconds = time.perf_counter() - begin
    print_table(*table(cards), text_columns=1)
    bench = rig if isinstance(rig, Rig) else Rig(rig)
    angle, position = target_bands(bench)
    runs = sum(card.runs for card in cards.values())
    say(
        f"Settled: within {angle:g} rad and {position:g} m, at least 1 s before the end of "
        f"{duration_of(bench, settings.dt):g} s. {runs:,} runs in {seconds:.1f} s, compilation and files included.",
        f"wrote {given.out / _JSON} and {given.out / _PICTURE}",
    )
    return 0


def run_robustness(
    out: Path,
    rig: Rig | CartPole,
    controllers: Mapping[str, Controller],
    settings: RobustnessConfig,
    notes: Sequence[str] = (),
    firmware: Firmware = BARE,
) -> tuple[dict[str, RobustnessCard], bytes]:
    """Computes the cards and writes JSON and picture; the JSON after each controller.

    Args:
      out: the folder.
      rig: the rig, or a plant alone.
      controllers: by name.
      settings: the grids.
      notes: for the JSON.
      firmware: what runs around each controller.

    Returns:
      The cards by the controllers' titles, and the picture.
    """
    cards: dict[str, RobustnessCard] = {}
    described: dict[str, Any] = {}
    with progress("robustness") as report:
        for name, controller in controllers.items():
            title = controller_title(name)

            def tell(grid: str, done: int, total: int, title: str = title) -> None:
                report(done, total, f"{title}: {grid}")

            cards[title] = robustness_card(rig, firmware(controller), settings, progress=tell)
            described[name] = {"title": title, "controller": io.encode(controller), **document(cards[title])}
            whole = {
                "what": "robustness cards",
                "versions": files.versions(),
                "settings": {key: getattr(settings, key) for key in settings.__dataclass_fields__},
                **io.encode_bench(rig),
                **firmware.entries(),
                "notes": list(notes),
                "complete": len(described) == len(controllers),
                "cards": described,
            }
            files.write_json(out / _JSON, whole)

    from cpjax.show.figures import save_figure
    from cpjax.show.robustness import robustness_figure

    return cards, save_figure(out / _PICTURE, robustness_figure(cards))


def table(cards: Mapping[str, RobustnessCard]) -> tuple[str, list[str], list[list[str]]]:
    """Returns title, header and rows of the printed table."""
    title = "Success rates [%]: means over the grid of each criterion; plus or minus half of the 95 % interval"

    def shown(rate: float, interval: Sequence[float]) -> str:
        return f"{100 * rate:.1f} ± {50 * (interval[1] - interval[0]):.1f}"

    first = next(iter(cards.values()))
    header = ["controller", "as it is", *(one.title for one in first.criteria), "all parameters wrong"]
    rows = [
        [
            name,
            shown(card.nominal.rates[0], card.nominal.intervals[0]),
            *(shown(one.score, one.interval) for one in card.criteria),
            shown(card.together.rates[0], card.together.intervals[0]),
        ]
        for name, card in cards.items()
    ]
    return title, header, rows
