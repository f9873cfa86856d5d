"""Many simulated units with loops over the temperature by other laws than the plays that estimate them.

Three gyros stand on a table while the chamber goes up and down, or up alone in the same time. Their loops are Preisach
relays or the difference of two thermal masses (`loop_laws`), drawn with the size that the spec names. For
relays the estimator has plays of 6, 14 and 24 K, with priors and a discrepancy that are what 60 other loops of the law
say without noise (`loop_scene.type_of_relays`), and coefficients that vary over temperature by what 80 other simulated
units need (`VARIATION`: 0.94 and 1.12 of what is predicted is reached by two lots of 40). For masses it has dT/dt late
by 1 and 10 min, which are the time constants of the type, and those of each unit differ from them by up to 10 %, with a
discrepancy that 300 other units chose. `PLAYS_ALONE` has constant coefficients of plays of 3, 10 and 30 K. All have
dT/dt and 1 deg/h of structure that the sensors have beyond their maps.

What counts is the error on both branches, against the law itself on legs of the same slope. `LOOP_UNITS` of the
environment: how many units of each law.
"""

import os
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_laws import LAWS, Law, draw_with_loops
from loop_scene import SIZE, errors_on_branches, recorded, spec_of, type_of_relays

from gradcal_jax.estimation.estimate import estimate_sensors
from gradcal_jax.information.prediction import predict
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec_sections import Spec

pytestmark = pytest.mark.evidence

UNITS = int(os.environ.get("LOOP_UNITS", "150"))
# deg/h: structure of the sensors beyond the maps of the spec (`loop_scene`), and what is left of loops by other terms
# than plays that vary.
TEN, HIDDEN, LEFT_BY_OTHERS = 10, 1.0, 1.5
PLAYS_ALONE = "relays, plays with constant coefficients"
CASES = (*LAWS, PLAYS_ALONE)
# By how much coefficients of plays of relays vary over temperature, deg/h at the width of each.
VARIATION, DEGREE = (0.5, 0.8, 0.8), 10
REPORT = Path(__file__).parents[2] / "experiments" / "evidence" / "loops.md"


def estimator_of(case: str, *, ways: int) -> Spec:
    """The spec of the estimate."""
    spec, left = spec_of(ways=ways, late=case == "thermal masses"), LEFT_BY_OTHERS
    if case == "relays":
        of_width, left = type_of_relays()
        plays: list[dict[str, Any]] = [
            {
                "width": f"{width} K", "prior": f"{size} deg/h/K",
                "over_temperature": {
                    "standard_deviation": f"{varies / width} deg/h/K", "degree": DEGREE,
                    "centre": "20 degC", "scale": "40 K",
                },
            }
            for (width, size), varies in zip(of_width.items(), VARIATION, strict=True)
        ]  # fmt: skip
        spec = changed(spec, {"sensor.gyro.hysteresis": plays})
    return changed(spec, {"sensor.gyro.bias.discrepancy.standard_deviation": f"{np.hypot(HIDDEN, left):.3f} deg/h"})


