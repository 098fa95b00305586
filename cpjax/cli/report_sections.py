"""The sections of the report, each from a study that another command does too."""

import argparse
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from cpjax import __version__, files, io, paper
from cpjax.cli import basin, pareto, robustness
from cpjax.cli.animate import run_animation, verdict
from cpjax.cli.audit_gradients import run_audit
from cpjax.cli.builders import controller_title, named_hybrid
from cpjax.cli.progress import progress
from cpjax.cli.rigs import build_firmware
from cpjax.cli.tune import run_tuning
from cpjax.controllers import AngleGate
from cpjax.paper.comparison import Compared
from cpjax.paper.gain_identification import audit_gains, write
from cpjax.paper.printed_gains import printed_in_the_paper
from cpjax.paper.reproduction import DESIGNS, EvaluationConfig
from cpjax.plant import CartPole
from cpjax.plant.state import HANGING
from cpjax.presets import preset
from cpjax.rig import Drive, Encoders, Rig
from cpjax.show import comparison as comparison_text
from cpjax.show import design as design_text
from cpjax.show import front as front_text
from cpjax.show import gain_identification as identification_text
from cpjax.show import gradients as gradients_text
from cpjax.show import reproduction as reproduction_text
from cpjax.show.figures import DESIGN_NAMES, save_figure
from cpjax.show.page import Page
from cpjax.study.design_check import check_design, document
from cpjax.study.fronts.config import FrontConfig
from cpjax.study.robustness import RobustnessConfig
from cpjax.tune.baseline import baseline
from cpjax.tune.config import TuningConfig
from cpjax.tune.parameters import free_parameters

QUICK_FRONTS: Mapping[str, Any] = {
    "bounds": 11,
    "candidates": 2048,
    "steps": 40,
    "evaluate_every": 4,
    "reevaluation": 128,
    "final": 256,
}
"""Fields of a `FrontConfig`."""
QUICK_TUNING: Mapping[str, Any] = {"candidates": 1023, "restarts": 4, "batch": 8, "steps": 36}
"""Fields of a `TuningConfig`."""
QUICK_CARD: Mapping[str, Any] = {"values": 5, "starts": 50, "rigs": 200}
"""Fields of a `RobustnessConfig`."""
QUICK_CARDS = ("corrected-centred/placement", "tuned_lqr")
"""Controllers of the quick cards."""
QUICK_AUDIT: Mapping[str, Any] = {"count": 4, "duration": 3.0, "dt": 0.002}
"""Options of `cpjax audit-gradients`."""
AUDIT_STARTS = 16
"""Random initial guesses of each fit of `cpjax audit-gains`."""


def setup(page: Page, setting: EvaluationConfig) -> None:
    """Adds the section on initial states, runs, plants and laws."""
    page.section("Setup")
    page.text(
        f"{setting.count} initial states from the set `{setting.starts}` (seed {setting.seed}), {setting.duration:g} s "
        f"each, RK4 with a step of {1000 * setting.dt:g} ms, the control held over a step, the voltage clipped at 12 "
        "V. A run succeeds if from some moment, at least 1 s before its end, angle and cart stay within 0.05 rad and "
        "0.05 m of upright and centre."
    )
    page.text(
        "`hanging` initial states lie within 0.3 rad, 0.3 rad/s and 0.1 m of hanging at rest in the middle. The "
        "`appendix` plant has the paper's printed parameters; the `identified` one those from which its printed gains "
        "follow. Law `as-printed` has the paper's signs, `corrected` those that its derivation gives, with its gain k "
        "= 0.2, `corrected-as-voltage` takes the wanted acceleration for a voltage, and `corrected-centred` has k = 5 "
        "and holds the cart near the middle."
    )


def results(page: Page, rows: Sequence[Mapping[str, Any]], compared: list[Compared]) -> None:
    """Adds the section with the reproduction's table.

    Args:
      rows: of the reproduction.
      compared: results of `run_comparison`.
    """
    page.section("Results")
    for sentence in (*reproduction_text.findings(rows), comparison_text.findings(compared)[-1]):
        page.text(sentence)
    page.table(reproduction_text.HEADER, [reproduction_text.cells(row) for row in rows], text_columns=4)
    page.note(
        "Settling, travel, effort and variation are over the successful runs, the peak voltage over all. "
        "Every number is in `reproduction.json` beside this page."
    )


def paper_figures(page: Page, given: argparse.Namespace, setting: EvaluationConfig) -> None:
    """Adds the section with the paper's figures, drawn from cpjax's runs."""
    page.section("The paper's Figures 3 to 6, from our runs")
    for name, figure, caption in reproduction_text.pictures(setting):
        page.picture(save_figure(given.out / f"{name}.png", figure), caption)


