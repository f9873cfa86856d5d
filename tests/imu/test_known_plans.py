"""Two whole plans against an independent prototype: all standard deviations, statistics, and navigation."""

import json
import re
from functools import cache
from pathlib import Path

import pytest
from imu_helpers import ARCSEC, DEG_PER_H, G, shipped

from gradcal_jax.information.prediction import predict
from gradcal_jax.model.build import build_imu, imu_posterior
from gradcal_jax.spec.spec import spec_of

KNOWN = json.loads((Path(__file__).parent / "known_units.json").read_text(encoding="utf-8"))
UNIT = {
    "deg/h": DEG_PER_H,
    "ppm": 1e-6,
    "urad": 1e-6,
    "deg/h/g": DEG_PER_H / G,
    "ug": 1e-6 * G,
    "ug/g^2": 1e-6 / G,
    "arcsec": ARCSEC,
}
REQUIREMENT = {
    "gyro SF ppm (worst)": "gyro scale factor",
    "gyro bias deg/h (worst)": "gyro bias",
    "gyro misal urad rms": "gyro misalignment",
    "g-sens deg/h/g rms": "acceleration sensitivity",
    "acc bias ug (worst)": "accelerometer bias",
    "acc SF ppm (worst)": "accelerometer scale factor",
    "acc misal urad rms": "accelerometer misalignment",
    "acc K2 ug/g2 (worst)": "accelerometer second order",
}
PLANS = ("hand", "hand2")
_AXIS, _TABLE_AXIS = "xyz", ("tilt", "spin")


def our_name(theirs: str) -> str:
    """The program's name of one of the prototype's parameters."""
    if match := re.fullmatch(r"(bg|ba)(\d)_(\d)", theirs):
        kind = {"bg": "gyro", "ba": "accelerometer"}[match[1]]
        return f"{kind}_{_AXIS[int(match[2])]}.a{match[3]}"
    if match := re.fullmatch(r"sg(\d)_(\d)(\d)", theirs):
        return f"gyro_{_AXIS[int(match[1])]}.b{match[2]}{match[3]}"
    if match := re.fullmatch(r"sa(\d)_(\d)", theirs):
        return f"accelerometer_{_AXIS[int(match[1])]}.s{match[2]}"
    if match := re.fullmatch(r"m([ga])(\d)(\d)_(\d)", theirs):
        kind = {"g": "gyro", "a": "accelerometer"}[match[1]]
        return f"{kind}_{_AXIS[int(match[2])]}.m_{_AXIS[int(match[3])]}{match[4]}"
    if match := re.fullmatch(r"gs(\d)(\d)", theirs):
        return f"gyro_{_AXIS[int(match[1])]}.g_{_AXIS[int(match[2])]}"
    if match := re.fullmatch(r"k2(\d)", theirs):
        return f"accelerometer_{_AXIS[int(match[1])]}.k2"
    if match := re.fullmatch(r"h(\d)_(\d)([cs])", theirs):
        return f"angle_{_TABLE_AXIS[int(match[1])]}_{ {'c': 'cos', 's': 'sin'}[match[3]] }{match[2]}"
    return {"tau0": "tilt_east", "tau1": "tilt_north", "tau2": "azimuth", "delta0": "orthogonality_tilt_spin"}[theirs]


def family(theirs: str) -> str:
    return next(name for name in KNOWN["units"] if theirs.startswith(name))


@cache
def found(plan: str) -> dict[str, float]:
    built = build_imu(spec_of(shipped(plan)))
    values = imu_posterior(built).deviations(built.model.to_reported)
    return dict(zip(built.model.names(), values, strict=True))


@pytest.mark.parametrize("plan", PLANS)
def test_every_parameter_of_the_known_plans(plan):
    theirs, ours = KNOWN[plan]["parameters"], found(plan)
    assert len(theirs) == 132
    assert {our_name(name) for name in theirs} == set(ours)
    for name, value in theirs.items():
        unit = UNIT[KNOWN["units"][family(name)]]
        assert ours[our_name(name)] / unit == pytest.approx(value, rel=1e-6), name


@pytest.mark.parametrize("plan", PLANS)
def test_the_summary_statistics_are_eight_requirements(plan):
    prediction = predict(spec_of(shipped(plan)))
    rows = {row.name: row for row in prediction.requirements}
    assert len(rows) == len(KNOWN[plan]["summary"]) == 8
    for name, value in KNOWN[plan]["summary"].items():
        row = rows[REQUIREMENT[name]]
        decisive = row.mean_of_max if row.statistic == "mean of max" else row.mean
        assert decisive == pytest.approx(value, rel=1e-5), name
    assert prediction.warnings == ()
    # What a prediction reports is the calibration's own part of the same figures.
    ours = found(plan)
    assert len(prediction.parameters) == 120
    for parameter in prediction.parameters:
        assert parameter.std == pytest.approx(ours[parameter.name], rel=1e-9)
