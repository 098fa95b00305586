"""Track: how far the cart may travel."""

from cpjax.pytree import Scalar, number, pytree


@pytree
class Track:
    """A track whose ends end the run: a run that leaves it is stopped, flagged and no success."""

    half_length: Scalar = number("m", "|x| within", above=0.0)
