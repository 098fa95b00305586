"""The layers of docs/architecture.md, held against the code."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
import types
from pathlib import Path

import pytest

import cpjax

ROOT = Path(cpjax.__file__).parent
LAYERS = [
    "_moved",
    "startup",
    "errors",
    "fields",
    "pytree",
    "checks",
    "files",
    "archive",
    "workspace",
    "backend",
    "numeric",
    "linear",
    "plant",
    "controllers",
    "sim",
    "io",
    "presets",
    "bridges",
    "tune",
    "study",
    "paper",
    "show",
    "cli",
]
"""A module imports only from layers listed before its own."""
GENERAL = LAYERS[: LAYERS.index("paper")]
HEAVY = ("matplotlib", "scipy", "control", "optax", "rich")


def layer_of(path):
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


def test_every_file_belongs_to_a_layer():
    assert {layer_of(path) for path in SOURCES} == {*LAYERS, "__init__", "__main__"}


def test_a_layer_imports_only_from_layers_listed_before_it():
    upward = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in SOURCES
        if layer_of(path) in LAYERS
        for name in imports(path)
        if (parts := name.split("."))[0] == "cpjax" and len(parts) > 1 and parts[1] in LAYERS
        if LAYERS.index(parts[1]) > LAYERS.index(layer_of(path))
    ]
    assert upward == []


def test_importing_cpjax_imports_the_general_layers_alone():
    script = "import sys, cpjax; print(*{name.split('.')[1] for name in sys.modules if name.startswith('cpjax.')})"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= set(GENERAL)
    assert "sim" in done.stdout.split()


def test_only_show_imports_matplotlib():
    users = {layer_of(p) for p in SOURCES if any(n.split(".")[0] == "matplotlib" for n in imports(p))}
    assert users == {"show"}


def test_only_the_command_line_and_what_a_user_calls_for_it_changes_jaxs_settings():
    assert {layer_of(p) for p in SOURCES if re.search(r"\bjax\.config\b", p.read_text())} == {"cli", "backend"}


def test_the_architecture_page_names_every_layer():
    page = (ROOT.parent / "docs" / "architecture.md").read_text()
    table = page.split("## The layers")[1].split("Inside `sim/`")[0]
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    named = [line.split("`")[1].rstrip("/").removesuffix(".py") for line in rows]
    assert named == LAYERS


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


def test_every_public_name_has_a_docstring_of_its_own():
    for name, thing in public_things():
        assert thing.__doc__, name
        assert not thing.__doc__.startswith(f"{name}("), f"{name}: that is the one dataclasses write"


def test_every_module_says_what_it_is_for():
    assert [str(p) for p in SOURCES if not ast.get_docstring(ast.parse(p.read_text()))] == []


def test_a_tests_name_has_at_most_80_characters():
    names = [
        name
        for path in (ROOT.parent / "tests").rglob("test_*.py")
        for name in re.findall(r"def (test_\w+)", path.read_text())
    ]
    assert [name for name in names if len(name) > 80] == []


def test_no_docstring_begins_with_of_or_what():
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in SOURCES
        for line in path.read_text().splitlines()
        if re.match(r'\s*"""(Of|What)\b', line)
    ]
    assert found == []


PACKAGES = ["backend", "numeric", "linear", "plant", "controllers", "sim", "tune", "study", "study.fronts", "paper"]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_exports_its_public_names(name):
    package = importlib.import_module(f"cpjax.{name}")
    assert package.__all__
    for public in package.__all__:
        thing = getattr(package, public)
        assert not isinstance(thing, types.ModuleType), f"{name}.{public} is a module: a submodule has its name"
        assert not inspect.isroutine(thing) or thing.__doc__, public
