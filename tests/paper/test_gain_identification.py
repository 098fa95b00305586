"""Where printed gains come from: the paper's, whose answer is known, and those of made-up rigs, whose truth is."""

import dataclasses
import json
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import jacobian, rough_plant
from scipy.linalg import solve_continuous_are
from scipy.signal import place_poles
from tables import rows

import cpjax
from cpjax import CartPole, InputError, Motor, files, linearize, paper
from cpjax.paper import gain_identification, plant_fit
from cpjax.paper.gain_identification import Direction, GainAudit, audit_gains, document, write
from cpjax.paper.plant_fit import PARAMETERS, Fit, least_squares
from cpjax.paper.printed_gains import PrintedGain, printed_in_the_paper
from cpjax.plant import with_parameters
from cpjax.pytree import cast
from cpjax.show.figures import png
from cpjax.show.gain_identification import direction_cells, findings, fit_cells, picture, shown_fits

APPENDIX = paper.appendix_plant()
PAIR = ("torque_constant", "back_emf_constant")
TEXTS = ("1.0", "-2.00", "30", "4.5")
# Three sets of eight starts, of both kinds of gain: one compiled program serves most of the tests here.
SMALL = {"most": 2, "starts": 8, "seed": 3}


def scipys_gains(plant, Q, R, poles):
    """Placement and LQR, one after the other."""
    return gains_of_model(*(np.asarray(matrix) for matrix in linearize(plant)), Q, R, poles)


def gains_of_model(A, B, Q, R, poles):
    P = solve_continuous_are(A, B, np.diag(Q), np.array([[R]]))
    return np.concatenate([place_poles(A, B, poles).gain_matrix[0], B[:, 0] @ P / R])


def prints_of(plant, decimals=2, Q=(100.0, 1.0, 500.0, 1.0), R=1e-3, poles=(-2.0, -3.0, -4.0, -5.0)):
    texts = [f"{k:.{decimals}f}" for k in scipys_gains(plant, Q, R, poles)]
    return [PrintedGain.placement(texts[:4], poles), PrintedGain.lqr(texts[4:], Q, R)]


def value_of(plant, name):
    return float(getattr(plant if hasattr(plant, name) else plant.motor, name))


def off(plant, names, factors=(1.3, 0.8)):
    return with_parameters(plant, {n: f * value_of(plant, n) for n, f in zip(names, factors, strict=True)})


@pytest.fixture(scope="module")
def papers():
    return audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR, **SMALL)


# --- gains as printed -------------------------------------------------------------------------------------------------


@rows(
    ("text", "value", "unit"),
    [
        ("-24.7", -24.7, 0.1),
        ("-24.70", -24.7, 0.01),
        ("\u221224.70", -24.7, 0.01),  # a minus sign as typesetters set it
        ("+111", 111.0, 1.0),
        ("111.", 111.0, 1.0),
        (".5", 0.5, 0.1),
        ("0", 0.0, 1.0),
        ("0.000", 0.0, 0.001),
        (" 1.5 ", 1.5, 0.1),
        ("1e3", 1000.0, 1000.0),
        ("-1.41421E+3", -1414.21, 0.01),
        ("2.50e-3", 0.0025, 1e-5),
    ],
)
def test_the_digits_of_a_printed_number_say_how_precise_it_is(text, value, unit):
    gain = PrintedGain.lqr([text, "1", "1", "1"], [1.0] * 4, 1.0)
    assert (gain.gain[0], gain.unit[0]) == (pytest.approx(value, rel=1e-15), pytest.approx(unit, rel=1e-15))
    assert gain.gain[1:] == gain.unit[1:] == (1.0, 1.0, 1.0)


@rows(
    "text", ["", "-", ".", "x", "1,5", "1_000", "1e", "1e1.5", "0x10", "inf", "nan", "1 2", "--1", "1\u00b2", 1.5, None]
)
def test_what_is_no_printed_number_is_refused(text):
    with pytest.raises(InputError, match=r"^lqr gain = .*: must be a number as printed"):
        PrintedGain.lqr(["1", "1", "1", text], [1.0] * 4, 1.0)


