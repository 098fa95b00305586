"""The rooms of docs/architecture.md, held against the code."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import cpjax

ROOT = Path(cpjax.__file__).parent
ROOMS = [
    "startup",
    "errors",
    "pytree",
    "runtime",
    "compilation",
    "returned",
    "numeric",
    "state",
    "starts",
    "plant",
    "design",
    "controllers",
    "paper",
    "sim",
    "io",
    "presets",
    "bridges",
    "tune",
    "study",
    "show",
    "cli",
]
HEAVY = ("matplotlib", "scipy", "control", "optax", "rich")


def room_of(path):
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def imports(path):
    """Full names of the modules that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            yield node.module
            if node.module == "cpjax":
                yield from (f"cpjax.{alias.name}" for alias in node.names)


SOURCES = sorted(ROOT.rglob("*.py"))


def test_every_file_stands_in_a_known_room():
    assert {room_of(path) for path in SOURCES} == {*ROOMS, "__init__", "__main__"}


@pytest.mark.parametrize("path", [p for p in SOURCES if room_of(p) in ROOMS], ids=lambda p: str(p.relative_to(ROOT)))
def test_a_room_imports_only_from_rooms_above_it(path):
    here = ROOMS.index(room_of(path))
    for name in imports(path):
        parts = name.split(".")
        if parts[0] == "cpjax" and len(parts) > 1 and parts[1] in ROOMS:
            assert ROOMS.index(parts[1]) <= here, f"{path.relative_to(ROOT)} imports {name}"


def test_only_show_imports_matplotlib():
    users = {room_of(p) for p in SOURCES if any(n.split(".")[0] == "matplotlib" for n in imports(p))}
    assert users == {"show"}


def test_only_the_command_line_and_what_a_user_calls_for_it_changes_jaxs_settings():
    assert {room_of(p) for p in SOURCES if re.search(r"\bjax\.config\b", p.read_text())} == {"cli", "runtime"}


def test_the_architecture_page_names_every_room():
    page = (ROOT.parent / "docs" / "architecture.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    named = [line.split("`")[1].rstrip("/").removesuffix(".py") for line in rows]
    assert named == ROOMS


def test_importing_cpjax_starts_no_backend_and_loads_nothing_heavy():
    script = (
        "import sys, jax, jax.numpy; before = set(sys.modules); import cpjax; from jax._src import xla_bridge;"
        f"loaded = [m for m in {HEAVY} if m in sys.modules and m not in before];"
        "sys.exit(f'loaded {loaded}, backends {list(xla_bridge._backends)}' if loaded or xla_bridge._backends else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def public_things():
    for name in cpjax.__all__:
        thing = getattr(cpjax, name)
        if isinstance(thing, type) or callable(thing):
            yield name, thing


@pytest.mark.parametrize("name", [name for name, _ in public_things()])
def test_every_public_name_has_a_docstring_of_its_own(name):
    thing = getattr(cpjax, name)
    assert thing.__doc__
    assert not thing.__doc__.startswith(f"{name}("), "that is the one dataclasses write"


def test_every_module_says_what_it_is_for():
    assert [str(p) for p in SOURCES if not ast.get_docstring(ast.parse(p.read_text()))] == []
