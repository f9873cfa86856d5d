"""Many simulated units with loops over the temperature by other laws than the plays that estimate them.

Three gyros stand on a table while the chamber goes up and down, or up alone in the same time. Their loops are Preisach
relays or the difference of two thermal masses (`hardware.simulate.loops`), drawn with the size that the spec names; the
estimator has plays of 3, 10 and 30 K, dT/dt, and a discrepancy. What counts is the error on both branches, against the
law itself on legs of the same slope.
"""

from functools import lru_cache

import numpy as np
import pytest
from loop_scene import SIZE, recorded, spec_of

from gradcal_jax.api import predict
from gradcal_jax.api.estimate import SensorEstimate, estimate_sensors
from gradcal_jax.api.imu_residual import quantity_of
from gradcal_jax.files.changes import changed
from gradcal_jax.hardware.simulate.draws import draw_truth
from gradcal_jax.hardware.simulate.imu import ImuTruth
from gradcal_jax.hardware.simulate.loops import LAWS, Law

pytestmark = pytest.mark.evidence

HOUR = np.pi / 180.0 / 3600.0
UNITS = 150
# The legs of the service, which are long.
COLDEST, WARMEST = -60.0, 110.0
AT = np.linspace(0.0, 45.0, 10)


def on_branches(truth: ImuTruth) -> np.ndarray:
    """`(2, n, 3)`: the true bias at `AT` on a heating and on a cooling leg at 2 K/min, rad/s."""
    triad = truth.triads["gyro"]
    (bias,) = (error for error in triad.errors if getattr(error, "factors", "") == "one")
    none = np.zeros((len(AT), 3))
    both, course = [], np.arange(COLDEST, WARMEST, 2.0 / 60.0)
    loops = [loop.begin(COLDEST) for loop in triad.loops]
    for sign, leg in ((1.0, course), (-1.0, course[::-1]), (1.0, course)):
        values = sum((loop.take(leg, 1.0) for loop in loops), np.zeros((len(leg), 3)))
        order = np.argsort(leg)
        path = np.stack([np.interp(AT, leg[order], values[order, k]) for k in range(3)], axis=1)
        slope = sign * np.array(triad.gradient) * 2.0 / 60.0
        both.append(bias(none, none, AT) + path + slope)  # pyright: ignore[reportCallIssue]
    return np.stack([both[2], both[1]])


def apart(report: SensorEstimate, truth: ImuTruth) -> tuple[np.ndarray, np.ndarray]:
    """Error of the estimate on both branches, and its predicted standard deviation, `(2, n, 3)`, deg/h."""
    built, solution = report.built, report.solution
    true, errors, stds = on_branches(truth), np.zeros((2, len(AT), 3)), np.zeros((2, len(AT), 3))
    for branch, requirement in enumerate(built.spec.requirement):
        for k, element in enumerate(quantity_of(built, requirement).elements):
            assert element.path is not None
            at_rest = element.contrasts()
            # The discrepancy is estimated and is no part of a calibration.
            rows = np.asarray(at_rest.rows) - np.asarray(at_rest.alone) + element.path[0]
            errors[branch, :, k] = rows @ solution.parameters[element.where] - true[branch, :, k]
            stds[branch, :, k] = element.deviations(solution.known)
    return errors / HOUR, stds / HOUR


@lru_cache
def runs(law: Law | None, *, back: bool, size: float = SIZE, plays: bool = True, units: int = UNITS):
    """Errors and predicted deviations of many units, `(units, 2, n, 3)`. Without a `law` there is no loop."""
    spec, results = spec_of(back=back, size=size, plays=plays), []
    drawn = spec_of(back=back, size=size if law else 1e-6)
    for number in range(units):
        truth = draw_truth(drawn, 36, number, law)
        (report,) = estimate_sensors(spec, [recorded(truth, spec, back=back, seed=1000 + number)])
        results.append(apart(report, truth))
    return tuple(np.stack(of) for of in zip(*results, strict=True))


def rms(values: np.ndarray, axis=None) -> np.ndarray:
    return np.sqrt(np.mean(values**2, axis=axis))


def test_what_is_predicted_is_achieved_with_loops_of_other_laws(record_property):
    """300 units. The discrepancy is sized for relays; of two thermal masses it is more than is needed."""
    ratios = {}
    for law in LAWS:
        errors, stds = runs(law, back=True)
        ratios[law] = float(rms(errors) / rms(stds))
        record_property(f"{law}: achieved over predicted", round(ratios[law], 3))
        record_property(f"{law}: mean of squared standardised errors", round(float(np.mean((errors / stds) ** 2)), 3))
        record_property(f"{law}: within two deviations", round(float(np.mean(np.abs(errors) < 2.0 * stds)), 3))
        assert np.mean(np.abs(errors) < 2.0 * stds) > 0.9, law
    assert ratios["relays"] == pytest.approx(1.0, abs=0.1)
    assert 0.6 < ratios["thermal masses"] < 1.1


@pytest.mark.parametrize("law", LAWS)
def test_two_ways_beat_one_way_on_every_sensor_with_a_loop(law, record_property):
    """Ten units, each error the root mean square over both branches and three gyros."""
    two, one = (rms(runs(law, back=back, units=10)[0], axis=(1, 2, 3)) for back in (True, False))
    record_property("least gain", round(float(np.min(one / two)), 2))
    assert np.all(two < one)


def test_two_ways_lose_little_on_sensors_without_a_loop(record_property):
    """By the prediction, which is exact there: no loop and no sensitivity to dT/dt, in the unit and in its spec."""
    left = {}
    for back in (True, False):
        spec = spec_of(back=back, plays=False)
        spec = changed(spec, {"sensor.gyro.bias_temperature_gradient": "0 deg/h/(K/min)", "sensor.gyro.hysteresis": []})
        left[back] = predict(spec).requirements[0].decisive
    record_property("two ways over one way", round(left[True] / left[False], 3))
    assert left[True] < 1.1 * left[False]