@rows("text", ["1e400", "0e400", "1e-400", "1." + 400 * "0"])
def test_a_number_whose_size_or_last_digit_no_float_can_hold_is_refused(text):
    with pytest.raises(InputError, match=r"^placement gain = .*: must be a number that fits a float"):
        PrintedGain.placement(["1", text, "1", "1"], paper.POLES)


REFUSED_DESIGNS = [
    (lambda: PrintedGain.lqr(TEXTS[:3], [1.0] * 4, 1.0), "lqr gain", "four numbers as printed"),
    (lambda: PrintedGain.placement((*TEXTS, "1"), paper.POLES), "placement gain", "four numbers as printed"),
    (lambda: PrintedGain.placement("1234", paper.POLES), "placement gain", "four numbers as printed"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0] * 3, 1.0), "Q", "four finite numbers"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0, 1.0, -1.0, 1.0], 1.0), "Q", "four finite numbers, at least 0"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0, 1.0, math.inf, 1.0], 1.0), "Q", "four finite numbers"),
    (lambda: PrintedGain.lqr(TEXTS, None, 1.0), "Q, R", "numbers"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0, 1.0, "x", 1.0], 1.0), "Q, R", "numbers"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0] * 4, 0.0), "R", "a finite number above 0"),
    (lambda: PrintedGain.lqr(TEXTS, [1.0] * 4, math.nan), "R", "a finite number above 0"),
    (lambda: PrintedGain.placement(TEXTS, [-1.0, -2.0, -3.0]), "poles", "four of them"),
    (lambda: PrintedGain.placement(TEXTS, [-1.0, -2.0, -3 + 1j, -3.0]), "poles", "closed under conjugation"),
    (lambda: PrintedGain.placement(TEXTS, [-1.0, -2.0, -3.0, math.nan]), "poles", "finite"),
    (lambda: PrintedGain.placement(TEXTS, "abcd"), "poles", "a sequence of numbers"),
]


@rows(("make", "field", "allowed"), REFUSED_DESIGNS)
def test_a_design_that_makes_no_sense_is_refused_by_name(make, field, allowed):
    with pytest.raises(InputError, match=rf"^{field} = .*: must be .*{re.escape(allowed)}"):
        make()


def test_the_papers_printed_gains_have_two_decimals_and_their_designs():
    placement, lqr = printed_in_the_paper()
    assert (placement.design, placement.poles, placement.Q, placement.R) == ("placement", paper.POLES, None, None)
    assert (lqr.design, lqr.poles, lqr.Q, lqr.R) == ("lqr", None, paper.Q, paper.R)
    for gain in (placement, lqr):
        assert gain.gain == paper.PRINTED_GAINS[gain.design]
        assert gain.unit == (0.01,) * 4


# --- the paper, whose answer is known ---------------------------------------------------------------------------------


def test_two_numbers_explain_the_papers_gains_to_their_last_digit_and_one_does_not(papers):
    [single, other, pair] = papers.fits
    assert (single.parameters, other.parameters, pair.parameters) == (PAIR[:1], PAIR[1:], PAIR)
    assert min(single.worst, other.worst) > 80.0
    assert not single.explains
    assert not other.explains
    assert pair.worst == pytest.approx(0.355, abs=0.002)  # 0.71 of half a digit, of the gain that no plant can change
    assert pair.explains
    assert papers.simplest == (pair,)
    assert papers.best(1) is min(single, other, key=lambda fit: fit.worst)
    motor = papers.plant.motor
    assert motor.force_per_voltage == pytest.approx(1.03846, abs=1e-5)
    assert motor.damping == pytest.approx(1.93007, abs=1e-3)
    assert pair.values == (motor.torque_constant, motor.back_emf_constant)
    assert pair.values == (pytest.approx(1.29808, abs=1e-5), pytest.approx(1.8586, abs=1e-3))
    assert all(value_of(papers.plant, n) == value_of(APPENDIX, n) for n in PARAMETERS if n not in PAIR)


