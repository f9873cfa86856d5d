"""Raw samples of units whose maps have more structure than the spec believes, through the whole of `estimate`."""

import numpy as np
import pytest
from logs_zoo import spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation.estimate import estimate_log
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.changes import changed

PPM = 1e-6
UNITS = 6


@pytest.fixture(scope="module")
def spec():
    return spec_of()


def logs_of(spec, hidden_ppm: float):
    """Maps two degrees higher than the spec's in temperature and in rate; its own functions as large as ever."""
    own = spec.sensor.gyro.scale_factor
    degrees = own.temperature.degree, own.rate.degree
    higher = changed(
        spec,
        {
            "sensor.gyro.scale_factor.temperature.degree": degrees[0] + 2,
            "sensor.gyro.scale_factor.rate.degree": degrees[1] + 2,
        },
    )
    (model,) = build_imu(higher).model.channels
    where = model.where("scale_factor")
    pairs = [(i, j) for i in range(degrees[0] + 3) for j in range(degrees[1] + 3)]
    beyond = np.array([i > degrees[0] or j > degrees[1] for i, j in pairs])
    rng = np.random.default_rng(4)
    truth = np.zeros((UNITS, model.size))
    truth[:, where] = np.where(beyond, hidden_ppm, 500.0) * PPM * rng.standard_normal((UNITS, len(pairs)))
    return simulate_log(higher, units=UNITS, sample_rate_hz=20.0, seed=9, truth={"x": truth}).log


def failed_of_scale_factor(report) -> list[bool]:
    return ["gyro_x: structure of the scale factor" in one.calibration.contradicted for one in report.sensors]


@pytest.mark.long
def test_structure_is_noticed_unless_the_spec_states_it(spec):
    size = 500.0
    report = estimate_log(spec, [logs_of(spec, size)])
    assert failed_of_scale_factor(report) == [True] * UNITS
    assert not report.as_wished
    assert any("raise the degree of its polynomial" in m for m in report.messages["simulated-1"])
    degrees = {"temperature_degree": 5, "rate_degree": 5}
    stated = changed(spec, {"sensor.gyro.scale_factor.discrepancy": {"standard_deviation": f"{size} ppm", **degrees}})
    assert not any(failed_of_scale_factor(estimate_log(stated, [logs_of(spec, size)])))


@pytest.mark.long
def test_where_nothing_is_hidden_nothing_is_noticed(spec):
    assert not any(failed_of_scale_factor(estimate_log(spec, [logs_of(spec, 0.0)])))
