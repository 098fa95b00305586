"""The documentation, built strictly; its Python is run, and no public name is missing."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import cpjax
from cpjax import cli

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_it_builds_without_a_broken_link_and_shows_every_public_name(site):
    pages = "".join(path.read_text() for path in (site / "api").glob("*.html"))
    names = [name for name in cpjax.__all__ if name not in ("__version__", "paper")]
    assert [name for name in names if f'id="cpjax.{name}"' not in pages] == []


def test_every_page_is_in_the_navigation(site):
    listed = (ROOT / "mkdocs.yml").read_text()
    pages = [path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")]
    assert [page for page in pages if page not in listed] == []


def test_every_command_is_shown_somewhere():
    shown = " ".join(path.read_text() for path in [ROOT / "README.md", *DOCS.glob("*.md")])
    commands = next(a for a in cli.make_parser()._actions if a.dest == "command").choices
    assert [name for name in commands if f"    cpjax {name}" not in shown] == []


def test_the_rig_file_that_it_shows_is_a_rig(tmp_path):
    (shown,) = re.findall(r"```toml\n(.*?)```", (DOCS / "rig.md").read_text(), flags=re.DOTALL)
    (tmp_path / "mine.toml").write_text(shown)
    rig = cpjax.load(tmp_path / "mine.toml")
    assert isinstance(rig, cpjax.Rig)
    assert rig.drive.delay == 0.003


@pytest.mark.slow
@pytest.mark.parametrize("page", ["how-to", "tutorial", "rig"])
def test_its_python_runs(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f"{page}.md").read_text()
    exec(compile("\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)), page, "exec"), {})
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert "inf" not in printed
    assert "False" not in printed  # a run that does not settle
