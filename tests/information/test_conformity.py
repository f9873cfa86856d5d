"""Risks of accepting falsely: against an independent package, by another road, and by counting simulated units."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

import gradcal_jax as gj
from gradcal_jax.information.conformity import (
    acceptance_limit,
    chance_of_keeping,
    coverage_of_risk,
    global_risks,
    specific_risk,
)
from gradcal_jax.information.imu_residual import errors_of, quantity_of
from gradcal_jax.information.residual import statistic, statistic_of_each
from gradcal_jax.information.verdicts import decision_rule, limit_of, verdict_of
from gradcal_jax.model.imu_build import build_imu, imu_posterior

PACKAGE = json.loads((Path(__file__).parent / "conformity_suncal.json").read_text(encoding="utf-8"))
SIZES = st.floats(0.01, 100.0)


@pytest.mark.parametrize("case", PACKAGE["cases"], ids=lambda case: f"limit {case['limit']}")
def test_risks_are_those_of_an_independent_package(case):
    """50 cases, recorded: see `source` in the file. Equal to 1e-6 and better (its own quadrature has 3e-9)."""
    risks = global_risks(case["spread"], case["uncertainty"], case["limit"], case["limit"] - case["guard_band"])
    assert risks.false_accept == pytest.approx(case["false_accept"], abs=1e-8)
    assert risks.false_reject == pytest.approx(case["false_reject"], abs=1e-8)
    specific = specific_risk(case["measured"], case["uncertainty"], case["limit"])
    assert specific == pytest.approx(case["specific"], abs=1e-12)


def test_there_are_fifty_cases_with_and_without_guard_bands():
    guarded = [case for case in PACKAGE["cases"] if case["guard_band"] != 0.0]
    assert (len(PACKAGE["cases"]), len(guarded)) == (50, 25)


@given(SIZES, SIZES, SIZES, st.floats(0.3, 1.2))
@settings(deadline=None)
def test_risks_are_those_of_the_bivariate_normal_distribution(s, u, limit, share):
    """Error and measured value are jointly normal: JCGM 106, equation A.9 and onward, by SciPy's own integral."""
    acceptance = share * limit
    risks = global_risks(s, u, limit, acceptance)
    both = multivariate_normal([0.0, 0.0], [[s**2, s**2], [s**2, s**2 + u**2]], allow_singular=True)
    accepted = 2.0 * norm.cdf(acceptance / np.hypot(s, u)) - 1.0
    inside = both.cdf([limit, acceptance], lower_limit=[-limit, -acceptance])
    assert risks.accepted == pytest.approx(accepted, abs=1e-10)
    assert risks.false_accept == pytest.approx(accepted - inside, abs=2e-6)
    assert risks.false_reject == pytest.approx(2.0 * norm.cdf(limit / s) - 1.0 - inside, abs=2e-6)


@given(SIZES, SIZES, st.floats(1e-4, 0.5))
@settings(deadline=None)
def test_what_is_accepted_within_the_guard_band_has_no_more_than_the_risk(u, limit, risk):
    acceptance = acceptance_limit(u, limit, risk)
    if acceptance is None:
        assert specific_risk(0.0, u, limit) > risk
        assert limit < coverage_of_risk(risk) * u * (1.0 + 1e-9)
        return
    assert specific_risk(acceptance, u, limit) == pytest.approx(risk, rel=1e-6)
    assert specific_risk(0.5 * acceptance, u, limit) <= risk


def test_a_hundred_thousand_simulated_units_are_falsely_accepted_as_often_as_is_said():
    """A whole chain: a spec's prediction at its worst place, units drawn from it, each measured once more."""
    spec = gj.parse_spec(gj.presets.text("rig-0p05deg"))
    row = gj.predict(spec, outlook=True).requirements[0]
    rng = np.random.default_rng(20)
    errors = row.worst * rng.standard_normal(100_000)
    measured = errors + row.worst * rng.standard_normal(100_000)
    accepted = np.abs(measured) <= row.target
    beyond = np.abs(errors) > row.target
    for counted, stated in (
        (accepted, row.check.accepted),
        (accepted & beyond, row.check.false_accept),
        (~accepted & ~beyond, row.check.false_reject),
        (beyond, row.specific_risk),
    ):
        assert abs(np.mean(counted) - stated) < 2.0 * np.sqrt(stated * (1.0 - stated) / 100_000)


def test_the_chance_of_a_sensor_is_that_of_errors_drawn_from_the_dense_covariance():
    spec = gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), {"requirement[0].grid": [11, 13]})
    built = build_imu(spec)
    root = errors_of(built.model, imu_posterior(built), quantity_of(built, built.spec.requirement[0]))
    assert root.shape[:4] == (1, 1, 11, 13)
    said = chance_of_keeping(root, lambda of: statistic_of_each("mean of max", of[0]), 150e-6, draws=20_000)
    # The same by hand: monomials of the file, the reported covariance, Cholesky.
    prediction = gj.predict(spec)
    root = np.linalg.cholesky(np.array(prediction.covariance))
    box = np.linspace(-30.0, 70.0, 11), np.radians(np.linspace(-300.0, 300.0, 13))
    warm, fast = np.meshgrid((box[0] - 20.0) / 50.0, box[1] / np.radians(300.0), indexing="ij")
    rows = np.stack([warm**i * fast**j for i in range(4) for j in range(4)], axis=-1)
    rng = np.random.default_rng(3)
    maps = np.abs(np.einsum("twp,pn->ntw", rows, root @ rng.standard_normal((16, 20_000))))
    for chance, kept in zip(said, (maps.max(1).mean(1) <= 150e-6, maps.max((1, 2)) <= 150e-6), strict=True):
        assert 0.02 < chance < 0.98
        assert abs(chance - kept.mean()) < 4.0 * np.sqrt(2.0 * chance * (1.0 - chance) / 20_000)