def designs(page: Page, given: argparse.Namespace) -> None:
    """Adds the section on the paper's two regulators as linear designs, and writes designs.json."""
    plant = paper.appendix_plant()
    gate = AngleGate(paper.SWITCH_ANGLE)
    checks = {
        (design, gains): check_design(plant, paper.regulator(design, gains, plant), gate)
        for design in get_args(paper.Design)
        for gains in get_args(paper.Gains)
    }
    files.write_json(given.out / "designs.json", {" ".join(key): document(check) for key, check in checks.items()})
    page.section("The two regulators as linear designs")
    page.text(
        "On the appendix's plant, linearised about upright, with the loop broken at the motor's voltage. Inside the "
        "certified level set the linear loop needs neither the 12 V clip nor the switch at 30 degrees; the last column "
        "has its widest angle, reached in motion. At rest in the middle, a smaller angle saturates the voltage."
    )
    page.table(
        design_text.COMPARISON, [design_text.compared(*key, check) for key, check in checks.items()], text_columns=2
    )
    page.note("Every number is in `designs.json`; `cpjax design` checks any other regulator.")


def gain_identification(page: Page, given: argparse.Namespace) -> None:
    """Adds the section on plants that explain the printed gains, and writes audit_gains.json and audit_gains.png."""
    plant, prints = paper.appendix_plant(), printed_in_the_paper()
    with progress("audit-gains") as report:
        audit = audit_gains(prints, plant, starts=AUDIT_STARTS, seed=given.seed, progress=report)
    write(given.out / "audit_gains.json", audit, prints, plant, seed=given.seed, starts=AUDIT_STARTS)
    page.section("Where the printed gains come from")
    page.text(
        "The printed gains do not follow from the printed parameters. Which parameters would have to differ, and what "
        "do eight printed numbers say about a plant at all? Residuals are in units of the last printed digit."
    )
    for sentence in identification_text.findings(audit):
        page.text(sentence)
    page.picture(
        save_figure(given.out / "audit_gains.png", identification_text.picture(audit)),
        "Left: the worst residual when one or two parameters may change; a circle marks pairs that explain all eight "
        "gains. Right: how strongly the gains depend on each combination of parameters.",
    )
    page.table(
        identification_text.FIT_HEADER,
        [identification_text.fit_cells(fit, plant) for fit in identification_text.shown_fits(audit)],
        text_columns=2,
    )
    page.note("Every fit is in `audit_gains.json`; `cpjax audit-gains` does the same for any printed gain.")
    known = [identification_text.direction_cells(d) for d in audit.directions if d.sensitivity > 0.0]
    page.table(identification_text.DIRECTION_HEADER, known, text_columns=1)


def gradients(page: Page, given: argparse.Namespace, size: str) -> None:
    """Adds the section on which gradients through the switch can be trusted; `size` is quick or full."""
    plant = paper.appendix_plant()
    audit, picture = run_audit(given.out, plant, preset("lqr"), QUICK_AUDIT if size == "quick" else {}, given.seed)

    page.section("Can the gradients be trusted?")
    page.text(
        "Derivatives of the time outside the target through whole swing-ups of the tuned LQR controller, for every "
        "parameter of plant and controller, computed in three ways and compared with finite differences: with the "
        "moments of switching located, with the mode read once per step, and with smooth surrogates of clip and gate."
    )
    for sentence in gradients_text.findings(audit):
        page.text(sentence)
    page.picture(
        picture,
        "Left and middle: error of derivatives against finite differences, with switches located and read once per "
        "step, by the run's length and its slowest crossing of the gate. Right: growth of a change of the initial "
        "state.",
    )
    page.table(gradients_text.header(audit), gradients_text.cells(audit), text_columns=1)
    page.note(gradients_text.TITLE + ". Every number is in `audit_gradients.json`.")


