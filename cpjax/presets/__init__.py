"""The tuned controllers that come with the package, for the appendix's plant at 12 V; see docs/results.md."""

import importlib.resources
from collections.abc import Mapping

from cpjax import io, paper
from cpjax.controllers import Hybrid
from cpjax.errors import InputError

PRESETS: Mapping[paper.Design, str] = {"lqr": "tuned_lqr", "placement": "tuned_place"}
"""The name of each design's; `cpjax.save` wrote the file of that name in this folder."""


def preset(design: paper.Design) -> Hybrid:
    """The tuned hybrid controller whose regulator comes from "lqr" or "placement".

    Raises:
      InputError: another design.
    """
    if design not in PRESETS:
        raise InputError("design", design, "one of " + ", ".join(PRESETS))
    with importlib.resources.as_file(importlib.resources.files(__name__) / f"{PRESETS[design]}.json") as path:
        loaded: Hybrid = io.load(path)
    return loaded