def test_every_start_ends_in_the_same_place_on_the_paper(papers):
    assert [fit.reached for fit in papers.fits] == [1.0, 1.0, 1.0]
    again = audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR, **{**SMALL, "seed": 4})
    for fit, other in zip(papers.fits, again.fits, strict=True):
        assert other.values != fit.values  # other starts
        assert other.values == pytest.approx(fit.values, rel=1e-6)


def test_the_same_seed_gives_the_same_audit(papers):
    again = audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR, **SMALL)
    assert (again.unchanged, again.fits, again.directions) == (papers.unchanged, papers.fits, papers.directions)


def test_residuals_are_scipys_gains_less_the_printed_in_units_of_the_last_digit(papers):
    design = paper.Q, paper.R, paper.POLES
    printed = np.concatenate([paper.PRINTED_GAINS["placement"], paper.PRINTED_GAINS["lqr"]])
    plants = [with_parameters(APPENDIX, dict(zip(f.parameters, f.values, strict=True))) for f in papers.fits]
    for plant, residuals in zip(
        [APPENDIX, *plants], [papers.unchanged, *(f.residuals for f in papers.fits)], strict=True
    ):
        expected = (scipys_gains(plant, *design) - printed) / 0.01
        np.testing.assert_allclose(residuals, expected, rtol=1e-8, atol=1e-5)
    for fit in papers.fits:
        assert fit.worst == max(map(abs, fit.residuals))


def test_no_small_change_of_a_fitted_parameter_fits_better(papers):
    design = paper.Q, paper.R, paper.POLES
    printed = np.concatenate([paper.PRINTED_GAINS["placement"], paper.PRINTED_GAINS["lqr"]])
    for fit in papers.fits:
        least = np.sum(np.square(fit.residuals))
        for name, value in zip(fit.parameters, fit.values, strict=True):
            for factor in (0.999, 0.99999, 1.00001, 1.001):
                values = {**dict(zip(fit.parameters, fit.values, strict=True)), name: value * factor}
                moved = (scipys_gains(with_parameters(APPENDIX, values), *design) - printed) / 0.01
                # SciPy's gains have 9 good digits, and a parameter of no consequence changes fewer.
                assert np.sum(moved**2) > least * (1.0 - 1e-9), (name, factor)


def test_progress_counts_the_sets_up_to_their_number():
    calls = []
    audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR, **SMALL, progress=lambda *call: calls.append(call))
    assert [call[:2] for call in calls] == [(0, 3), (3, 3)]
    assert "2" in calls[0][2]
    assert "8 initial states" in calls[0][2]


# --- made-up rigs, whose truth is known -------------------------------------------------------------------------------


@rows("names", [("pole_length", "cart_friction"), ("pivot_friction", "gear_ratio")])
def test_wrong_parameters_of_a_rig_are_recovered_as_precisely_as_promised(names):
    rig = rough_plant()
    prints = prints_of(rig)
    audit = audit_gains(prints, off(rig, names), parameters=names, **SMALL)
    [fit] = audit.simplest
    assert fit.parameters == names
    assert fit.worst <= 0.5
    error = {n: math.log(v / value_of(rig, n)) for n, v in zip(names, fit.values, strict=True)}
    assert max(map(abs, error.values())) < 0.02
    for direction in audit.directions:
        assert direction.identified
        along = sum(w * error[n] for n, w in direction.weights.items())
        # Eight residuals of half a digit each, all in the worst direction, are sqrt(8) times half a digit.
        assert abs(along) <= math.sqrt(8.0) * direction.known_to
    for found, true in zip(linearize(audit.plant), linearize(rig), strict=True):
        assert np.max(np.abs(found - true)) <= 1e-3 * np.max(np.abs(true))


def test_more_digits_of_the_gains_give_more_digits_of_the_parameters():
    rig, names = rough_plant(), ("pole_length", "cart_friction")
    errors, promised = [], []
    for decimals in (2, 4, 6):
        audit = audit_gains(prints_of(rig, decimals), off(rig, names), parameters=names, **SMALL)
        errors.append(max(abs(v / value_of(rig, n) - 1.0) for n, v in zip(names, audit.best(2).values, strict=True)))
        promised.append(audit.directions[-1].known_to)
    assert promised[0] == pytest.approx(1e2 * promised[1], rel=0.02)
    assert promised[1] == pytest.approx(1e2 * promised[2], rel=0.02)
    for error, known_to in zip(errors, promised, strict=True):
        assert 0.01 * known_to < error < 3.0 * known_to


