"""Animations of one run, or of several side by side: GIF, MP4, or a self-contained HTML page."""

import html
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.animation import FFMpegWriter, FuncAnimation, HTMLWriter, PillowWriter
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from PIL import Image

from cpjax import files
from cpjax.controllers import REGULATE
from cpjax.errors import InputError
from cpjax.show import ANIMATION_FORMATS
from cpjax.show.figures import as_text
from cpjax.sim.rollout import Trajectory

_TRAIL = 0.6  # visible part of the tip's path [s]
_COLOURS = 64  # size of a GIF's palette
_FASTEST_GIF = 50.0  # pictures per second: browsers slow down faster GIFs
_MOST_PICTURES = 1500  # of a GIF or a page, which hold all of them in memory
_LARGEST_PAGE = 64  # MiB


class Scene(NamedTuple):
    """One run to animate."""

    title: str
    colour: str
    trajectory: Trajectory
    length: float
    """Length of the drawn pole, pivot to tip [m]."""
    voltage_limit: float
    """Full scale of the voltage bar [V]; inf for no limit."""


def encoder() -> str | None:
    """Returns the path of ffmpeg, which encodes MP4 files; None if it is not installed."""
    return shutil.which("ffmpeg")


def save_animation(
    path: Path,
    scenes: Sequence[Scene],
    *,
    duration: float,
    rate: float = 25.0,
    report: Callable[[int, int, str], None] | None = None,
) -> None:
    """Writes the scenes, in real time and atomically, in the format that the suffix names.

    Args:
      path: ends in .gif, .mp4 or .html.
      scenes: drawn side by side.
      duration: of the animation [s], at most that of the shortest run.
      rate: pictures per second; a page has the nearest rate with a whole number of milliseconds between pictures.
      report: called with the number of pictures drawn, their total, and a description.

    Raises:
      InputError: another suffix, no scene, an MP4 that ffmpeg cannot make, a page that becomes too large, or a duration
        or rate outside its range.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ANIMATION_FORMATS:
        raise InputError("path", str(path), "a file name that ends in " + ", ".join("." + k for k in ANIMATION_FORMATS))
    if not scenes:
        raise InputError("scenes", len(scenes), "at least one")
    if not 0.0 < rate <= 100.0:
        raise InputError("rate", rate, "above 0 and at most 100 pictures per second")
    if kind == "gif" and rate > _FASTEST_GIF:
        raise InputError("rate", rate, f"above 0 and at most {_FASTEST_GIF:g} pictures per second for a GIF")
    longest = min(float(scene.trajectory.time[-1]) for scene in scenes)
    if not 1.0 / rate <= duration <= longest * (1.0 + 1e-9):
        raise InputError("duration", duration, f"at least one picture, and at most the runs' {longest:g} s")
    if kind != "mp4" and duration * rate > _MOST_PICTURES:
        allowed = f"at most {_MOST_PICTURES / rate:g} s for {kind} at this rate, {_MOST_PICTURES} pictures"
        raise InputError("duration", duration, allowed)
    if kind == "mp4" and encoder() is None:
        raise InputError("path", "an .mp4", "a .gif or .html file: there is no ffmpeg to make an .mp4")

    fps: Any = Fraction(1000, round(1000.0 / rate)) if kind == "html" else rate  # browsers' timers: whole milliseconds
    instants = np.arange(int(duration * float(fps) + 1e-9) + 1) / float(fps)
    film = _animation(scenes, duration, instants)
    writers = {
        "gif": _GifWriter(fps),
        "mp4": _FilmWriter(fps, codec="h264"),  # for which matplotlib makes width and height even, as players want
        "html": HTMLWriter(fps, embed_frames=True, embed_limit=_LARGEST_PAGE),
    }
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"film.{kind}"
        told = None if report is None else lambda i, count: report(i + 1, count, "pictures")
        film.save(str(draft), writers[kind], dpi=100 if kind == "html" else 80, progress_callback=told)
        if kind == "html":
            draft.write_text(_page(draft.read_text(), scenes, len(instants)), encoding="utf-8")
        files.write_bytes(path, draft.read_bytes())


class _Stage:
    """Axes of one scene, and the artists that move in them."""

    def __init__(self, axes: Axes, scene: Scene, half: float, instants: np.ndarray[Any, Any]) -> None:
        self._scene, self._half, self._kept = scene, half, np.count_nonzero(instants < _TRAIL - 1e-9)
        run, length = scene.trajectory, scene.length
        at = np.clip(np.searchsorted(np.asarray(run.time), instants - 1e-9), 0, len(run.time) - 1)
        columns = (run.state.x, run.state.theta, run.voltage, run.mode)
        self._x, theta, self._voltage, self._mode = (np.asarray(column)[at] for column in columns)
        self._tip = np.stack([self._x - length * np.sin(theta), length * np.cos(theta)])
        width, height = 0.36 * length, 0.16 * length
        low, high = -1.55 * length, 0.12 * length
        axes.set(xlim=(-half, half), ylim=(-1.75 * length, 1.35 * length), aspect="equal", xlabel="x [m]", yticks=[])
        axes.set_title(as_text(scene.title), fontsize="medium")
        axes.axhline(-0.5 * height, color="0.6", linewidth=1.0)
        axes.plot([0.0], [-0.5 * height], "|", color="0.4", markersize=12)
        self._cart = Rectangle((0.0, -0.5 * height), width, height, facecolor="0.75", edgecolor="0.2")
        (self._trail,) = axes.plot([], [], color=scene.colour, alpha=0.35, linewidth=1.5)
        (self._pole,) = axes.plot([], [], color=scene.colour, linewidth=4.0, solid_capstyle="round")
        (self._bob,) = axes.plot([], [], "o", color=scene.colour, markersize=9)
        axes.add_patch(Rectangle((-0.8 * half, low), 1.6 * half, high, facecolor="none", edgecolor="0.4"))
        if np.isfinite(scene.voltage_limit):
            for sign, side in ((-1.0, "right"), (1.0, "left")):
                end = f"{sign * scene.voltage_limit:+.4g} V"
                axes.text(0.82 * sign * half, low + 0.5 * high, end, ha=side, va="center", fontsize="x-small")
        self._bar = Rectangle((0.0, low), 0.0, high, facecolor="#009E73")
        for patch in (self._cart, self._bar):
            axes.add_patch(patch)
        self._text = axes.text(0.0, low + 1.6 * high, "", ha="center", va="bottom", fontsize="small")

    def draw(self, i: int) -> None:
        """Moves the artists to picture `i`."""
        x, voltage, tip = float(self._x[i]), float(self._voltage[i]), self._tip[:, i]
        self._cart.set_x(x - 0.5 * self._cart.get_width())
        self._pole.set_data([x, tip[0]], [0.0, tip[1]])
        self._bob.set_data(tip[:1], tip[1:])
        self._trail.set_data(*self._tip[:, max(0, i + 1 - self._kept) : i + 1])
        limit = self._scene.voltage_limit if np.isfinite(self._scene.voltage_limit) else max(1.0, abs(voltage))
        self._bar.set_width(0.8 * self._half * voltage / limit)
        away = "" if abs(x) <= self._half else f"   x = {x:+.1f} m"
        mode = "regulator" if self._mode[i] == REGULATE else "swing up"
        self._text.set_text(f"{mode}   {voltage:+5.1f} V{away}")


def _animation(scenes: Sequence[Scene], duration: float, instants: np.ndarray[Any, Any]) -> FuncAnimation:
    half = _half_width(scenes, duration)
    height = 3.9 * 1.55 * max(scene.length for scene in scenes) / half + 1.25  # axes 3.9 in wide
    figure = Figure(figsize=(4.2 * len(scenes), max(2.6, height)))
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    stages = [_Stage(axes, scene, half, instants) for axes, scene in zip(panels, scenes, strict=True)]
    title = figure.suptitle("", fontsize="medium")

    def draw(i: int) -> list[Artist]:
        title.set_text(f"{instants[i]:.1f} s")
        for stage in stages:
            stage.draw(i)
        return []  # what moved, which only a window wants to know

    draw(0)
    ConstrainedLayoutEngine().execute(figure)  # once: all pictures keep the layout of the first
    figure.set_layout_engine("none")  # not even one of the user's matplotlibrc
    return FuncAnimation(figure, draw, frames=len(instants), cache_frame_data=False)


def _half_width(scenes: Sequence[Scene], duration: float) -> float:
    """Returns half the width of the view [m], the same for all scenes; a cart that runs away leaves it."""
    reach = [
        float(np.max(np.maximum(np.abs(x), np.abs(x - scene.length * np.sin(theta)))))
        for scene in scenes
        for shown in [np.asarray(scene.trajectory.time) <= duration]
        for x, theta in [(np.asarray(scene.trajectory.state.x)[shown], np.asarray(scene.trajectory.state.theta)[shown])]
    ]
    longest = max(scene.length for scene in scenes)
    return float(np.clip(max(reach) + 0.25 * longest, 1.3 * longest, 4.0 * longest))


class _GifWriter(PillowWriter):
    """Writes one palette for the whole run, and delays whose rounding to hundredths of a second does not add up."""

    _frames: list[Image.Image]

    def finish(self) -> None:
        if not self._frames:  # interrupted before the first
            return
        few = self._frames[:: max(1, len(self._frames) // 8)]
        palette = Image.fromarray(np.vstack([np.asarray(picture) for picture in few])).quantize(_COLOURS)
        first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in self._frames)
        ends = np.round(100.0 * np.arange(len(self._frames) + 1) / self.fps).astype(int)
        delays = (10 * np.diff(ends)).tolist()
        options: dict[str, Any] = {"duration": delays, "loop": 0, "optimize": True, "disposal": 1}
        first.save(self.outfile, save_all=True, append_images=others, **options)


class _FilmWriter(FFMpegWriter):
    """Raises an `InputError` with ffmpeg's own words where matplotlib would log them."""

    _proc: subprocess.Popen[bytes]

    @classmethod
    def bin_path(cls) -> str:
        return encoder() or "ffmpeg"

    def finish(self) -> None:
        _, said = self._proc.communicate()
        code, made = self._proc.returncode, Path(self.outfile).exists()
        if (code or not made) and not isinstance(sys.exception(), KeyboardInterrupt):  # which stops ffmpeg as well
            words = said.decode(errors="replace").strip() or "nothing"
            allowed = f"gif or html: {self.bin_path()} ended with exit code {code}, saying {words}"
            raise InputError("format", "mp4", allowed)


