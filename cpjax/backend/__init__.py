"""Code whose only purpose is speed with XLA's CPU compiler; it changes results in their last bits at most.

docs/performance.md describes each part and its effect.
"""

from cpjax.backend.runtime import compiler_fuses_loops, configure_cpu, jaxlib_is_tested, keep_compilations
from cpjax.backend.trigonometry import rotate_by, sin_cos

__all__ = [
    "compiler_fuses_loops",
    "configure_cpu",
    "jaxlib_is_tested",
    "keep_compilations",
    "rotate_by",
    "sin_cos",
]