def room(audit, name):
    """Relative change of one parameter alone that eight residuals of half a digit each can hide."""
    return math.sqrt(8.0) * 0.5 / math.hypot(*(d.sensitivity * d.weights[name] for d in audit.directions))


def test_of_two_parameters_that_act_as_a_ratio_only_the_ratio_is_recovered():
    rig, names = rough_plant(), ("torque_constant", "resistance")
    audit = audit_gains(prints_of(rig), off(rig, names, (1.3, 1.1)), parameters=names, **SMALL)
    assert [fit.parameters for fit in sorted(audit.simplest, key=lambda f: f.parameters)] == [names[1:], names[:1]]
    truth = value_of(rig, names[0]) / value_of(rig, names[1])
    for fit in audit.fits:
        plant = with_parameters(off(rig, names, (1.3, 1.1)), dict(zip(fit.parameters, fit.values, strict=True)))
        assert value_of(plant, names[0]) / value_of(plant, names[1]) == pytest.approx(truth, rel=1e-3)
        assert abs(value_of(plant, names[0]) / value_of(rig, names[0]) - 1.0) > 0.05
    known, unknown = audit.directions
    assert known.identified
    assert known.weights[names[0]] == pytest.approx(-known.weights[names[1]], rel=1e-6)
    assert (unknown.sensitivity, unknown.known_to, unknown.identified) == (0.0, math.inf, False)
    assert unknown.weights[names[0]] == pytest.approx(unknown.weights[names[1]], rel=1e-6)
    assert direction_cells(unknown)[1:] == ["0", "not at all"]


def test_a_parameter_that_is_zero_in_the_plant_is_found_where_the_rig_has_one():
    rig, names = dataclasses.replace(rough_plant(), pole_inertia=0.0), ("cart_friction", "pole_inertia")
    without = with_parameters(rig, {"cart_friction": 0.0})
    audit = audit_gains(prints_of(rig), without, parameters=names, **SMALL)
    [fit] = audit.simplest
    assert fit.parameters == ("cart_friction",)
    assert 0.0 < room(audit, "cart_friction") < 0.1
    assert fit.values[0] == pytest.approx(rig.cart_friction, rel=room(audit, "cart_friction"))
    assert audit.plant.pole_inertia == 0.0
    assert all(math.isfinite(d.sensitivity) and d.sensitivity > 0.0 for d in audit.directions)


def test_the_gains_of_the_plant_itself_need_no_change():
    rig, names = rough_plant(), ("pole_length", "cart_friction")
    audit = audit_gains(prints_of(rig), rig, parameters=names, **SMALL)
    assert max(map(abs, audit.unchanged)) <= 0.5 + 1e-6
    assert len(audit.simplest) == 2
    for fit in audit.simplest:
        [name] = fit.parameters
        assert fit.values[0] == pytest.approx(value_of(rig, name), rel=room(audit, name))


@rows(("plant", "count"), [(rough_plant(), 6), (APPENDIX, 5)], ids=["rough", "appendix"])
def test_the_sensitivities_are_how_far_scipys_gains_move(plant, count):
    names = [n for n in PARAMETERS if value_of(plant, n) > 0.0]
    prints = prints_of(plant)
    design = prints[1].Q, prints[1].R, np.real(prints[0].poles)

    sizes = jnp.asarray([value_of(plant, n) for n in names])

    @jax.jit
    @jax.vmap
    def models(change):
        return linearize(with_parameters(plant, dict(zip(names, sizes * (1.0 + change), strict=True))))

    def moved(changes):
        """Gains in units of the last digit, for relative changes (many, names)."""
        matrices = zip(*map(np.asarray, models(changes)), strict=True)
        return np.stack([gains_of_model(A, B, *design) / 0.01 for A, B in matrices])

    expected = jacobian(moved, np.zeros(len(names)), 1e-3)
    directions = gain_identification._directions(tuple(prints), plant, tuple(names))
    weights = np.array([[d.weights[n] for n in names] for d in directions])
    np.testing.assert_allclose(weights @ weights.T, np.eye(len(names)), atol=1e-12)
    sensitivities = np.array([d.sensitivity for d in directions])
    assert np.all(np.diff(sensitivities) <= 0.0)
    np.testing.assert_allclose(
        np.linalg.norm(weights @ expected.T, axis=1), sensitivities, atol=1e-7 * sensitivities[0]
    )
    # As many as a plant's linear model has independent numbers: mass matrix (3), friction (2), weight (1) and push (1),
    # but for a common factor; in the appendix, the pole has neither an inertia nor a friction of its own.
    assert np.sum(sensitivities > 0.0) == count


