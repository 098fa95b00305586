"""What can go wrong in a rollout. Inside `jit` nothing raises, so it is written down instead."""

import enum

import numpy as np


class Flag(enum.IntFlag):
    """Bits of `Trajectory.flag` and `Metrics.flag`; 0 is a clean run."""

    RUNAWAY = 1
    """A rate or the cart's position left +-RUNAWAY_LIMIT. The state was held at its last value inside."""

    NON_FINITE = 2
    """The next state was NaN or infinite. The state was held at its last finite value."""

    CHATTERING = 4
    """The mode changed at CHATTER_LENGTH control instants in a row. The run went on; a gate wants hysteresis."""


STOPPED = int(Flag.RUNAWAY | Flag.NON_FINITE)
"""Flags after which the state is held, and the run is no success."""

RUNAWAY_LIMIT = 1e3
"""Bound on |x| [m], |x_dot| [m/s] and |theta_dot| [rad/s], far outside what 12 V can do in the protocol's 20 s."""

CHATTER_LENGTH = 8


def describe(flag: int) -> str:
    """The flag in words, such as "runaway" or "clean"."""
    names = [bit.name.lower().replace("_", "-") for bit in Flag if int(np.asarray(flag)) & bit and bit.name]
    return ", ".join(names) or "clean"
