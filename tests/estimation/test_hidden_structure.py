"""Raw samples of units whose maps have more structure than the spec believes, through the whole of `estimate`."""

import numpy as np
import pytest
from logs_zoo import spec_of
from simulated_log import simulate_log

from gradcal_jax.estimation.estimate import estimate_log, estimate_rows
from gradcal_jax.model.build import assemble
from gradcal_jax.spec.changes import changed
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import to_toml

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
    model = assemble(higher).model
    where = model.where("scale_factor")
    pairs = [(i, j) for i in range(degrees[0] + 3) for j in range(degrees[1] + 3)]
    beyond = np.array([i > degrees[0] or j > degrees[1] for i, j in pairs])
    rng = np.random.default_rng(4)
    truth = np.zeros((UNITS, model.size))
    truth[:, where] = np.where(beyond, hidden_ppm, 500.0) * PPM * rng.standard_normal((UNITS, len(pairs)))
    return simulate_log(higher, units=UNITS, sample_rate_hz=20.0, seed=9, truth={"x": truth}).log


@pytest.mark.long
def test_structure_is_noticed_measured_and_written_for_the_spec(spec):
    size = 500.0
    report = estimate_log(spec, [logs_of(spec, size)])
    tests = [t for one in report.sensors for _, t in one.structure if t.quantity == "scale_factor"]
    assert len(tests) == UNITS
    assert all(t.noticed and t.asked is not None for t in tests)
    assert not report.as_wished
    assert any("fits significantly better" in m for m in report.messages["simulated-1"])
    (result,) = [r for r in report.discrepancies if r.quantity == "scale_factor"]
    assert result.units == UNITS
    assert result.low < size < result.high
    assert 0.5 * size < result.standard_deviation < 2.0 * size
    # The block goes into the spec as it is.
    section, line = result.block.splitlines()
    imu = spec
    text = to_toml(imu)
    assert section in text
    again = parse_spec(text.replace(section, f"{section}\n{line}", 1))
    assert float(again.sensor.gyro.scale_factor.discrepancy.standard_deviation) / PPM == pytest.approx(
        result.standard_deviation, rel=0.01
    )
    rows = estimate_rows(report)
    assert rows["discrepancies"][0]["unit"] in ("ppm", "deg/h")
    assert rows["units"][0]["structure"][-1]["noticed"] is True
    # A spec that has the discrepancy is tested against its own structure alone: the prior does not hide it.
    known = estimate_log(again, [logs_of(spec, size)])
    for one, other in zip(report.sensors, known.sensors, strict=True):
        assert other.structure[-1][1].test.statistic == pytest.approx(one.structure[-1][1].test.statistic, rel=0.02)


@pytest.mark.long
def test_where_nothing_is_hidden_nothing_is_noticed(spec):
    report = estimate_log(spec, [logs_of(spec, 0.0)])
    tests = [t for one in report.sensors for _, t in one.structure if t.quantity == "scale_factor"]
    assert not any(t.noticed for t in tests)
    (result,) = [r for r in report.discrepancies if r.quantity == "scale_factor"]
    assert result.low == 0.0
