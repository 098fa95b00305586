"""Animations of one run, or of several side by side: GIF, MP4, or a self-contained HTML page."""

import contextlib
import io as buffers
import itertools
import json
import math
import shutil
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from cpjax import files
from cpjax.controllers import REGULATE
from cpjax.errors import InputError
from cpjax.show.figures import as_text
from cpjax.sim.rollout import Trajectory

FORMATS = ("gif", "mp4", "html")
_TRAIL = 0.6  # visible part of the tip's path [s]
_COLOURS = 64  # size of a GIF's palette
_FASTEST_GIF = 50.0  # frames per second: browsers slow down faster GIFs
_MOST_PICTURES = 1500  # frames of a GIF: all of them are held in memory

Report = Callable[[int, int, str], None]


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
    path: Path, scenes: Sequence[Scene], *, duration: float, rate: float = 25.0, report: Report | None = None
) -> None:
    """Writes the scenes, in real time and atomically, in the format that the suffix names.

    Args:
      path: ends in .gif, .mp4 or .html.
      scenes: drawn side by side.
      duration: of the animation [s], at most that of the shortest run.
      rate: frames per second.
      report: called with the number of frames drawn, their total, and a description.

    Raises:
      InputError: another suffix, no scene, an MP4 without ffmpeg, or a duration or rate outside its range.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise InputError("path", str(path), "a file name that ends in " + ", ".join("." + one for one in FORMATS))
    if not scenes:
        raise InputError("scenes", len(scenes), "at least one")
    if not 0.0 < rate <= 100.0:
        raise InputError("rate", rate, "above 0 and at most 100 pictures per second")
    if kind == "gif" and rate > _FASTEST_GIF:
        raise InputError("rate", rate, f"above 0 and at most {_FASTEST_GIF:g} pictures per second for a GIF")
    longest = min(float(scene.trajectory.time[-1]) for scene in scenes)
    if not 1.0 / rate <= duration <= longest * (1.0 + 1e-9):
        raise InputError("duration", duration, f"at least one picture, and at most the runs' {longest:g} s")
    if kind == "gif" and duration * rate > _MOST_PICTURES:
        allowed = f"at most {_MOST_PICTURES / rate:g} s for a GIF at this rate, {_MOST_PICTURES} pictures"
        raise InputError("duration", duration, allowed)
    if kind == "html":
        files.write_text(path, page(scenes, duration, rate))
    elif kind == "gif":
        files.write_bytes(path, _gif(_pictures(scenes, duration, rate, report), rate))
    else:
        files.write_bytes(path, _mp4(_pictures(scenes, duration, rate, report), rate))


def page(scenes: Sequence[Scene], duration: float, rate: float) -> str:
    """Returns a self-contained HTML page that animates the scenes, with a play button and a time slider.

    Args:
      scenes: drawn side by side.
      duration: of the animation [s].
      rate: frames per second.
    """
    data = []
    for scene in scenes:
        x, theta, voltage, mode = _sampled(scene.trajectory, duration, rate)
        data.append(
            {
                "title": scene.title,
                "colour": scene.colour,
                "length": scene.length,
                "limit": scene.voltage_limit,
                "x": np.round(x, 4).tolist(),
                "theta": np.round(theta, 4).tolist(),
                "voltage": np.round(voltage, 3).tolist(),
                "mode": mode.tolist(),
            }
        )
    setting = {"rate": rate, "half": _half_width(scenes, duration), "scenes": data}
    return _PAGE.replace("__DATA__", json.dumps(setting).replace("<", "\\u003c"))


def _sampled(run: Trajectory, duration: float, rate: float) -> tuple[np.ndarray[Any, Any], ...]:
    """Returns x, theta, voltage and mode at each frame, four arrays (frames,)."""
    instants = np.arange(math.floor(duration * rate + 1e-9) + 1) / rate
    at = np.clip(np.searchsorted(np.asarray(run.time), instants - 1e-9), 0, len(run.time) - 1)
    return tuple(np.asarray(column)[at] for column in (run.state.x, run.state.theta, run.voltage, run.mode))


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


class _Stage:
    """Axes of one scene, and the artists that move in them."""

    def __init__(self, axes: Axes, scene: Scene, half: float) -> None:
        self._scene, self._half = scene, half
        length = scene.length
        self._cart_size = 0.36 * length, 0.16 * length
        axes.set_xlim(-half, half)
        axes.set_ylim(-1.75 * length, 1.35 * length)
        axes.set_aspect("equal")
        axes.set_title(as_text(scene.title), fontsize="medium")
        axes.set_xlabel("x [m]")
        axes.set_yticks([])
        axes.axhline(-0.5 * self._cart_size[1], color="0.6", linewidth=1.0)
        axes.plot([0.0], [-0.5 * self._cart_size[1]], "|", color="0.4", markersize=12)
        self._cart = Rectangle((0.0, 0.0), *self._cart_size, facecolor="0.75", edgecolor="0.2")
        (self._trail,) = axes.plot([], [], color=scene.colour, alpha=0.35, linewidth=1.5)
        (self._pole,) = axes.plot([], [], color=scene.colour, linewidth=4.0, solid_capstyle="round")
        (self._bob,) = axes.plot([], [], "o", color=scene.colour, markersize=9)
        low, high = -1.55 * length, 0.12 * length
        axes.add_patch(Rectangle((-0.8 * half, low), 1.6 * half, high, facecolor="none", edgecolor="0.4"))
        if np.isfinite(scene.voltage_limit):
            for sign, side in ((-1.0, "right"), (1.0, "left")):
                end = f"{sign * scene.voltage_limit:+.4g} V"
                axes.text(0.82 * sign * half, low + 0.5 * high, end, ha=side, va="center", fontsize="x-small")
        self._bar = Rectangle((0.0, low), 0.0, high, facecolor="#009E73")
        for patch in (self._cart, self._bar):
            axes.add_patch(patch)
        self._text = axes.text(0.0, low + 1.6 * high, "", ha="center", va="bottom", fontsize="small")
        self._path: deque[tuple[float, float]] = deque()

    def draw(self, x: float, theta: float, voltage: float, mode: int, kept: int) -> None:
        """Draws one instant; the trail shows the last `kept` points."""
        scene = self._scene
        tip = x - scene.length * np.sin(theta), scene.length * np.cos(theta)
        self._cart.set_xy((x - 0.5 * self._cart_size[0], -0.5 * self._cart_size[1]))
        self._pole.set_data([x, tip[0]], [0.0, tip[1]])
        self._bob.set_data([tip[0]], [tip[1]])
        self._path.append(tip)
        while len(self._path) > kept:
            self._path.popleft()
        self._trail.set_data(*zip(*self._path, strict=True))
        limit = scene.voltage_limit if np.isfinite(scene.voltage_limit) else max(1.0, abs(voltage))
        self._bar.set_width(0.8 * self._half * voltage / limit)
        away = "" if abs(x) <= self._half else f"   x = {x:+.1f} m"
        self._text.set_text(f"{'regulator' if mode == REGULATE else 'swing up'}   {voltage:+5.1f} V{away}")


def _pictures(scenes: Sequence[Scene], duration: float, rate: float, report: Report | None) -> Iterator[Image.Image]:
    half = _half_width(scenes, duration)
    height = 3.9 * 1.55 * max(scene.length for scene in scenes) / half + 1.25  # axes 3.9 in wide
    figure = Figure(figsize=(4.2 * len(scenes), max(2.6, height)), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    stages = [
        _Stage(a, s, half) for a, s in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True)
    ]
    columns = [_sampled(scene.trajectory, duration, rate) for scene in scenes]
    title = figure.suptitle("", fontsize="medium")
    count = len(columns[0][0])
    for i in range(count):
        title.set_text(f"{i / rate:.1f} s")
        for stage, (x, theta, voltage, mode) in zip(stages, columns, strict=True):
            stage.draw(float(x[i]), float(theta[i]), float(voltage[i]), int(mode[i]), max(1, round(_TRAIL * rate)))
        canvas.draw()  # type: ignore[no-untyped-call]  # untyped in matplotlib
        if i == 0:
            figure.set_layout_engine("none")  # all frames keep the layout of the first
        if report is not None:
            report(i + 1, count, "pictures")
        pixels: Any = canvas.buffer_rgba()  # type: ignore[no-untyped-call]
        yield Image.fromarray(np.asarray(pixels)[..., :3].copy())


def _gif(pictures: Iterator[Image.Image], rate: float) -> bytes:
    every = list(pictures)
    # The palette comes from frames of the whole run: one frame alone may lack colours that appear later.
    few = every[:: max(1, len(every) // 8)]
    sheet = Image.new("RGB", (few[0].width, few[0].height * len(few)))
    for i, picture in enumerate(few):
        sheet.paste(picture, (0, i * picture.height))
    palette = sheet.quantize(_COLOURS)
    first, *others = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in every)
    # GIF delays are whole hundredths of a second: the frames' ends are rounded, so that the errors do not add up.
    ends = np.round(100.0 * np.arange(len(every) + 1) / rate).astype(int)
    buffer = buffers.BytesIO()
    first.save(
        buffer,
        "GIF",
        save_all=True,
        append_images=others,
        duration=(10 * np.diff(ends)).tolist(),
        loop=0,
        optimize=True,
        disposal=1,
    )
    return buffer.getvalue()


def _mp4(pictures: Iterator[Image.Image], rate: float) -> bytes:
    program = encoder()
    if program is None:
        raise InputError("path", "an .mp4", "a .gif or .html file: there is no ffmpeg to make an .mp4")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        first = next(pictures)
        raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.width}x{first.height}", "-r", str(rate)]
        even = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]  # most players require both
        command = [program, "-y", "-loglevel", "error", *raw, "-i", "-", *even, str(path)]
        with open(Path(folder) / "said", "w+b") as log:
            with (  # a broken pipe: ffmpeg stopped early; the log says why
                contextlib.suppress(BrokenPipeError),
                subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log) as process,
            ):
                assert process.stdin is not None
                for picture in itertools.chain([first], pictures):
                    process.stdin.write(picture.tobytes())
            log.seek(0)
            said = log.read().decode(errors="replace").strip()
        code = process.returncode
        if code or not path.exists():
            allowed = f"gif or html: {program} ended with exit code {code}, saying {said or 'nothing'}"
            raise InputError("format", "mp4", allowed)
        return path.read_bytes()


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>cpjax animation</title>
<style>
:root { color-scheme: light dark; --ink: #1b1f24; --paper: #fff; --line: #8a949e; --cart: #c4c9ce; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --paper: #14171a; --line: #6a747e; --cart: #4a5158; } }
body { margin: 0 auto; max-width: 70rem; padding: 1rem; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, sans-serif; }
#scenes { display: flex; flex-wrap: wrap; gap: 1rem; } figure { flex: 1 1 18rem; margin: 0; min-width: 0; }
canvas { width: 100%; display: block; } figcaption { text-align: center; }
#controls { display: flex; gap: 0.8rem; align-items: center; margin-top: 0.8rem; } input { flex: 1; }
button { font: inherit; min-width: 5rem; }
output { min-width: 4rem; text-align: right; font-variant-numeric: tabular-nums; }
</style></head><body>
<div id="scenes"></div>
<div id="controls"><button id="play">Pause</button>
<input id="at" type="range" min="0" value="0" aria-label="time"><output id="time"></output></div>
<script>
const data = __DATA__;
const count = data.scenes[0].x.length, at = document.getElementById("at"), play = document.getElementById("play");
at.max = count - 1;
let playing = true, from = performance.now();
const views = data.scenes.map(scene => {
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  const canvas = document.createElement("canvas");
  caption.textContent = scene.title;
  figure.append(caption, canvas);
  document.getElementById("scenes").append(figure);
  return {scene, canvas};
});
function draw(i) {
  const style = getComputedStyle(document.documentElement), ink = style.getPropertyValue("--ink");
  const line = style.getPropertyValue("--line"), cart = style.getPropertyValue("--cart");
  for (const {scene, canvas} of views) {
    const L = scene.length, ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
    const scale = width / (2 * data.half), height = 3.1 * L * scale;
    canvas.width = width * ratio; canvas.height = height * ratio; canvas.style.height = height + "px";
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    const X = x => (x + data.half) * scale, Y = y => (1.35 * L - y) * scale;
    const x = scene.x[i], theta = scene.theta[i], u = scene.voltage[i];
    c.strokeStyle = line; c.lineWidth = 1;
    c.beginPath(); c.moveTo(0, Y(-0.08 * L)); c.lineTo(width, Y(-0.08 * L)); c.stroke();
    c.strokeStyle = scene.colour; c.globalAlpha = 0.35; c.lineWidth = 2; c.beginPath();
    for (let k = Math.max(0, i - Math.round(0.6 * data.rate)); k <= i; k++)
      c.lineTo(X(scene.x[k] - L * Math.sin(scene.theta[k])), Y(L * Math.cos(scene.theta[k])));
    c.stroke(); c.globalAlpha = 1;
    c.fillStyle = cart; c.strokeStyle = ink;
    c.fillRect(X(x - 0.18 * L), Y(0.08 * L), 0.36 * L * scale, 0.16 * L * scale);
    c.strokeRect(X(x - 0.18 * L), Y(0.08 * L), 0.36 * L * scale, 0.16 * L * scale);
    const tip = [X(x - L * Math.sin(theta)), Y(L * Math.cos(theta))];
    c.strokeStyle = c.fillStyle = scene.colour; c.lineWidth = 5; c.lineCap = "round";
    c.beginPath(); c.moveTo(X(x), Y(0)); c.lineTo(...tip); c.stroke();
    c.beginPath(); c.arc(...tip, 6, 0, 7); c.fill();
    const limit = isFinite(scene.limit) ? scene.limit : Math.max(1, Math.abs(u));
    c.strokeStyle = line; c.lineWidth = 1;
    c.strokeRect(X(-0.8 * data.half), Y(-1.43 * L), 1.6 * data.half * scale, 0.12 * L * scale);
    c.fillStyle = "#009E73";
    c.fillRect(X(0), Y(-1.43 * L), 0.8 * data.half * scale * u / limit, 0.12 * L * scale);
    c.fillStyle = ink; c.font = "11px system-ui, sans-serif";
    if (isFinite(scene.limit)) for (const sign of [-1, 1]) {
      c.textAlign = sign < 0 ? "right" : "left";
      c.fillText((sign < 0 ? "\u2212" : "+") + scene.limit + " V", X(0.82 * sign * data.half), Y(-1.53 * L));
    }
    c.textAlign = "center"; c.font = "14px system-ui, sans-serif";
    const away = Math.abs(x) > data.half ? "   x = " + x.toFixed(1) + " m" : "";
    c.fillText((scene.mode[i] ? "regulator" : "swing up") + "   " + u.toFixed(1) + " V" + away, X(0), Y(-1.33 * L));
  }
  document.getElementById("time").textContent = (i / data.rate).toFixed(1) + " s";
}
function tick(now) {
  if (playing) at.value = Math.floor((now - from) / 1000 * data.rate) % count;
  draw(+at.value);
  requestAnimationFrame(tick);
}
function resume() { from = performance.now() - at.value / data.rate * 1000; }
play.onclick = () => { playing = !playing; resume(); play.textContent = playing ? "Pause" : "Play"; };
at.oninput = () => { playing = false; play.textContent = "Play"; };
requestAnimationFrame(tick);
</script></body></html>
"""