@pytest.mark.slow
def test_the_plant_may_be_of_float32_arrays():
    audit = audit_gains(printed_in_the_paper(), cast(APPENDIX, jnp.float32), parameters=PAIR, **SMALL)
    assert audit.best(2).worst == pytest.approx(0.355, abs=0.002)


# --- the fits themselves ----------------------------------------------------------------------------------------------


def fake_ends(monkeypatch, residuals_of):
    """Fits that end where they start, with residuals made up from the lane's number."""
    lane = iter(range(10**6))
    sizes = []

    def fitted(prints, plant, own, base, chosen, starts):
        sizes.append(len(starts))
        return np.exp(starts), np.array([residuals_of(next(lane)) for _ in starts])

    monkeypatch.setattr(plant_fit, "_fitted", fitted)
    return sizes


def test_reached_is_the_share_of_starts_whose_cost_is_that_of_the_best(monkeypatch):
    costs = [4.0, 4.03, 4.035, 4.05, math.inf, 9.0, math.inf, 4.0]  # within 1 % of 4: four of eight
    fake_ends(monkeypatch, lambda lane: [math.sqrt(costs[lane % 8])] + [0.0] * 7)
    audit = audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR[:1], most=1, starts=8)
    assert audit.fits[0].reached == 0.5
    assert audit.fits[0].worst == 2.0

    costs[:] = [1e-4, 5e-3, 1.2e-2, 1.0, 1e-6, 4.0, 4.0, 4.0]  # within 0.01 of 0: three of eight
    fake_ends(monkeypatch, lambda lane: [math.sqrt(costs[lane % 8])] + [0.0] * 7)
    audit = audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR[:1], most=1, starts=8)
    assert audit.fits[0].reached == 0.375
    assert audit.fits[0].worst == 1e-3


def test_a_set_from_which_no_start_leads_anywhere_explains_nothing(monkeypatch):
    fake_ends(monkeypatch, lambda lane: [math.inf] * 8 if lane < 8 else [3.0] * 8)
    audit = audit_gains(printed_in_the_paper(), APPENDIX, parameters=PAIR, most=1, starts=8)
    assert (audit.fits[0].worst, audit.fits[0].reached, audit.fits[0].explains) == (math.inf, 0.0, False)
    assert audit.best(1) is audit.fits[1]
    assert audit.plant.motor.back_emf_constant == audit.fits[1].values[0]
    assert "back_emf_constant" in " ".join(findings(audit))
    assert files.dump_json(document(audit, printed_in_the_paper(), APPENDIX))


def test_more_fits_than_run_side_by_side_are_those_of_one_go(monkeypatch):
    monkeypatch.setattr(plant_fit, "_BATCH", 7)
    sizes = fake_ends(monkeypatch, lambda lane: [float(lane + 1)] * 8)
    calls = []
    audit = audit_gains(
        printed_in_the_paper(), APPENDIX, parameters=PAIR, **SMALL, progress=lambda *call: calls.append(call[:2])
    )
    assert sizes == [7, 7, 7, 7]
    assert [fit.worst for fit in audit.fits] == [1.0, 9.0, 17.0]
    assert calls == [(0, 3), (0, 3), (1, 3), (2, 3), (3, 3)]
    assert [len(fit.values) for fit in audit.fits] == [1, 1, 2]


