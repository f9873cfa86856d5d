"""Requirements on a branch of the temperature and on slopes of the service, and what plans say of them."""

from typing import Any

import numpy as np
import pytest
from loop_scene import spec_of

import gradcal_jax as gj
from gradcal_jax.cli.check import omitted_lines
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.absent import attitude_sentences
from gradcal_jax.spec.requirement import GyroBiasRequirement
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import SpecError

HOUR = np.pi / 180.0 / 3600.0
NONE: dict[str, Any] = {
    "turn_on_bias": "0 deg/h", "rate_random_walk": "0 deg/h/sqrt(h)", "drift": [],
    "scale_factor_instability": [], "temperature_error": {"standard_deviation": "0 K"},
}  # fmt: skip
ONE_WAY = [{"soak": "1 min", "at": "0 degC"}, {"ramp_to": "60 degC", "rate": "2 K/min"}]
TWO_WAY = [*ONE_WAY, {"ramp_to": "0 degC", "rate": "3 K/min"}]
PLAY = [{"width": "5 K", "prior": "4 deg/h/K"}]


def required(programme, gyro: dict[str, Any], **requirement: Any) -> Spec:
    """A standing gyro, read every 5 s, with a requirement on its bias from 10 to 50 degC."""
    temperature = {"degree": 1, "centre": "30 degC", "scale": "30 K"}
    own = {"axes": ["z"], "angle_random_walk": "0.2 deg/sqrt(h)"} | NONE
    of = {"name": "bias", "quantity": "gyro_bias", "temperature": ["10 degC", "50 degC"], "grid": [5]}
    return gj.changed(
        spec_of(ways=1, plays=False),
        {
            "sensor.gyro": own | {"bias": {"temperature": temperature, "prior": "100 deg/h"}} | gyro,
            "rig.site.latitude": "40 deg",
            "rig.table.axis[0].angle.reading_noise": "1 arcsec",
            "rig.table.axis[0].angle.read_every": "5 s",
            "requirement": [of | requirement],
            "plan.programme": programme,
        },
    )


def deviations(spec: Spec, sign: float, slope: float = 0.0) -> np.ndarray:
    """Standard deviations (deg/h) over the requirement's temperatures in one state, from the posterior alone."""
    built = build_imu(spec)
    names, rows = built.model.names(), np.zeros((5, built.model.size))
    functions = built.model.channels[0].map("bias")
    assert functions is not None
    rows[:, built.model.where("gyro", 2, "bias")] = functions.values(np.linspace(10.0, 50.0, 5), np.zeros(5))
    for k, name in enumerate(names):
        if name.endswith("hysteresis_5K"):
            rows[:, k] = -5.0 * sign
        if name.endswith("bias_temperature_gradient"):
            rows[:, k] = slope
    return imu_posterior(built).deviations(rows) / HOUR


GRADIENT = {"bias_temperature_gradient": {"prior": "5 deg/h/(K/min)"}}
KNOWN_GRADIENT = {"bias_temperature_gradient": "0 deg/h/(K/min)"}


def left(spec: Spec, statistic: str = "max") -> float:
    (row,) = gj.predict(spec).requirements
    return getattr(row, statistic)


@pytest.mark.parametrize("programme", [ONE_WAY, TWO_WAY])
def test_both_is_the_worst_of_the_two_at_every_temperature(programme):
    gyro = {"hysteresis": PLAY} | KNOWN_GRADIENT
    heating, cooling = (deviations(required(programme, gyro), sign) for sign in (1.0, -1.0))
    for branch, expected in (
        ("heating", heating),
        ("cooling", cooling),
        ("both", np.maximum(heating, cooling)),
        (None, deviations(required(programme, gyro), 0.0)),
    ):
        given = {} if branch is None else {"branch": branch}
        for statistic, value in (("max", np.max(expected)), ("mean", np.mean(expected))):
            spec = required(programme, gyro, statistic=statistic, **given)
            assert left(spec, statistic) == pytest.approx(value, rel=1e-9)
    if programme is ONE_WAY:
        # 2 × 5 K × 4 deg/h/K on the branch that is not seen, less what the state at the beginning leaves: √0.9.
        assert np.min(cooling) == pytest.approx(0.9**0.5 * 40.0, rel=0.02)
        assert np.max(heating) < 2.0
    else:
        assert np.max(cooling) < 2.0


def test_the_slopes_of_the_service_count():
    gyro = {"hysteresis": PLAY} | GRADIENT
    spec = required(TWO_WAY, gyro, branch="both", slope=["-1 K/min", "2 K/min"])
    states = [(1.0, 0.0), (1.0, 2.0 / 60.0), (-1.0, -1.0 / 60.0), (-1.0, 0.0)]
    (requirement,) = spec.requirement
    assert isinstance(requirement, GyroBiasRequirement)
    assert requirement.service() == tuple(states)
    expected = np.max([deviations(spec, *state) for state in states], axis=0)
    assert left(spec) == pytest.approx(np.max(expected), rel=1e-9)
    # A figure that is not estimated counts in proportion to the fastest slope.
    known = required(TWO_WAY, KNOWN_GRADIENT, slope=["-1 K/min", "2 K/min"])
    rough = required(
        TWO_WAY, {"bias_temperature_gradient": "5 deg/h/(K/min)"}, slope=["-1 K/min", "2 K/min"], statistic="max"
    )
    standing = required(TWO_WAY, {"bias_temperature_gradient": "5 deg/h/(K/min)"}, statistic="max")
    assert left(known) == pytest.approx(np.max(deviations(known, 0.0)), rel=1e-9)
    assert left(rough) ** 2 - left(standing) ** 2 == pytest.approx(10.0**2, rel=1e-9)


def test_a_branch_counts_the_hysteresis_of_the_class_where_the_spec_names_none():
    silent, asked = (required(ONE_WAY, KNOWN_GRADIENT, **more) for more in ({}, {"branch": "both"}))
    (before,), (after,) = (gj.predict(spec).requirements for spec in (silent, asked))
    assert before.with_typical is None
    assert after.decisive == pytest.approx(before.decisive, rel=1e-12)
    # Tactical: 10 K × 0.3 deg/h/K, twice on the branch that is not seen.
    assert after.with_typical == pytest.approx(0.9**0.5 * 6.0, rel=0.03)
    assert [t.key for t in gj.predict(asked).omitted] == ["sensor.gyro.hysteresis"]
    zero = required(ONE_WAY, KNOWN_GRADIENT | {"hysteresis": []}, branch="both")
    (row,) = gj.predict(zero).requirements
    assert row.with_typical is None
    note, *_ = omitted_lines(silent)
    assert "(in this class ±3 deg/h of the gyro bias) is not counted" in note
    assert omitted_lines(zero) == attitude_sentences(zero)


def test_slopes_that_a_branch_does_not_have_are_refused():
    with pytest.raises(SpecError, match="contains no heating"):
        required(TWO_WAY, {}, branch="heating", slope=["-2 K/min", "-1 K/min"])
    with pytest.raises(SpecError, match=r"expected \[lowest, highest\]"):
        required(TWO_WAY, {}, slope=["2 K/min", "-1 K/min"])
