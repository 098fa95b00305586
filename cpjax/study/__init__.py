"""Studies computed from many rollouts: recordings, basins, gradient audits and design checks; `fronts`: trade-offs."""

from cpjax.study.basin import Area, Axis, StartGrid, area
from cpjax.study.design_check import DesignCheck, check_design
from cpjax.study.gradient_audit import GradientAudit, audit_gradients
from cpjax.study.named_parameters import Parametrisation, parametrise
from cpjax.study.recording import read_sweep, record_sweep
from cpjax.study.summary import summarise

__all__ = [
    "Area",
    "Axis",
    "DesignCheck",
    "GradientAudit",
    "Parametrisation",
    "StartGrid",
    "area",
    "audit_gradients",
    "check_design",
    "parametrise",
    "read_sweep",
    "record_sweep",
    "summarise",
]
