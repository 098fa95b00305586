"""Track: how far the cart may travel."""

from cpjax.fields import choice
from cpjax.pytree import Scalar, number, pytree


@pytree
class Track:
    """A track of finite length.

    With ends "fail" a run that leaves it is stopped, flagged and no success. With ends "stop" the cart hits a stop
    there: x' becomes -restitution x', and the pole receives the impact.
    """

    half_length: Scalar = number("m", "|x| within", above=0.0)
    ends: str = choice(
        'what happens at an end: "fail" ends the run, "stop" is a stop', ("fail", "stop"), default="fail"
    )
    restitution: Scalar = number("1", "speed after a stop to that before", default=0.0, at_least=0.0, at_most=1.0)