def test_least_squares_finds_rosenbrocks_minimum_and_stays_at_a_start_not_finite():
    def residuals(x):
        r = jnp.stack([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])
        return r, jnp.stack([jnp.stack([-20.0 * x[0], 10.0 * jnp.ones_like(x[0])]), jnp.asarray([-1.0, 0.0])])

    solve = jax.jit(jax.vmap(lambda x: least_squares(residuals, x, 2)))
    ends, rest = solve(jnp.asarray([[-1.2, 1.0], [3.0, -2.0], [jnp.nan, 1.0]]))
    np.testing.assert_allclose(ends[:2], 1.0, atol=1e-7)
    np.testing.assert_allclose(rest[:2], 0.0, atol=1e-7)
    assert np.all(np.isinf(rest[2]))


# --- what is refused --------------------------------------------------------------------------------------------------

PRINTS = printed_in_the_paper()
REFUSED = [
    ({"prints": []}, "prints", "a list of one PrintedGain or more"),
    ({"prints": PRINTS[0]}, "prints", "a list of one PrintedGain or more"),
    ({"prints": [PRINTS[0], "1 2 3 4"]}, "prints", "a list of one PrintedGain or more"),
    ({"plant": "appendix"}, "plant", "a cpjax.CartPole"),
    ({"plant": CartPole(cart_mass=np.array([1.0, 2.0]))}, "plant.cart_mass", "of shape ()"),
    ({"parameters": []}, "parameters", "different ones of cart_mass"),
    ({"parameters": ["cart_mass", "cart_mass"]}, "parameters", "different ones of cart_mass"),
    ({"parameters": ["mass"]}, "parameters", "different ones of cart_mass"),
    ({"parameters": ["voltage_limit"]}, "parameters", "different ones of cart_mass"),
    ({"parameters": "cart_mass"}, "parameters", "different ones of cart_mass"),
    ({"most": 0}, "most", "a whole number from 1 to 2"),
    ({"most": 3}, "most", "a whole number from 1 to 2"),
    ({"most": 1.0}, "most", "a whole number from 1 to 2"),
    ({"starts": 0}, "starts", "a whole number from 1 to 100000"),
    ({"starts": True}, "starts", "a whole number from 1 to 100000"),
    ({"starts": 10**9}, "starts", "a whole number from 1 to 100000"),
    ({"seed": -1}, "seed", "a whole number, at least 0"),
    ({"seed": 1.5}, "seed", "a whole number, at least 0"),
]


@rows(("given", "field", "allowed"), REFUSED)
def test_an_audit_that_makes_no_sense_is_refused_by_name(given, field, allowed):
    given = {"prints": PRINTS, "plant": APPENDIX, "parameters": PAIR, **SMALL, **given}
    prints, plant = given.pop("prints"), given.pop("plant")
    with pytest.raises(InputError, match=rf"^{re.escape(field)} = .*: must be {re.escape(allowed)}"):
        audit_gains(prints, plant, **given)


def test_a_design_that_the_plant_has_no_gain_for_is_refused_by_name():
    blind = PrintedGain.lqr(TEXTS, [0.0, 1.0, 1.0, 1.0], 1.0)  # does not see where the cart is
    with pytest.raises(InputError, match=r"^lqr gain = \(1\.0, -2\.0, .*: must be of a design for which the plant"):
        audit_gains([PRINTS[0], blind], APPENDIX, parameters=PAIR, **SMALL)


# --- JSON, tables, sentences, pictures --------------------------------------------------------------------------------


