"""Old names of modules, which work until version 0.3 and warn."""

import importlib
import importlib.abc
import importlib.machinery
import sys
import types
import warnings
from collections.abc import Sequence
from typing import Any

MOVED = {
    "cpjax.compilation": "cpjax.backend.single_kernel",
    "cpjax.design": "cpjax.linear",
    "cpjax.numeric.trigonometry": "cpjax.backend.trigonometry",
    "cpjax.returned": "cpjax.checks",
    "cpjax.runtime": "cpjax.backend.runtime",
    "cpjax.show.forensics": "cpjax.show.gain_identification",
    "cpjax.sim.kept": "cpjax.sim.saved",
    "cpjax.starts": "cpjax.plant.initial_states",
    "cpjax.state": "cpjax.plant.state",
    "cpjax.study.comparison": "cpjax.paper.comparison",
    "cpjax.study.forensics": "cpjax.paper.gain_identification",
    "cpjax.study.front": "cpjax.study.fronts.trace",
    "cpjax.study.front_judge": "cpjax.study.fronts.evaluator",
    "cpjax.study.front_plan": "cpjax.study.fronts.config",
    "cpjax.study.front_search": "cpjax.study.fronts.cache",
    "cpjax.study.front_yardstick": "cpjax.study.fronts.reference_point",
    "cpjax.study.plant_fit": "cpjax.paper.plant_fit",
    "cpjax.study.printed_gains": "cpjax.paper.printed_gains",
    "cpjax.study.reproduction": "cpjax.paper.reproduction",
    "cpjax.tune.plan": "cpjax.tune.config",
    "cpjax.tune.starting": "cpjax.paper.initial",
}
"""Where each module is now; modules below it moved with it."""


def new_name(old: str) -> str | None:
    """Returns where a module is now, or None if it did not move."""
    for begin, now in MOVED.items():
        if old == begin or old.startswith(begin + "."):
            return now + old.removeprefix(begin)
    return None


def moved_attribute(module: str, name: str, homes: Sequence[types.ModuleType]) -> Any:
    """Returns a name that moved from a module to one of its new homes, and warns.

    Raises:
      AttributeError: no home has it.
    """
    for home in homes:
        if not name.startswith("_") and hasattr(home, name):
            message = f"{module}.{name} is now {home.__name__}.{name}; the old name goes with version 0.3"
            warnings.warn(message, DeprecationWarning, stacklevel=3)
            return getattr(home, name)
    raise AttributeError(f"module {module!r} has no attribute {name!r}")


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.machinery.ModuleSpec(name, self, is_package=True) if new_name(name) else None

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType:
        now = new_name(spec.name)
        assert now is not None
        warnings.warn(f"{spec.name} is now {now}; the old name goes with version 0.3", DeprecationWarning, stacklevel=2)
        module = types.ModuleType(spec.name, f"Old name of {now}.")
        real = importlib.import_module(now)
        # A module of its own rather than the real one: the import system writes its name and spec into it.
        vars(module)["__getattr__"] = lambda name: getattr(real, name)  # the hook of PEP 562
        return module

    def exec_module(self, module: types.ModuleType) -> None:
        """Does nothing: the module's names are those of the one that took its place."""


sys.meta_path.append(_Finder())
