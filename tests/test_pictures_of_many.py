"""The commands that map, trade off and animate: what they write, and what they refuse."""

import json

import numpy as np
import pytest
from PIL import Image
from tables import rows

import cpjax
from cpjax.show import animation
from cpjax.show.figures import DESIGN_COLOURS
from cpjax.study.recording import read_sweep


def stop(*_, **__):
    raise KeyboardInterrupt


def test_basin_writes_maps_with_the_shares_of_their_runs_after_an_interruption_too(command, tmp_path, monkeypatch):
    odd = str(tmp_path / r"a $\frac$ [bold] <b>.json")  # a formula, a style or a tag, if anything takes it for one
    cpjax.save(odd, cpjax.preset("placement"))
    arguments = ("--cells", 6, "--theta", -1, 1, "--controllers", odd, "corrected/lqr", "--duration", 3)
    arguments = ("basin", *arguments, "--x", -0.1, 0.1, "--out", tmp_path)
    assert command(*arguments, "--dt", "nan").code == 2
    assert not (tmp_path / "basin.parts").exists()  # nothing was saved: it may be asked for anything else
    (tmp_path / "basin.json").write_text("of an earlier map")
    with monkeypatch.context() as patch:
        patch.setattr("cpjax.show.basin.basins", stop)
        assert command(*arguments).code == 130
    assert (tmp_path / "basin.json").read_text() == "of an earlier map"
    refused = command(*arguments, "--seed", 2)
    assert refused.code == 2
    assert "without the parts of other work" in refused.err
    with monkeypatch.context() as patch:
        patch.setattr("cpjax.cli.basin.record_sweep", stop)  # what is done is not done again
        done = command(*arguments)
    assert done.code == 0, done.err
    assert not (tmp_path / "basin.parts").exists()
    document = json.loads((tmp_path / "basin.json").read_text())
    assert document["map"]["others"] == {"x": [-0.1, 0.1]}
    for name, row in document["basins"].items():
        _, columns = read_sweep(tmp_path / document["files"][name])
        assert row["share"] == np.mean(columns["success"])
        assert len(columns["success"]) == 36
        assert f"{100 * row['share']:.2f}" in done.out
    assert document["basins"][odd]["share"] > document["basins"]["corrected/lqr"]["share"]
    assert (tmp_path / "basin.png").read_bytes().startswith(b"\x89PNG")


def test_animate_draws_as_many_pictures_as_it_says_in_each_controllers_colour(command, tmp_path):
    arguments = ("--controllers", "tuned_place", "corrected/lqr", "--duration", 0.4, "--rate", 10)
    assert command("animate", *arguments, "--out", tmp_path).code == 0
    with Image.open(tmp_path / "animation.gif") as picture:
        assert picture.n_frames == 5
        assert picture.info["duration"] == 100
        first = np.asarray(picture.convert("RGB"), int)
    half = first.shape[1] // 2
    for part, design in ((first[:, :half], "placement"), (first[:, half:], "lqr")):
        wanted = [int(DESIGN_COLOURS[design][i : i + 2], 16) for i in (1, 3, 5)]
        assert np.min(np.abs(part - wanted).sum(axis=2)) < 40, design


def test_an_animation_as_a_page_holds_the_runs_and_asks_for_nothing(command, tmp_path):
    assert command("animate", "--format", "html", "--duration", 0.5, "--out", tmp_path).code == 0
    page = (tmp_path / "animation.html").read_text()
    assert "http" not in page
    assert "url(" not in page
    data = json.loads(page.split("const data = ")[1].split(";\n")[0])
    assert [scene["title"] for scene in data["scenes"]] == ["paper, corrected, LQR", "tuned, LQR"]
    plant = cpjax.paper.appendix_plant()
    run = cpjax.rollout(plant, cpjax.preset("lqr"), cpjax.HANGING, duration=0.5, dt=0.002, clock="sampled")
    np.testing.assert_allclose(data["scenes"][1]["theta"], np.asarray(run.state.theta)[::25], atol=1e-4)
    np.testing.assert_allclose(data["scenes"][1]["voltage"], np.asarray(run.voltage)[::25], atol=1e-3)


def test_a_gif_keeps_time_and_has_the_colours_of_what_comes_later(command, tmp_path):
    # As printed, and from rest, the law asks for nothing at first: no green bar in the first picture.
    arguments = ("--controllers", "as-printed/lqr", "tuned_lqr", "--theta", 2.8, "--duration", 1, "--rate", 30)
    assert command("animate", *arguments, "--out", tmp_path).code == 0
    shown, greenest = 0, 999
    with Image.open(tmp_path / "animation.gif") as picture:
        for i in range(picture.n_frames):
            picture.seek(i)
            shown += picture.info["duration"]
            pixels = np.asarray(picture.convert("RGB"), int)
            greenest = min(greenest, np.min(np.abs(pixels - [0, 0x9E, 0x73]).sum(axis=2)))
    assert abs(shown - 1000 * 31 / 30) <= 5
    assert greenest < 40


