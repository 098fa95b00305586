"""The commands that map, trade off and animate: what they write, and what they refuse."""

import base64
import io
import json
import re

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from tables import rows

import cpjax
from cpjax.show import animation
from cpjax.show.figures import DESIGN_COLOURS
from cpjax.study.recording import read_sweep


def stop(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def run():
    """0.5 s of a swing-up from hanging."""
    plant = cpjax.paper.appendix_plant()
    return cpjax.rollout(plant, cpjax.preset("lqr"), cpjax.HANGING, duration=0.5, dt=0.002, clock="sampled")


@pytest.mark.slow
def test_an_animation_as_a_page_holds_its_pictures_and_asks_for_nothing(command, tmp_path):
    assert command("animate", "--format", "html", "--duration", 0.5, "--out", tmp_path).code == 0
    page = (tmp_path / "animation.html").read_text()
    assert "http" not in page
    assert "url(" not in page
    assert "<link" not in page
    assert "<title>paper, corrected, LQR | tuned, LQR</title>" in page
    sources = re.findall(r'frames\[(\d+)\] = "data:image/png;base64,([^"]+)"', page)
    assert [int(number) for number, _ in sources] == list(range(11))
    pictures = [Image.open(io.BytesIO(base64.b64decode(data.replace("\\\n", "")))) for _, data in sources]
    assert len({picture.size for picture in pictures}) == 1
    assert len({picture.tobytes() for picture in pictures}) == 11
    names = re.findall(r' id="([^"]*)"', page)
    assert len(names) == len(set(names))
    for used in re.findall(r'class="fa ([\w-]+)', page):
        assert f".{used}::before {{" in page  # the letter on its button
    assert "anim = new Animation(" in page
    assert "anim.play_animation()" in page


def test_a_page_keeps_time_and_equal_runs_write_equal_pages(tmp_path, run):
    scene = animation.Scene("<b> & $x$", "black", run, 0.7, np.inf)
    for name in ("one.html", "two.html"):
        animation.save_animation(tmp_path / name, [scene], duration=0.5, rate=30.0)
    page = (tmp_path / "one.html").read_text()
    assert page == (tmp_path / "two.html").read_text()
    assert "<title>&lt;b&gt; &amp; $x$</title>" in page
    # Browsers count in whole milliseconds: a picture every 33 ms, of what happened every 33 ms.
    assert re.search(r"new Animation\(frames, img_id, slider_id, ([^,]+),", page)[1] == "33"
    assert page.count("data:image/png") == 16  # at 0, 33, ..., 495 ms


def test_a_page_that_would_lack_pictures_is_refused(command, tmp_path, monkeypatch):
    monkeypatch.setattr(animation, "_LARGEST_PAGE", 0.1)
    done = command("animate", "--format", "html", "--duration", 0.5, "--out", tmp_path)
    assert done.code == 2
    assert "at a lower rate or with fewer controllers" in done.err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
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
        ('echo "$@" > "$0.asked"; for last; do :; done; cat > "$last"', 0, "animation.mp4"),
        ("echo no such codec >&2; exit 3", 2, "ended with exit code 3, saying no such codec"),
        ("exec 0<&-", 2, "ended with exit code 0, saying nothing"),
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
    if code == 0:  # the stub writes down what it was given: three pictures of four bytes per pixel
        asked = (tmp_path / "encoder.asked").read_text()
        width, height = map(int, re.search(r"-s (\d+)x(\d+) ", asked).groups())
        assert width % 2 == height % 2 == 0  # most players require it, and this format
        assert "-pix_fmt yuv420p" in asked
        assert "-framerate 10.0 " in asked
        assert film.stat().st_size == 3 * 4 * width * height


@pytest.mark.parametrize("kind", ["gif", "mp4", "html"])
def test_an_interrupted_animation_is_one_and_leaves_no_file(tmp_path, monkeypatch, run, kind):
    program = tmp_path / "encoder"
    program.write_text("#!/bin/bash\ncat > /dev/null; exit 255\n")  # as ffmpeg, interrupted from the same terminal
    program.chmod(0o755)
    monkeypatch.setattr(animation, "encoder", lambda: str(program))
    scene = animation.Scene("", "black", run, 0.7, 12.0)
    with pytest.raises(KeyboardInterrupt):
        animation.save_animation(tmp_path / f"film.{kind}", [scene], duration=0.5, report=stop)
    assert list(tmp_path.iterdir()) == [program]


def test_the_pole_is_drawn_where_the_plants_coordinates_have_its_bob(run):
    instants = np.arange(11) / 20
    stage = animation._Stage(Figure().subplots(), animation.Scene("", "black", run, 0.7, 12.0), 2.0, instants)
    x, theta, voltage = (np.asarray(one)[::25] for one in (run.state.x, run.state.theta, run.voltage))
    assert np.ptp(x) > 0.1
    tips = np.stack([x - 0.7 * np.sin(theta), 0.7 * np.cos(theta)])  # x - l sin(theta), as cpjax.State says
    for i in (0, 4, 10, 7):  # in any order
        stage.draw(i)
        np.testing.assert_allclose(np.ravel(stage._bob.get_data()), tips[:, i])
        np.testing.assert_allclose(stage._pole.get_data(), np.stack([[x[i], 0.0], tips[:, i]]).T)
        np.testing.assert_allclose(stage._trail.get_data(), tips[:, : i + 1])  # of 0.6 s at most
        assert stage._cart.get_center() == pytest.approx((x[i], 0.0))
        assert stage._bar.get_width() == pytest.approx(0.8 * 2.0 * voltage[i] / 12.0)
        assert stage._text.get_text() == f"swing up   {voltage[i]:+5.1f} V"


def test_a_trail_has_the_last_six_tenths_of_a_second(run):
    axes = Figure().subplots()
    stage = animation._Stage(axes, animation.Scene("", "black", run, 0.7, 12.0), 2.0, np.arange(101) / 100)
    stage.draw(90)
    assert stage._trail.get_xdata().shape == (60,)


@pytest.mark.slow
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
        (("animate", "--format", "html", "--rate", "100", "--duration", "15.1"), "15 s for html at this rate, 1500"),
        (("basin", "--across", "x", "--up", "x"), "up"),
        (("basin", "--cells", "0"), "cells"),
        (("basin", "--controllers", "corrected/nothing"), "controller"),
        (("basin", "--controllers", "tuned_lqr", "tuned_lqr"), "controllers"),
        (("basin", "--dt", "nan"), "dt"),
        (("pareto", "--bounds", "0"), "bounds"),
        (("pareto", "--supplies", "nan"), "supplies"),
        (("pareto", "--supplies", "1e300"), "supplies"),
        (("pareto", "--candidates", "1000000000000"), "candidates"),
        (("basin", "--controllers", "corected/lqr"), "tuned_quanser_ip02_long, a law (as-printed, "),
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
