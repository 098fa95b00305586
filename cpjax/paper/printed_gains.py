"""Printed gains with the precision of their digits, and the weights or poles that they were designed for."""

import dataclasses
import math
import re
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cpjax import paper
from cpjax.errors import InputError
from cpjax.linear.lqr import lqr
from cpjax.linear.placement import place_polynomial, polynomial_from_poles
from cpjax.plant import CartPole, linearize

_NUMBER = re.compile(r"[-+]?(?=\.?\d)\d*(\.(?P<decimals>\d*))?([eE](?P<exponent>[-+]?\d{1,9}))?", re.ASCII)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PrintedGain:
    """A gain as printed, and the weights or poles that it was designed for.

    Attributes:
      gain: K of u = -K s (4,).
      unit: size of the last printed digit of each (4,).
      poles: four closed-loop poles [1/s], or None.
      Q: diagonal of the state weight (4,), or None.
      R: weight of the voltage, or None.
    """

    gain: tuple[float, ...]
    unit: tuple[float, ...]
    poles: tuple[complex, ...] | None = None
    Q: tuple[float, ...] | None = None
    R: float | None = None

    @classmethod
    def placement(cls, texts: Sequence[str], poles: Sequence[complex]) -> "PrintedGain":
        """Returns a gain of pole placement, from its numbers as printed, whose digits give their precision.

        Args:
          texts: four numbers as printed, such as "-24.70".
          poles: four closed-loop poles, closed under conjugation [1/s].

        Raises:
          InputError: texts that are not four numbers, or poles that are not four or not closed under conjugation.
        """
        gain, unit = _parsed("placement gain", texts)
        if polynomial_from_poles(poles).shape != (4,):
            raise InputError("poles", poles, "four of them")
        return cls(gain, unit, poles=tuple(complex(p) for p in poles))

    @classmethod
    def lqr(cls, texts: Sequence[str], Q: Sequence[float], R: float) -> "PrintedGain":
        """Returns a gain of a linear quadratic regulator with a diagonal Q, from its numbers as printed.

        Args:
          texts: four numbers as printed, such as "-24.70".
          Q: diagonal of the state weight (4,).
          R: weight of the voltage.

        Raises:
          InputError: texts that are not four numbers, a Q that is not four finite numbers at least 0, or an R that is
            not finite and above 0.
        """
        gain, unit = _parsed("lqr gain", texts)
        try:
            diagonal, weight = tuple(float(q) for q in Q), float(R)
        except (TypeError, ValueError) as problem:
            raise InputError("Q, R", (Q, R), "numbers: the diagonal of Q, and R") from problem
        if len(diagonal) != 4 or not all(math.isfinite(q) and q >= 0.0 for q in diagonal):
            raise InputError("Q", Q, "four finite numbers, at least 0: the diagonal")
        if not (math.isfinite(weight) and weight > 0.0):
            raise InputError("R", R, "a finite number above 0")
        return cls(gain, unit, Q=diagonal, R=weight)

    @property
    def design(self) -> str:
        """Design that the gain is from: "placement" or "lqr"."""
        return "placement" if self.poles is not None else "lqr"

    def computed(self, plant: CartPole) -> Float[Array, "4"]:
        """Returns the gain that the poles or weights give on `plant`."""
        A, B = linearize(plant)
        if self.poles is not None:
            return place_polynomial(A, B, polynomial_from_poles(self.poles).astype(A.dtype))[0]
        assert self.Q is not None
        return lqr(A, B, jnp.diag(jnp.asarray(self.Q, dtype=A.dtype)), jnp.asarray([[self.R]], dtype=A.dtype)).K[0]


def printed_in_the_paper() -> list[PrintedGain]:
    """Returns the paper's two gains, with two decimals each (sections IV-A and IV-B)."""

    def texts(design: paper.Design) -> list[str]:
        return [f"{k:.2f}" for k in paper.PRINTED_GAINS[design]]

    return [PrintedGain.placement(texts("placement"), paper.POLES), PrintedGain.lqr(texts("lqr"), paper.Q, paper.R)]


def _parsed(field: str, texts: Sequence[str]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Returns the numbers as printed, and the sizes of their last digits."""
    if isinstance(texts, str) or len(texts) != 4:
        raise InputError(field, texts, "four numbers as printed")
    values, units = [], []
    for text in texts:
        match = _NUMBER.fullmatch(text.strip().replace("\u2212", "-")) if isinstance(text, str) else None
        if match is None:
            raise InputError(field, text, "a number as printed, such as '-24.70'")
        value = float(match[0])
        unit = float(f"1e{int(match['exponent'] or 0) - len(match['decimals'] or '')}")
        if not (math.isfinite(value) and 0.0 < unit < math.inf):
            raise InputError(field, text, "a number that fits a float, and its last digit too")
        values.append(value)
        units.append(unit)
    return tuple(values), tuple(units)