def _page(player: str, scenes: Sequence[Scene], count: int) -> str:
    """Returns matplotlib's player as a page that starts by itself and needs nothing from elsewhere.

    Raises:
      InputError: matplotlib left out pictures.
    """
    if player.count("data:image/") < count:
        allowed = f"less, at a lower rate or with fewer controllers: the page would have more than {_LARGEST_PAGE} MiB"
        raise InputError("duration", f"{count} pictures", allowed)
    player = re.sub(r"<link[^>]*>", "", player)  # a font of icons
    for name in re.findall(r'id="_anim_img(\w+)"', player):
        player = player.replace(name, "")  # at random: equal runs would write unequal files
    return _PAGE.replace("TITLE", html.escape(" | ".join(s.title for s in scenes))).replace("PLAYER", player)


_PAGE = r"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>TITLE</title></head><body>
PLAYER
<style>
:root { color-scheme: light dark; } body { text-align: center; font: 16px/1.5 system-ui, sans-serif; }
.animation img { max-width: 100%; } input[type=range].anim-slider { width: 100%; }
.fa { font-style: normal; } .fa-minus::before { content: "\2212"; } .fa-plus::before { content: "+"; }
.fa-fast-backward::before { content: "\21E4"; } .fa-fast-forward::before { content: "\21E5"; }
.fa-step-backward::before { content: "\2039"; } .fa-step-forward::before { content: "\203A"; }
.fa-play::before { content: "\25B8"; } .fa-flip-horizontal::before { content: "\25C2"; }
.fa-pause::before { content: "\2016"; }
</style>
<script>setTimeout(() => anim.play_animation(), 0);  // after the player's own, which makes it</script>
</body></html>
"""