def plain(value):
    """As the JSON file holds it, read back by a strict reader."""

    def forbidden(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(files.dump_json(value), parse_constant=forbidden)


def test_the_document_is_strict_json_that_tells_the_audit_back(papers, tmp_path):
    prints = printed_in_the_paper()
    table = plain(document(papers, prints, APPENDIX, seed=3, parameters=PAIR))
    assert table["setting"] == {"seed": 3, "parameters": list(PAIR)}
    assert table["versions"] == files.versions()
    fits = [Fit(tuple(f["parameters"]), tuple(f["values"]), tuple(f["residuals"]), f["reached"]) for f in table["fits"]]
    assert tuple(fits) == papers.fits
    assert [f["worst"] for f in table["fits"]] == [fit.worst for fit in papers.fits]
    assert [f["explains"] for f in table["fits"]] == [False, False, True]
    assert table["simplest"] == table["fits"][2:]
    assert tuple(Direction(d["sensitivity"], d["weights"]) for d in table["directions"]) == papers.directions
    assert tuple(table["unchanged"]) == papers.unchanged
    for printed, row in zip(prints, table["printed"], strict=True):
        assert (tuple(row["gain"]), tuple(row["unit"])) == (printed.gain, printed.unit)
        assert (row["Q"], row["R"]) == (printed.Q and list(printed.Q), printed.R)
        assert (row["poles"] and tuple(map(complex, row["poles"]))) == printed.poles
    for key, plant in (("plant", APPENDIX), ("found", papers.plant)):
        files.write_json(tmp_path / f"{key}.json", table[key])
        again = cpjax.load(tmp_path / f"{key}.json")
        assert all(value_of(again, n) == value_of(plant, n) for n in (*PARAMETERS, "voltage_limit"))
    write(tmp_path / "audit.json", papers, prints, APPENDIX, seed=3, parameters=PAIR)
    assert json.loads((tmp_path / "audit.json").read_text(encoding="utf-8")) == table


def test_what_nobody_can_know_is_written_as_inf():
    audit = GainAudit((0.0,) * 4, (Fit(("gravity",), (9.0,), (0.1,) * 4, 1.0),), (Direction(0.0, {}),), APPENDIX)
    assert plain(document(audit, PRINTS[:1], APPENDIX))["directions"][0]["known_to"] == "inf"


def made_up(explained):
    """An audit of three parameters and their pairs, with directions of every kind."""
    names = ("cart_mass", "pole_length", "gravity")
    sizes = [(n,) for n in names], [(names[0], names[1]), (names[0], names[2]), (names[1], names[2])]
    worst = iter([512.0, 99.44, 120.0, 0.25, 7.0, 0.75] if explained else [512.0, 99.44, 120.0, 7.0, 2.5, 30.0])
    fits = [Fit(s, (1.0,) * len(s), (-next(worst), 0.1, 0.0, 0.2), 0.5) for size in sizes for s in size]
    directions = [Direction(s, {n: 1.0 / math.sqrt(3.0) for n in names}) for s in (250.0, 4.0, 0.0)]
    return GainAudit((0.9, -1.1, 200.0, -512.4), tuple(fits), tuple(directions), APPENDIX)


def test_the_sentences_are_true_to_the_numbers(papers):
    for audit in (papers, made_up(True), made_up(False)):
        first, *sizes, last = findings(audit)
        within, gains, worst = re.search(r"(\d+) of (\d+) printed gains .* worst is ([\d.]+) units off", first).groups()
        assert int(within) == sum(abs(r) <= 1.0 for r in audit.unchanged)
        assert int(gains) == len(audit.unchanged)
        assert float(worst) == pytest.approx(max(map(abs, audit.unchanged)), rel=5e-3)
        assert len(sizes) == 2
        for size, sentence in enumerate(sizes, 1):
            fits = [fit for fit in audit.fits if len(fit.parameters) == size]
            good = sum(fit.worst <= 1.0 for fit in fits)
            best = min(fits, key=lambda fit: fit.worst)
            assert f"{good or 'none'} of {len(fits)} explain" in sentence
            assert f"The best, {' and '.join(best.parameters)}, leaves" in sentence
            assert float(re.search(r"leaves ([\d.]+) units", sentence)[1]) == pytest.approx(best.worst, rel=5e-3)
            assert ("rounding alone" in sentence) == (good > 0)
            assert ("Single parameters" in sentence) == (size == 1)
        known = [d for d in audit.directions if d.sensitivity > 5.0]
        unknown = sum(d.sensitivity == 0.0 for d in audit.directions)
        numbers = re.search(
            r"of (\d+) independent .* fix (\d+) .*, (\d+) less well and (\d+) not at all", last
        ).groups()
        between = len(audit.directions) - len(known) - unknown
        assert tuple(map(int, numbers)) == (len(audit.directions), len(known), between, unknown)
        assert float(re.search(r"to ([\d.]+) %\)", last)[1]) == pytest.approx(50.0 / known[-1].sensitivity, rel=0.05)


def test_an_audit_that_knows_nothing_says_so():
    audit = dataclasses.replace(made_up(False), directions=(Direction(0.0, {"gravity": 1.0}),))
    assert "fix 0 to better than 10 %, 0 less well and 1 not at all" in findings(audit)[-1]


def test_a_line_of_the_table_has_the_fits_numbers(papers):
    pair = papers.best(2)
    cells = fit_cells(pair, APPENDIX)
    assert cells[0] == "torque_constant, back_emf_constant"
    assert cells[1] == f"{pair.values[0]:.5g} N m/A, {pair.values[1]:.5g} V s/rad"
    assert cells[2:] == [f"{pair.worst:.3g}", "1.03846", "1.93006", "100 %"]
    rubbing = with_parameters(APPENDIX, {"cart_friction": 0.25})
    assert fit_cells(pair, rubbing)[4] == "2.18006"


def test_the_table_shows_the_best_of_each_size_that_fails_and_all_that_explain():
    [one, *pairs] = shown_fits(made_up(True))
    assert one.parameters == ("pole_length",)
    assert [(fit.parameters, fit.worst) for fit in pairs] == [
        (("cart_mass", "pole_length"), 0.25),
        (("pole_length", "gravity"), 0.75),
    ]
    assert [fit.worst for fit in shown_fits(made_up(False))] == [99.44, 2.5]


def test_a_combination_is_shown_with_its_larger_weights_largest_first():
    weights = {"cart_mass": 0.05, "pole_length": -0.6, "gravity": 0.798}
    assert direction_cells(Direction(250.0, weights)) == ["+0.80 gravity -0.60 pole_length", "250", "0.2 %"]


@rows("kind", ["pairs", "single", "knows nothing"])
def test_a_picture_cuts_nothing_off_and_shows_what_is_unknown_below_everything_else(kind):
    audit = made_up(True)
    if kind != "pairs":
        audit = dataclasses.replace(audit, fits=audit.fits[:3])
    if kind == "knows nothing":
        audit = dataclasses.replace(audit, fits=audit.fits[:1], directions=(Direction(0.0, {}),))
    figure = picture(audit)
    assert png(figure).startswith(b"\x89PNG")
    box = figure.bbox
    for axes in figure.axes:
        around = axes.get_tightbbox()
        assert box.x0 <= around.x0 < around.x1 <= box.x1
        assert box.y0 <= around.y0 < around.y1 <= box.y1
    right = figure.axes[1]
    [unknown] = [line for line in right.lines if line.get_label().startswith("0: not known")]
    [dashed] = [line for line in right.lines if "10 %" in line.get_label()]
    heights = {
        line: line.get_transform().transform(np.column_stack(line.get_data()))[:, 1] for line in (unknown, dashed)
    }
    assert len(heights[unknown]) == 1
    assert np.max(heights[unknown]) < np.min(heights[dashed]) - 10.0
    for line in right.lines:
        if line.get_label() == "known by the gains":
            points = line.get_transform().transform(np.column_stack(line.get_data()))[:, 1]
            assert not np.any(points < np.max(heights[unknown]) + 10.0)


def test_the_pictures_circles_are_the_pairs_that_explain():
    axes = picture(made_up(True)).axes[0]
    circles = {tuple(int(v[0]) for v in line.get_data()) for line in axes.lines}
    assert circles == {(0, 1), (1, 0), (1, 2), (2, 1)}


def test_changing_a_plant_changes_its_motor_too_and_nothing_else():
    plant = with_parameters(APPENDIX, {"pole_mass": 0.25, "resistance": 2.0})
    motor = Motor(1.25, 1.0, 2.0, 7e-6, 1e-5)
    for name in (*PARAMETERS, "voltage_limit"):
        assert value_of(plant, name) == value_of(CartPole(pole_mass=0.25, motor=motor), name)
