"""Confidence intervals and significance tests of success rates.

Closed forms, because importing scipy.stats is slow; the tests compare with it.
"""

import math
from statistics import NormalDist

from cpjax.errors import InputError

_MOST = 2**53  # whole numbers up to here are exact as floats


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Returns the two-sided Wilson score interval `(low, high)` of a proportion, within [0, 1] (Wilson, 1927).

    Args:
      successes: number of trials that succeeded.
      trials: number of all trials.
      confidence: probability with which such intervals contain the true proportion.

    Raises:
      InputError: `trials` below 1, `successes` outside 0..trials, or `confidence` outside (0, 1).
    """
    _check_counts(successes, trials)
    if isinstance(confidence, bool) or not isinstance(confidence, (int, float)) or not 0 < confidence < 1:
        raise InputError("confidence", confidence, "a number above 0 and below 1")
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = successes / trials
    centre = p + z * z / (2 * trials)
    spread = z * math.sqrt(p * (1 - p) / trials + (z / (2 * trials)) ** 2)
    scale = 1 + z * z / trials
    # At 0 and at 1 the end is exact; rounding must not move it inside.
    low = 0.0 if successes == 0 else (centre - spread) / scale
    high = 1.0 if successes == trials else (centre + spread) / scale
    return low, high


def two_proportion_p_value(successes_a: int, trials_a: int, successes_b: int, trials_b: int) -> float:
    """Returns the p-value of the two-sided, pooled two-proportion z-test; 1.0 where both rates are 0 or both are 1.

    Args:
      successes_a, trials_a: trials of the first treatment that succeeded, and all of them.
      successes_b, trials_b: the same of the second treatment.

    Raises:
      InputError: `trials` below 1, or `successes` outside 0..trials, of either.
    """
    _check_counts(successes_a, trials_a)
    _check_counts(successes_b, trials_b)
    pooled = (successes_a + successes_b) / (trials_a + trials_b)
    variance = pooled * (1 - pooled) * (1 / trials_a + 1 / trials_b)
    if variance == 0:
        return 1.0
    z = (successes_a / trials_a - successes_b / trials_b) / math.sqrt(variance)
    return 2 * NormalDist().cdf(-abs(z))


def mcnemar_p_value(only_a: int, only_b: int) -> float:
    """Returns the p-value of McNemar's exact two-sided test of two treatments of the same subjects (McNemar, 1947).

    Args:
      only_a: number of subjects that succeeded under the first treatment alone.
      only_b: number of subjects that succeeded under the second treatment alone.

    Raises:
      InputError: a count below 0.
    """
    for name, count in (("only_a", only_a), ("only_b", only_b)):
        if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= _MOST:
            raise InputError(name, count, f"a whole number from 0 to {_MOST}")
    total, fewer = only_a + only_b, min(only_a, only_b)
    # P(at most `fewer` heads in `total` fair tosses), from logarithms of its terms, which may be far below 1e-308.
    logs = [math.lgamma(total + 1) - math.lgamma(k + 1) - math.lgamma(total - k + 1) for k in range(fewer + 1)]
    tail = math.fsum(math.exp(log - total * math.log(2.0)) for log in logs)
    return min(1.0, 2.0 * tail)


def _check_counts(successes: int, trials: int) -> None:
    if isinstance(trials, bool) or not isinstance(trials, int) or not 1 <= trials <= _MOST:
        raise InputError("trials", trials, f"a whole number, at least 1 and at most {_MOST}")
    if isinstance(successes, bool) or not isinstance(successes, int) or not 0 <= successes <= trials:
        raise InputError("successes", successes, f"a whole number from 0 to trials = {trials}")