def test_errors_that_a_structure_hides_take_part_in_the_chance():
    spec = gj.parse_spec(gj.presets.text("paper-static-gradient"))
    hidden = {"standard_deviation": "0.5 deg/h", "temperature_degree": 5}
    spec = gj.changed(spec, {"sensor.bias.discrepancy": hidden, "requirement[0].statistic": "max"})
    built = build_imu(spec)
    known, quantity = imu_posterior(built), quantity_of(built, built.spec.requirement[0])
    # At one place the chance is the normal distribution's.
    values = quantity.residual(known).values[0] / quantity.residual(known).si
    worst = int(np.argmax(values))
    limit = float(values[worst, 0])
    root = errors_of(built.model, known, quantity)[:, :, [worst]]
    chance, everywhere = chance_of_keeping(root, lambda of: of[0, 0, 0], limit, draws=40_000)
    assert chance == everywhere == pytest.approx(0.6827, abs=0.008)
    (row,) = gj.predict(spec).requirements
    assert row.max == pytest.approx(np.degrees(limit) * 3600.0)


def test_the_chance_of_several_gyros_is_that_each_keeps_the_target():
    """Of gyros with independent errors of one size, the product; and for "all" that of the root mean square."""
    spec = gj.parse_spec(gj.presets.text("ferraris"))
    built = build_imu(spec)
    requirement = next(r for r in spec.requirement if r.quantity == "gyro_bias")
    quantity = quantity_of(built, requirement)
    root = errors_of(built.model, imu_posterior(built), quantity)[:, :, :1]
    sizes = np.linalg.norm(root[:, 0, 0, 0], axis=1)
    assert len(sizes) == 3
    _, everywhere = chance_of_keeping(root, lambda of: of[:, 0, 0].max(axis=0), float(sizes[0]), draws=40_000)
    single = [chance_of_keeping(root[[k]], lambda of: of[0, 0, 0], float(sizes[0]), draws=40_000)[0] for k in range(3)]
    assert everywhere == pytest.approx(np.prod(single), abs=0.015)


MAP = np.array([[1.0, 2.0], [3.0, 2.0]])


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({}, "met"),
        ({"coverage": 2.0}, "missed"),
        ({"coverage": 2.0, "target": "5 ppm"}, "met"),
        ({"risk": "5 %"}, "missed"),
        ({"risk": "5 %", "target": "5.9 ppm"}, "met"),
        ({"risk": "5 %", "target": "5.8 ppm"}, "missed"),
        ({"risk": "5 %", "coverage": 2.0, "target": "5.9 ppm"}, "met"),
    ],
)
def test_a_verdict_follows_its_rule_and_says_it(keys, said):
    """The map's mean of max is 2.5 ppm, its worst place 3 ppm, and 1.96 of that 5.88."""
    spec = gj.parse_spec(gj.presets.text("paper-dynamic-gradient"))
    keys = {"target": "2.6 ppm", "coverage": None} | keys
    requirement = gj.changed(spec, {f"requirement[0].{k}": v for k, v in keys.items()}).requirement[0]
    assert verdict_of(requirement, lambda name: statistic(name, MAP)) == said
    assert ("guarded" if "risk" in keys else "simple acceptance") in decision_rule(requirement)
    name, limit = limit_of(requirement)
    assert (name == "max") == ("risk" in keys)
    assert limit == pytest.approx(
        float(requirement.target) * 1e6 / (1.95996398 if "risk" in keys else requirement.coverage)
    )


def test_a_target_limits_a_search_by_its_rule():
    from gradcal_jax.design.turn_plan import measure

    text = gj.presets.text("paper-dynamic-gradient").replace("coverage    = 1 ", "coverage    = 2 ")
    spec = gj.parse_spec(text + '[design]\nminimise = "motion time"\nfree = ["duration"]\nmax_motion = "100 min"\n')
    assert measure(spec).factors[0] == pytest.approx(2.0 / 80e-6)
    guarded = gj.changed(spec, {"requirement[0].risk": "5 %"})
    assert measure(guarded).factors[0] == pytest.approx(1.95996398 / 80e-6)


@pytest.mark.parametrize(
    "keys", [{"coverage": 0.0}, {"coverage": -1.0}, {"risk": "0 %"}, {"risk": "60 %"}, {"risk": 0.05}]
)
def test_coverage_and_risk_that_cannot_be_are_refused(keys):
    spec = gj.parse_spec(gj.presets.text("paper-dynamic-gradient"))
    with pytest.raises(gj.SpecError):
        gj.changed(spec, {f"requirement[0].{k}": v for k, v in keys.items()})


def test_files_of_before_keep_their_meaning_and_presets_for_users_cover_two():
    for name in gj.presets.names():
        spec = gj.parse_spec(gj.presets.text(name))
        if not (spec.is_one_axis and spec.sensor.gyro):
            continue
        wanted = 1.0 if name.startswith("paper") else 2.0
        assert all(r.coverage == wanted for r in spec.requirement if r.target is not None)
    text = gj.presets.text("tactical-mems").replace("coverage    = 2 ", "# ")
    assert all(r.coverage == 1.0 for r in gj.parse_spec(text).requirement)
