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
    "rig",
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


TYPED = ("linear", "numeric", "plant", "controllers")
SHAPED = {"Bool", "Complex", "Float", "Int", "Int32", "Num", "Real"}
"""jaxtyping's types, which state a dtype and, in their brackets, a shape."""
NO_ARRAY = {
    "numeric/small_matrices.py: batch_last.function": "a function of any arrays",
    "numeric/small_matrices.py: batch_last": "as above",
    "plant/cartpole.py: CartPole.motor": "a Motor, LumpedMotor, ForceActuator or AccelerationActuator",
    "plant/cartpole.py: rod.others": "numbers and a motor, by name",
    "plant/initial_states.py: sample_starts.dtype": "a dtype, in each form that NumPy takes",
    "plant/initial_states.py: check_starts.name": "an argument of a user, not known to be a text",
    "plant/initial_states.py: check_starts.count": "as above",
    "plant/initial_states.py: check_starts.seed": "as above",
    "controllers/feedback.py: without_design.controller": "a controller, any pytree",
    "controllers/feedback.py: without_design": "as above",
    "controllers/digital.py: init.measurement": "what a sensor returns, any pytree",
    "controllers/digital.py: init": "an estimator's memory, any pytree",
    "controllers/digital.py: update.memory": "as above",
    "controllers/digital.py: update.measurement": "what a sensor returns, any pytree",
    "controllers/digital.py: update": "an estimator's memory, any pytree",
    "controllers/estimators.py: init.measurement": "what a sensor returns, any pytree",
    "controllers/estimators.py: update.measurement": "as above",
    "controllers/estimators.py: correct.measurement": "as above",
    "controllers/digital.py: advance.memory": "an estimator's memory, any pytree",
    "controllers/digital.py: advance": "as above",
    "controllers/digital.py: correct.memory": "as above",
    "controllers/digital.py: correct.measurement": "what a sensor returns, any pytree",
    "controllers/digital.py: correct": "an estimator's memory, any pytree",
    "controllers/digital.py: DigitalMemory.estimator": "an estimator's memory, any pytree",
    "controllers/digital.py: DigitalMemory.controller": "a controller's memory, any pytree",
    "controllers/tracking.py: square_wave.controller": "a controller, any pytree",
    "controllers/tracking.py: from_file.controller": "as above",
    "controllers/tracking.py: steps.controller": "as above",
    "controllers/tracking.py: ReferenceMemory.controller": "a controller's memory, any pytree",
    "controllers/tracking.py: IntegralMemory.controller": "as above",
    "plant/contact.py: in_contact.plant": "a CartPole, bare or on the bench",
    "plant/contact.py: in_contact": "as above, or an InContact",
    "plant/contact.py: InContact.free": "a CartPole, bare or on the bench",
    "plant/contact.py: during.memory": "the memory of a drive, any pytree",
    "plant/contact.py: during": "as above",
    "controllers/protocol.py: init.measurement": "what a sensor returns, any pytree",
    "controllers/protocol.py: init": "a controller's memory, any pytree",
    "controllers/protocol.py: update.memory": "as above",
    "controllers/protocol.py: update.measurement": "what a sensor returns, any pytree",
    "controllers/protocol.py: update": "a controller's memory, any pytree",
    "controllers/protocol.py: modes_in.memory": "as above",
    "controllers/protocol.py: at_period.controller": "a controller, any pytree",
    "controllers/protocol.py: at_period": "as above",
    "controllers/protocol.py: is_clocked.controller": "as above",
    "controllers/protocol.py: as_controller.controller": "as above",
    "controllers/protocol.py: as_controller": "as above",
    "controllers/protocol.py: as_sampled.controller": "as above",
}
"""Annotations with a bare Any that are for something else than an array, and what they are for."""


def annotations(tree):
    """Name and annotation of everything public in a module: arguments, results (by the function's name) and fields."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from (
                (f"{node.name}.{field.target.id}", field.annotation)
                for field in node.body
                if isinstance(field, ast.AnnAssign)
            )
            yield from annotations(ast.Module([part for part in node.body if isinstance(part, ast.FunctionDef)], []))
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs, node.args.vararg, node.args.kwarg]
            yield from ((f"{node.name}.{one.arg}", one.annotation) for one in given if one and one.annotation)
            if node.returns:
                yield node.name, node.returns


def without_shape(annotation):
    """Names of arrays, and Any, in an annotation outside the brackets of jaxtyping's types."""
    if isinstance(annotation, ast.Subscript) and getattr(annotation.value, "id", None) in SHAPED:
        return
    name = getattr(annotation, "id", getattr(annotation, "attr", None))
    if name in ("Any", "Array", "ArrayLike", "JaxOrNumpy", "MatrixLike", "ndarray"):
        yield name
    for part in ast.iter_child_nodes(annotation):
        yield from without_shape(part)


def test_public_arrays_have_shape_and_dtype_in_their_types():
    bare = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in SOURCES
        if layer_of(path) in TYPED and not path.name.startswith("_")
        for name, annotation in annotations(ast.parse(path.read_text()))
        if list(without_shape(annotation))
    }
    assert bare <= set(NO_ARRAY)