@pytest.mark.parametrize(
    ("script", "code", "words"),
    [
        ('for last; do :; done; cat > "$last"', 0, "animation.mp4"),
        ("echo no such codec >&2; exit 3", 2, "no such codec"),
    ],
)
def test_a_film_is_what_the_encoder_makes_of_the_pictures_or_what_it_says(
    script, code, words, command, tmp_path, monkeypatch
):
    program = tmp_path / "encoder"
    program.write_text(f"#!/bin/bash\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(animation, "encoder", lambda: str(program))
    done = command("animate", "--format", "mp4", "--duration", 0.2, "--rate", 10, "--out", tmp_path / "film")
    assert done.code == code
    assert words in done.out + done.err
    film = tmp_path / "film" / "animation.mp4"
    assert film.exists() == (code == 0)
    if code == 0:  # the stub writes down what it was given: three pictures
        assert film.stat().st_size % 9 == 0


def test_the_pole_is_drawn_where_the_plants_coordinates_have_its_bob():
    from matplotlib.figure import Figure

    plant = cpjax.paper.appendix_plant()
    run = cpjax.rollout(plant, cpjax.preset("lqr"), cpjax.HANGING, duration=0.1, dt=0.002, clock="sampled")
    axes = Figure().subplots()
    stage = animation._Stage(axes, animation.Scene("", "black", run, 0.7, 12.0), 2.0)
    stage.draw(0.3, 0.5, 0.0, 0, 5)
    assert stage._bob.get_data()[0][0] == pytest.approx(
        0.3 - 0.7 * np.sin(0.5)
    )  # x - l sin(theta), as cpjax.State says
    assert animation._PAGE.count("- L * Math.sin(") == 2


def test_without_an_encoder_a_film_becomes_a_page(command, tmp_path, monkeypatch):
    monkeypatch.setattr(animation, "encoder", lambda: None)
    done = command("animate", "--format", "mp4", "--duration", 0.1, "--out", tmp_path)
    assert done.code == 0
    assert "no ffmpeg" in done.out
    assert (tmp_path / "animation.html").exists()


@rows(
    ("arguments", "named"),
    [
        (("basin", "--theta", "1", "-1"), "error: theta = "),
        (("basin", "--theta-dot", "nan", "1"), "error: theta-dot = "),
        (("animate", "--controllers", "tuned_lqr", "tuned_lqr"), "controllers"),
        (("animate", "--rate", "60"), "rate"),
        (("basin", "--across", "x", "--up", "x"), "up"),
        (("basin", "--cells", "0"), "cells"),
        (("basin", "--controllers", "corrected/nothing"), "controller"),
        (("basin", "--controllers", "tuned_lqr", "tuned_lqr"), "controllers"),
        (("basin", "--dt", "nan"), "dt"),
        (("pareto", "--bounds", "0"), "bounds"),
        (("pareto", "--supplies", "nan"), "supplies"),
        (("pareto", "--supplies", "1e300"), "supplies"),
        (("pareto", "--candidates", "1000000000000"), "candidates"),
        (("basin", "--controllers", "corected/lqr"), "tuned_lqr, tuned_place, a law (as-printed, "),
        (("basin", "--out", "o" * 300), "path = "),
        (("basin", "--controllers", "\udcff.json"), "text in UTF-8"),
        (("animate", "--rate", "0"), "rate"),
        (("animate", "--duration", "nan"), "duration"),
        (("report", "--cells", "-1"), "cells"),
    ],
)
def test_bad_input_is_named_in_one_line(command, tmp_path, arguments, named):
    done = command(arguments[0], "--out", tmp_path, *arguments[1:])
    assert done.code == 2
    assert named in done.err
    assert len(done.err.strip().splitlines()) <= 2  # progress, at most, before


def trace_once(trace, stop):
    """`trace`, that may be called once."""
    calls = []

    def traced(*arguments):
        if calls:
            stop()
        calls.append(arguments)
        return trace(*arguments)

    return traced


@pytest.mark.slow
def test_pareto_keeps_a_finished_design_when_it_is_stopped(command, tmp_path, monkeypatch):
    from cpjax.cli import pareto
    from cpjax.study.fronts.trace import Tracer

    small = ("--bounds", 2, "--candidates", 64, "--steps", 2, "--final", 16, "--supplies", 12, "--out", tmp_path)

    with monkeypatch.context() as patch:
        patch.setattr("cpjax.study.fronts.trace._front", stop)  # after the searches of the first design
        assert command("pareto", *small).code == 130
    parts = tmp_path / "pareto.parts"
    assert sorted(part.name for part in parts.glob("*.npz")) == ["placement-random.npz", "placement-traced.npz"]
    with monkeypatch.context() as patch:
        patch.setattr(pareto, "compare", stop)
        patch.setattr("cpjax.study.fronts.trace.Tracer.trace", trace_once(Tracer.trace, stop))
        assert command("pareto", *small).code == 130
    assert len(list(parts.glob("*-fronts.npz"))) == 2
    other = command("pareto", *small, "--seed", 2)
    assert other.code == 2
    assert "without the parts of other work" in other.err
    with monkeypatch.context() as patch:
        patch.setattr("cpjax.study.fronts.trace.trace_fronts", stop)  # nothing is traced again
        assert command("pareto", *small).code == 0
    assert not parts.exists()
    document = json.loads((tmp_path / "pareto.json").read_text())
    assert {row["cost"] for row in document["fronts"]["lqr"]["rows"]} == {"effort", "cart_travel", "voltage_variation"}
