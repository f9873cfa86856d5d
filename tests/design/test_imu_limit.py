"""Limits of the gyros of IMUs: known figures and closed forms."""

import pytest

import gradcal_jax as gj
from gradcal_jax.design import plan_limit
from gradcal_jax.spec.spec import read_spec

SPECS = ["hand2", *(pytest.param(name, marks=pytest.mark.evidence) for name in ("hand", "optimised"))]


@pytest.fixture(scope="module", params=SPECS)
def rows(request, pytestconfig):
    found = gj.limit(read_spec(pytestconfig.rootpath / f"experiments/imu/{request.param}.toml"))
    return {row.name: row for row in found}


@pytest.mark.long
def test_no_plan_lies_below_its_limit_and_biases_stand_at_it(rows):
    assert set(rows) == {"gyro bias", "gyro scale factor"}
    for row in rows.values():
        assert row.certified > 0.0
        assert row.certified < row.value
        assert row.efficiency == pytest.approx(row.certified / row.value)
        assert len(row.relaxed) == 3
    assert rows["gyro bias"].efficiency > 0.9
    # Of an independent prototype; the plan does not matter to it, only its time and temperatures.
    assert f"{rows['gyro bias'].certified:.3f}" == "0.437"


def test_a_limit_is_for_the_temperature_of_a_sensor_that_lags(pytestconfig):
    spec = read_spec(pytestconfig.rootpath / "experiments/imu/hand2.toml")
    data = plan_limit._PlanData(gj.changed(spec, {"sensor.thermal_lag": "200 s"}))
    line = data.built.motion.line
    assert data.temperature(line.start) == pytest.approx(line.ends()[0], abs=1e-9)


def test_what_has_no_proof_is_refused_with_what_has_one(pytestconfig):
    spec = read_spec(pytestconfig.rootpath / "experiments/imu/hand.toml")
    of = {"name": "m", "quantity": "gyro_misalignment", "relative_to": "internal", "temperature": ["0 degC", "1 degC"]}
    with pytest.raises(ValueError, match="proven for the biases and polynomial scale factors of gyros"):
        plan_limit.limit(gj.changed(spec, {"requirement": [of]}))


ONE_AXIS = """
[rig.chamber]
range       = ["-40 degC", "85 degC"]
max_heating = "2 K/min"
max_cooling = "1.5 K/min"
[[requirement]]
name        = "full range"
quantity    = "gyro_scale_factor"
temperature = ["-30 degC", "70 degC"]
rate        = ["-300 deg/s", "300 deg/s"]
statistic   = "max"
[[requirement]]
name        = "bias"
quantity    = "gyro_bias"
temperature = ["-30 degC", "70 degC"]
statistic   = "max"
[plan]
method      = "gradient"
temperature = ["-30 degC", "70 degC"]
gradient    = "1 K/min"
[plan.cycle]
moves = [
  {{ rest = "10 s" }},
  {{ turn = "360 deg", peak_rate = "150 deg/s", duration = "3.03 s", shape = "cosine ramps" }},
  {{ rest = "80 s" }},
  {{ turn = "-360 deg", peak_rate = "300 deg/s", duration = "1.52 s", shape = "cosine ramps" }},
  {{ rest = "240 s" }},
]
"""
MAPS = """
bias = { temperature = { degree = 1, centre = "20 degC", scale = "50 K" }, prior = "500 deg/h" }
[sensor.gyro.scale_factor]
temperature = { degree = 1, centre = "20 degC", scale = "50 K" }
rate        = { degree = 1, scale = "300 deg/s" }
prior       = "10000 ppm"
"""
GYRO = """angle_random_walk = "0.1 deg/sqrt(h)"
drift = [{ standard_deviation = "1 deg/h", correlation_time = "120 s" }]
"""
UNSTEADY = 'scale_factor_instability = [{ standard_deviation = "3 ppm", correlation_time = "20 min" }]\n'
WHITE_ALONE_PPM = 0.2028
UNIT = """format = "gradcal-spec/1"
[sensor]
{clock}[sensor.gyro]
axes = ["z"]
{gyro}{maps}
[rig.site]
latitude = "0 deg"
[rig.table]
standing = "read"
[[rig.table.axis]]
name = "turn"
direction = [0.0, 0.0, 1.0]
max_rate = "300 deg/s"
max_acceleration = "1500 deg/s^2"
angle = {{ reading_noise = "0.05 deg", standstill_offset = "0.01 deg", read_every = "1 s" }}
"""


@pytest.mark.long
@pytest.mark.parametrize(("clock", "gyro"), [("", GYRO), ('sample_clock_error = "2 ppm"\n', GYRO + UNSTEADY)])
def test_drift_and_readings_count_in_the_limit_of_one_gyro(clock, gyro):
    """The cycles leave 6 s of the ramp, which are data too."""
    found = gj.limit(gj.parse_spec((UNIT + ONE_AXIS).format(clock=clock, gyro=gyro, maps=MAPS)))
    assert [row.name for row in found] == ["full range", "bias"]
    assert all(0.0 < row.certified < row.value for row in found)
    assert found[0].certified > 1.4 * WHITE_ALONE_PPM
