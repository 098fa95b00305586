"""Opens the report and an animation in a headless Chromium: as wide as a phone and a desktop, light and dark, printed.

    make report
    python experiments/open_pages.py

Writes a picture of each view, a PDF of each page, and open_pages.json; fails if a page says anything on its console,
asks for anything that is not in it, or stays light where the reader wants it dark. Needs one of `BROWSERS` on the path.
"""

import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _common import run
from PIL import Image, ImageChops

from cpjax import cli, files

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
WIDTHS = {"phone": 390, "desktop": 1280}
HEIGHT = 24000  # what is left over below is cut off
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-extensions",
    "--disable-sync",
    "--disable-component-update",
    "--disable-background-networking",
    "--enable-logging=stderr",
    "--virtual-time-budget=4000",
)


def find_browser() -> str | None:
    """The first of `BROWSERS` that there is."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


def view(browser: str, page: Path, picture: Path, width: int, *, dark: bool) -> dict[str, Any]:
    """Takes a picture of a page and returns what it said and asked for."""
    with tempfile.TemporaryDirectory() as folder:
        net = Path(folder) / "net.json"
        size = [f"--window-size={width},{HEIGHT}", f"--blink-settings=preferredColorScheme={0 if dark else 1}"]
        files = [f"--log-net-log={net}", f"--user-data-dir={folder}/profile", f"--screenshot={picture}"]
        command = [browser, *OPTIONS, *size, *files, page.resolve().as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)
        requests = [event.get("params", {}) for event in json.loads(net.read_text())["events"]]
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    with Image.open(picture) as image:
        colours = image.convert("RGB")
        ground = Image.new("RGB", colours.size, colours.getpixel((0, colours.height - 1)))
        box = ImageChops.difference(colours, ground).getbbox() or (0, 0, width, 1)
        colours.crop((0, 0, width, min(HEIGHT, box[3] + 16))).save(picture)
        brightness = float(np.asarray(colours.crop((0, 0, width, 8))).mean())
    # The browser's own requests have no initiator; a page that is a file has the origin "null".
    elsewhere = sorted({one["url"] for one in requests if one.get("initiator") in ("null", "file://") and "url" in one})
    return {"picture": picture.name, "height": box[3], "said": said, "asked": elsewhere, "ground": brightness}


def printed(browser: str, page: Path, file: Path) -> int:
    """Prints a page to a PDF and returns its number of sheets."""
    with tempfile.TemporaryDirectory() as folder:
        files = [f"--user-data-dir={folder}/profile", f"--print-to-pdf={file}", "--no-pdf-header-footer"]
        subprocess.run(
            [browser, *OPTIONS, *files, page.resolve().as_uri()], capture_output=True, timeout=180, check=True
        )
    return len(re.findall(rb"/Type\s*/Page\b", file.read_bytes()))


def main(out: Path, quick: bool = False, seed: int = 1) -> dict[str, Any]:
    """Prints what each view said and asked for and writes the files; quickly, of the animation alone."""
    browser = find_browser()
    if browser is None:
        raise SystemExit("none of these is on the path: " + ", ".join(BROWSERS))
    out.mkdir(parents=True, exist_ok=True)
    if cli.main(["animate", "--format", "html", "--seed", str(seed), "--out", str(out)]) != 0:
        raise SystemExit("cpjax animate failed")
    pages = [out / "animation.html"]
    if not quick:
        pages.append(Path("out/report/report.html"))
        if not pages[-1].exists():
            raise SystemExit(f"{pages[-1]} is not there: run `make report` first")
    found: dict[str, Any] = {}
    ill = []
    for page in pages:
        views = {}
        for device, width in WIDTHS.items():
            for colours in ("light", "dark"):
                picture = out / f"{page.stem}-{device}-{colours}.png"
                one = view(browser, page, picture, width, dark=colours == "dark")
                views[f"{device}, {colours}"] = one
                said, asked = one["said"] or "nothing", one["asked"] or "nothing"
                print(f"{page.name}, {device}, {colours}: {one['height']} px high, said {said}, asked for {asked}")
                if one["said"] or one["asked"] or (colours == "dark" and one["ground"] > 100.0):
                    ill.append(picture.name)
        sheets = printed(browser, page, out / f"{page.stem}.pdf")
        print(f"{page.name}, printed: {sheets} sheets")
        found[page.name] = {"views": views, "sheets": sheets}
    files.write_json(out / "open_pages.json", found)
    if ill:
        raise SystemExit("not as they should be: " + ", ".join(ill))
    return found


if __name__ == "__main__":
    run(main, __doc__ or "")
