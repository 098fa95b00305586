import math

import numpy as np
import pytest
from scipy.stats import binom, binomtest, chi2_contingency
from tables import rows

from cpjax.errors import InputError
from cpjax.numeric.statistics import mcnemar_p_value, two_proportion_p_value, wilson_interval

COUNTS = [(0, 1), (1, 1), (0, 8), (8, 8), (1, 8), (3, 8), (50, 100), (99, 100), (2048, 4096), (4095, 4096), (1, 10**6)]


@rows(("successes", "trials"), COUNTS)
@rows("confidence", [0.5, 0.9, 0.95, 0.99, 0.999999])
def test_the_wilson_interval_is_scipys(successes, trials, confidence):
    expected = binomtest(successes, trials).proportion_ci(confidence_level=confidence, method="wilson")
    assert wilson_interval(successes, trials, confidence) == pytest.approx(tuple(expected), rel=1e-12, abs=1e-15)


def test_the_default_confidence_is_95_percent():
    assert wilson_interval(3, 8) == wilson_interval(3, 8, 0.95)


@rows("trials", [1, 2, 5, 8, 33])
def test_the_interval_contains_the_rate_and_stays_within_0_and_1(trials):
    for successes in range(trials + 1):
        low, high = wilson_interval(successes, trials)
        assert 0.0 <= low <= successes / trials <= high <= 1.0
        assert low < high


def test_the_interval_is_exact_at_no_and_at_all_successes():
    for trials in (1, 3, 7, 4096, 10**9):
        assert wilson_interval(0, trials)[0] == 0.0
        assert wilson_interval(trials, trials)[1] == 1.0


def test_failures_have_the_mirrored_interval_of_successes():
    for successes in range(9):
        low, high = wilson_interval(successes, 8)
        assert wilson_interval(8 - successes, 8) == pytest.approx((1 - high, 1 - low), abs=1e-15)


def test_more_trials_at_one_rate_make_the_interval_narrower():
    widths = [high - low for low, high in (wilson_interval(n // 4, n) for n in (4, 40, 400, 4000))]
    assert widths == sorted(widths, reverse=True)


@rows("rate", [0.02, 0.2, 0.5, 0.9])
def test_the_interval_holds_the_true_rate_about_as_often_as_it_says(rate):
    trials = 200
    inside = [low <= rate <= high for low, high in (wilson_interval(k, trials) for k in range(trials + 1))]
    coverage = binom.pmf(np.arange(trials + 1), trials, rate)[inside].sum()
    assert coverage == pytest.approx(0.95, abs=0.03)


@rows(
    ("a", "n", "b", "m"),
    [(3, 8, 5, 8), (10, 100, 30, 120), (4000, 4096, 4050, 4096), (1, 5, 4, 5), (500, 1000, 501, 1000), (0, 9, 3, 4)],
)
def test_the_two_proportion_test_is_pearsons_chi_square_without_correction(a, n, b, m):
    expected = chi2_contingency([[a, n - a], [b, m - b]], correction=False).pvalue
    assert two_proportion_p_value(a, n, b, m) == pytest.approx(expected, rel=1e-9)


@rows("order", [(0, 5, 0, 9), (5, 5, 9, 9)])
def test_rates_that_are_all_or_nothing_alike_are_no_evidence(order):
    assert two_proportion_p_value(*order) == 1.0


def test_equal_rates_have_a_p_value_of_1():
    assert two_proportion_p_value(2, 4, 5, 10) == 1.0


def test_the_order_of_the_two_samples_does_not_matter():
    assert two_proportion_p_value(3, 8, 20, 30) == two_proportion_p_value(20, 30, 3, 8)


def test_opposite_rates_over_many_trials_have_a_vanishing_p_value_without_a_warning():
    p = two_proportion_p_value(0, 10**9, 10**9, 10**9)
    assert 0.0 <= p < 1e-300
    assert math.isfinite(p)


@rows(("counts", "field"), [((1, -1), "only_b"), ((-1, 2), "only_a"), ((1, True), "only_b")])
def test_mcnemars_test_names_a_bad_count(counts, field):
    with pytest.raises(InputError, match=field):
        mcnemar_p_value(*counts)


@rows(("a", "b"), [(0, 0), (0, 1), (3, 9), (9, 3), (50, 50), (400, 520), (0, 2000)])
def test_mcnemars_test_is_scipys_binomial_test_of_the_discordant_pairs(a, b):
    expected = binomtest(a, a + b, 0.5).pvalue if a + b else 1.0
    assert mcnemar_p_value(a, b) == pytest.approx(expected, rel=1e-9, abs=1e-300)