def tuning(page: Page, given: argparse.Namespace, parts: Path, size: str) -> None:
    """Adds the section on tuning from the baseline, with tune.json, tune.png and tuned.json in a folder per design.

    Args:
      parts: folder of checkpoints.
      size: quick (the first of `DESIGNS`, short) or full (each design).
    """
    plant = paper.appendix_plant()
    page.section("Tuning by gradients")
    page.text(
        "Energy gain, cart terms, gate and Q or poles, moved together by gradients through whole swing-ups: random "
        "controllers to begin with, the best of them tuned side by side, and the one that validates best kept."
    )
    rows = []
    for design in DESIGNS[:1] if size == "quick" else DESIGNS:
        plan = TuningConfig(seed=given.seed, **(QUICK_TUNING if size == "quick" else {}))
        free = free_parameters(baseline(design, plant))
        folder = given.out / f"tune-{design}"
        found, picture = run_tuning(folder, plant, free, plan, parts / f"tune-{design}.npz")
        page.picture(
            picture,
            f"{DESIGN_NAMES[design]}: settling time and share of initial states of each restart (grey), and of the one "
            "that is best by then, over the steps of the optimiser. Success counts before time.",
        )
        rows.append(
            [
                DESIGN_NAMES[design],
                f"{100 * found.success_rate:.2f}",
                f"{found.settling_time:.3f}",
                f"{found.value_steps / 1e6:.0f}",
                f"{found.gradient_steps / 1e6:.2f}",
                f"{found.seconds:.0f}",
            ]
        )
    page.table(
        ["regulator", "success [%]", "settling [s]", "million steps of values", "of gradients", "time [s]"], rows, 1
    )
    page.note(
        "Every number is in `tune.json` in the design's folder (`tune-placement`), the controller beside it in "
        "`tuned.json`. Compared below are the tuned controllers that come with cpjax, from a longer search."
    )


def comparison(page: Page, results: list[Compared], start: str, pictures: Mapping[str, bytes]) -> None:
    """Adds the section on the paper's and the tuned controllers, from the results of `run_comparison`."""
    page.section("Against tuned gains")
    page.text(
        "Energy gain, cart terms, gate and Q or poles, tuned together by gradients through whole swing-ups (`cpjax "
        "tune`), from the same initial states as above, of which the tuning has seen none. Which of the two methods is "
        "better at 12 V?"
    )
    for sentence in comparison_text.findings(results):
        page.text(sentence)
    page.table(comparison_text.HEADER, [comparison_text.cells(one) for one in results], text_columns=3)
    page.note("Means over the successful runs. Every number is in `compare.json` beside this page.")
    page.picture(
        pictures["responses"],
        "Angle, cart and voltage under the best of the paper's controllers and the tuned ones, from initial state "
        f"{start}.",
    )
    page.picture(
        pictures["phase"],
        "The same runs over angle and rate: a swing-up succeeds where it brings the pendulum to the energy of upright "
        "(dashed) and into the gate (orange), where the regulator takes over (thick).",
    )
    page.picture(
        pictures["by_start"],
        "Settling time by the angle and rate of the initial state, the paper's best above and tuned below; crosses "
        "fail.",
    )


def animation(page: Page, given: argparse.Namespace) -> None:
    """Adds an animation of the paper's controller and the tuned one."""
    plant = paper.appendix_plant()
    controllers = {name: named_hybrid(name, plant) for name in ("corrected/lqr", "tuned_lqr")}
    path, runs = run_animation(
        given.out, plant, controllers, HANGING, {"format": "gif", "duration": 6.0, "rate": 20.0}, seed=given.seed
    )
    page.picture(
        path.read_bytes(),
        "Six seconds from rest, in real time: "
        + "; ".join(f"{controller_title(name)}, {verdict(run, 6.0)}" for name, run in runs.items())
        + ".",
        kind="gif",
    )


def basins(page: Page, given: argparse.Namespace, parts: Path, cells: int) -> None:
    """Adds the section on the basins of attraction of the paper's and the tuned controllers.

    Args:
      parts: folder in which finished maps are saved.
      cells: along each axis.
    """
    plant = paper.appendix_plant()
    controllers = {name: named_hybrid(name, plant) for name in basin.CONTROLLERS}
    chart = basin.chart_of({"cells": cells}, given.seed)
    maps, picture = basin.run_basin(
        given.out, parts / "basin", plant, controllers, chart, {"duration": 10.0, "dt": 0.002}
    )
    _, header, rows = basin.table(maps)
    page.section("Basins of attraction")
    page.text(
        "One run of 10 s from every cell of a map of angle and rate, the cart at rest in the middle. This is the whole "
        "hybrid loop with its clip, sampled, not certified: an initial state between two that succeed may fail."
    )
    page.picture(
        picture,
        "Settling time (above) and changes of mode (below) by the initial state, grey where a run does not settle. "
        "Orange: the gate; dashed: the regulator demands the voltage limit; pink: certified for the linear model.",
    )
    page.table(header, rows, text_columns=1)
    page.note("Every number is in `basin.json`, every run in the files that it names; `cpjax basin` draws others.")