@lru_cache
def runs(case: str, *, ways: int, units: int = UNITS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors and predicted deviations of many units, `(units, 2, n, 3)`, and whether a test of the fit contradicts."""
    law: Law = "thermal masses" if case == "thermal masses" else "relays"
    spec, drawn = estimator_of(case, ways=ways), spec_of(ways=ways)
    results = []
    for number in range(units):
        truth = draw_with_loops(drawn, 37, number, law)
        (report,) = estimate_sensors(spec, [recorded(truth, spec, ways=ways, seed=5000 + number)])
        results.append((*errors_on_branches(report, truth), np.array(bool(report.calibration.contradicted))))
    errors, stds, contradicted = (np.stack(of) for of in zip(*results, strict=True))
    return errors, stds, contradicted


def rms(values: np.ndarray, axis=None) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=axis))


def gains(law: str) -> np.ndarray:
    """`(TEN,)`: the error of a one-way plan of equal time over that of a two-way plan, root mean squares over both
    branches and three gyros."""
    two, one = runs(law, ways=2)[0][:TEN], runs(law, ways=1, units=TEN)[0]
    return rms(one, axis=(1, 2, 3)) / rms(two, axis=(1, 2, 3))


@lru_cache
def without_a_loop() -> float:
    """The two-way plan over the one-way plan by the prediction, which is exact there: no loop and no sensitivity to
    dT/dt, in the unit and in its spec."""
    left = {}
    for ways in (2, 1):
        spec = spec_of(ways=ways, plays=False)
        spec = changed(spec, {"sensor.gyro.bias_temperature_gradient": "0 deg/h/(K/min)", "sensor.gyro.hysteresis": []})
        left[ways] = predict(spec).requirements[0].decisive
    return left[2] / left[1]


@pytest.mark.parametrize("law", LAWS)
def test_what_is_predicted_is_achieved_with_loops_of_other_laws(law, record_property):
    """Achieved over predicted within 10 %, and the mean of squared standardised errors of a unit within three of its
    own standard errors of one."""
    errors, stds, _ = runs(law, ways=2)
    ratio, of_unit = float(rms(errors) / rms(stds)), np.mean((errors / stds) ** 2, axis=(1, 2, 3))
    record_property("achieved over predicted", round(ratio, 3))
    record_property("mean of squared standardised errors", round(float(np.mean(of_unit)), 3))
    assert np.mean(np.abs(errors) < 2.0 * stds) > 0.9
    assert ratio == pytest.approx(1.0, abs=0.1)
    assert abs(np.mean(of_unit) - 1.0) < 3.0 * np.std(of_unit) / np.sqrt(len(of_unit))


@pytest.mark.parametrize("law", LAWS)
def test_two_ways_beat_one_way_on_every_sensor_with_a_loop(law):
    assert np.all(gains(law) > 1.0)


def test_few_fits_are_contradicted_where_a_coefficient_varies():
    """Those of the largest loops: a prior states the size of the type, and what is left is in proportion to that of the
    unit."""
    assert np.mean(runs("relays", ways=2)[2]) < 0.25
    assert np.mean(runs(PLAYS_ALONE, ways=2)[2]) > 2.0 * np.mean(runs("relays", ways=2)[2])


def test_two_ways_lose_little_on_sensors_without_a_loop():
    assert without_a_loop() < 1.1


def test_the_report():
    """Of the same runs."""
    rows = []
    for law in CASES:
        errors, stds, contradicted = runs(law, ways=2)
        of_unit, gain = np.mean((errors / stds) ** 2, axis=(1, 2, 3)), gains(law)
        band = 3.0 * np.std(of_unit) / np.sqrt(len(of_unit))
        rows.append(
            f"| {law} | {len(errors)} | {rms(stds):.2f} | {rms(errors) / rms(stds):.3f} | {np.mean(of_unit):.2f} "
            f"(1 ± {band:.2f}) | {np.mean(np.abs(errors) < 2.0 * stds):.1%} | {np.mean(contradicted):.0%} | "
            f"{np.min(gain):.1f} … {np.max(gain):.1f} |"
        )
    text = "\n".join([
        "# Loops over the temperature by other laws", "",
        f"Made by `LOOP_UNITS={UNITS} pytest -m evidence tests/evidence/test_loops.py`: simulated IMUs of three gyros",
        f"with loops of {SIZE:g} deg/h, by the laws and with the estimators that the head of that file states.",
        "Predicted: root mean square over both branches, deg/h. NEES: mean of squared standardised errors, with three",
        "standard errors of it. Not valid: a test of the fit contradicts the model. Gain: error of a one-way plan of",
        f"equal time over that of the two-way plan, of {TEN} IMUs each.", "",
        "| law | IMUs | predicted | achieved/predicted | NEES | within 2 σ | not valid | gain |",
        "|---|---|---|---|---|---|---|---|", *rows, "",
        f"Without a loop the two-way plan leaves {without_a_loop():.3f} times what the one-way plan leaves.", "",
        time.strftime("%Y-%m-%d"), "",
    ])  # fmt: skip
    REPORT.write_text(text, encoding="utf-8")
    assert len(rows) == len(CASES)