def fronts(page: Page, given: argparse.Namespace, parts: Path, size: str) -> None:
    """Adds the section on trade-off fronts of settling time against cost.

    Args:
      parts: folder in which finished searches are saved.
      size: quick (few steps, the plant's own supply) or full.
    """
    plan = FrontConfig(seed=given.seed, **(QUICK_FRONTS if size == "quick" else {}))
    found, pictures = pareto.run_pareto(
        given.out, parts / "pareto", paper.appendix_plant(), plan, () if size == "quick" else pareto.SUPPLIES
    )
    page.section("Settling time against cost")
    if size == "quick":
        page.text(
            f"A quick version, far from converged: {plan.bounds + 1} tunings for each cost, {plan.steps} steps, points "
            f"measured from {plan.final} initial states. `cpjax pareto`, or `make report-full`, does it in full."
        )
    page.text(
        "LQR or pole placement, and what does settling faster cost? Each point is a controller that settles from "
        f"{100 * plan.success:g} % of unseen initial states at least, and that no other found beats in both. Traced by "
        "gradients, many tunings side by side under one `vmap`, each with a bound on its cost; a random search of as "
        "many steps is drawn beside them. The hypervolume of a front is the area that it dominates, up to 1.1 times "
        "the baseline: the untuned gains, chosen by rules of thumb, that every search begins with."
    )
    page.picture(
        pictures["pareto"],
        "Mean cost against mean settling time, lower left is better. Filled: traced by gradients; crosses: random "
        "search with as much work; stars: the baselines; hollow: the paper's controllers and the shipped ones.",
    )
    if size == "full":
        page.picture(pictures["supplies"], "Settling time against effort, one panel for each supply.")
    for sentence in front_text.findings(pareto.curves_of(found)):
        page.text(sentence)
    _, header, rows = pareto.table(found)
    page.table(header, rows, text_columns=2)
    for sentence in pareto.costs(found):
        page.note(sentence)
    page.note("Every point and its parameters are in `pareto.json`; `cpjax pareto` traces them with more effort.")


def bench(page: Page, given: argparse.Namespace, size: str) -> None:
    """Adds the section on the paper's and the tuned controllers on a bench, and writes bench.toml.

    Args:
      size: quick (coarse grids, two controllers) or full.
    """
    rig = a_bench(paper.appendix_plant())
    io.save(given.out / "bench.toml", rig)
    quick = size == "quick"
    names = QUICK_CARDS if quick else robustness.DEFAULT
    settings = RobustnessConfig(seed=given.seed, **(QUICK_CARD if quick else {}))
    firmware = build_firmware({}, rig, {"dt": settings.dt, "control_period": settings.control_period}, given.seed)
    controllers = {name: named_hybrid(name, rig.plant) for name in names}
    cards, picture = robustness.run_robustness(given.out, rig, controllers, settings, firmware.notes, firmware)
    page.section("On a bench")
    page.text(
        "So far the plant was measured exactly and obeyed at once. Here it has encoders of 4,096 counts a turn, a "
        "Kalman filter in place of measured rates, a delay of one control period, a lag of 2 ms, a dead band of 0.2 V, "
        "which the firmware makes up for, and dry friction of 0.3 N. The rig is then varied, one thing at a time, and "
        "all parameters of the plant at once."
    )
    if quick:
        page.text(
            f"A coarse version: {settings.values} values in each grid, {settings.starts} initial states each. "
            "`cpjax robustness`, or `make report-full`, does it in full."
        )
    page.picture(
        picture,
        "Success rate against what is wrong, with 95 % intervals; upper left: thick lines are means over the plant's "
        "parameters, thin lines one parameter each.",
    )
    _, header, rows = robustness.table(cards)
    page.table(header, rows, text_columns=1)
    page.note(
        "Means over each grid, plus or minus half of the 95 % interval. Every number is in `robustness.json`, the rig "
        "in `bench.toml`: `cpjax robustness --rig bench.toml`."
    )


def a_bench(plant: CartPole) -> Rig:
    """Returns the paper's plant on a bench: numbers of a usual rig, for the paper states none."""
    return Rig(
        dataclasses.replace(plant, coulomb_friction=0.3),
        sensors=Encoders(x_step=1e-4, theta_step=math.tau / 4096),
        drive=Drive(delay=0.002, dead_band=0.2, lag=0.002),
    )


def how_to_reproduce(page: Page, setting: EvaluationConfig, cells: int, studies: str) -> None:
    """Adds the section with the command that makes this page."""
    page.section("How to reproduce this page")
    page.text(
        f"`cpjax report --starts {setting.starts} --count {setting.count} --seed {setting.seed} "
        f"--duration {_shortest(setting.duration)} --dt {_shortest(setting.dt)} --cells {cells} "
        f"--studies {studies}` with cpjax {__version__}."
    )


def _shortest(seconds: float) -> str:
    """Returns the number in six digits if they are exact, else in all of its digits."""
    return f"{seconds:g}" if float(f"{seconds:g}") == seconds else repr(seconds)
