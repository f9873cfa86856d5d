"""What a spec leaves out, and what no residual shows, counts: in predictions, estimates, verdicts and calibrations."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import dense_of
from simulated_log import simulate_log

import gradcal_jax as gj
from gradcal_jax.estimation.calibrations import calibration_map
from gradcal_jax.estimation.estimate import estimate_log
from gradcal_jax.estimation.findings import omitted_sentences, wrapped_sentence
from gradcal_jax.estimation.log_rows import Options
from gradcal_jax.information import imu_system, segments_of
from gradcal_jax.information.plan_information import imu_posterior
from gradcal_jax.information.residual import residual_of
from gradcal_jax.model.build import build_imu
from gradcal_jax.motion import turns_of
from gradcal_jax.records.log import LogError
from gradcal_jax.spec.absent import absent_terms, with_typical
from gradcal_jax.spec.changes import tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.spec.typical import slopes_of

SPEC = """
format = "gradcal-spec/1"
[sensor.gyro]
axes = ["x"]
angle_random_walk = "0.1 deg/sqrt(h)"
drift = [{ standard_deviation = "1 deg/h", correlation_time = "120 s" }]
[sensor.gyro.bias]
temperature = { degree = 1, centre = "20 degC", scale = "50 K" }
prior = "400 deg/h"
[sensor.gyro.scale_factor]
temperature = { degree = 1, centre = "20 degC", scale = "50 K" }
rate = { degree = 0, scale = "200 deg/s" }
prior = "3000 ppm"
[rig.table]
standing = "read"
mounting = { x = "+z", y = "+x", z = "+y" }
[[rig.table.axis]]
name = "x"
direction = [0.0, 0.0, 1.0]
max_rate = "300 deg/s"
max_acceleration = "300 deg/s^2"
[rig.table.axis.angle]
reading_noise = "0.002 deg"
standstill_offset = "0.004 deg"
read_every = "1 s"
[rig.chamber]
range = ["-40 degC", "85 degC"]
max_heating = "5 K/min"
max_cooling = "5 K/min"
[[requirement]]
name = "M"
quantity = "gyro_scale_factor"
axis = "x"
temperature = ["-20 degC", "60 degC"]
rate = ["-200 deg/s", "200 deg/s"]
grid = [5, 5]
target = "100 ppm"
[[requirement]]
name = "B"
quantity = "gyro_bias"
axis = "x"
temperature = ["-20 degC", "60 degC"]
grid = [5]
target = "10 deg/h"
[plan]
method = "gradient"
temperature = ["-20 degC", "60 degC"]
gradient = "4 K/min"
[plan.cycle]
moves = [
  { rest = "10 s", read_every = "1 s" }, { turn = "1440 deg", peak_rate = "200 deg/s", shape = "cosine ramps" },
  { rest = "10 s", read_every = "1 s" }, { turn = "-1440 deg", peak_rate = "200 deg/s", shape = "cosine ramps" },
]
"""
ZEROS = {
    "sensor.gyro.rate_random_walk": "0 deg/h/sqrt(h)",
    "sensor.gyro.turn_on_bias": "0 deg/h",
    "sensor.thermal_lag": "0 s",
    "sensor.sample_clock_error": "0 ppm",
    "sensor.gyro.scale_factor_instability": [],
    "sensor.gyro.temperature_error": {"standard_deviation": "0 K"},
    "sensor.gyro.bias_temperature_gradient": {"prior": "0 deg/h/(K/min)"},
    "sensor.temperature_offset": "0 K",
    "sensor.temperature_lag": "0 s",
    "rig.table.mounting[0].accuracy": "0 deg",
    "rig.table.axis[0].angle.harmonics": [],
    "rig.table.axis[0].angle.scale_error": "0 ppm",
    "rig.site.latitude": "0 deg",
}
BARE = gj.parse_spec(SPEC)
EXACT = gj.changed(BARE, ZEROS)
DEG_PER_H = np.pi / 180.0 / 3600.0


def left(spec, name):
    return next(row for row in gj.predict(spec).requirements if row.name == name)


def without(*keys):
    """The exact spec less some of its zeros."""
    return gj.changed(EXACT, dict.fromkeys(keys))


@pytest.fixture(scope="module")
def recorded():
    """A log of the exact spec's plan; its truth is known."""
    made = simulate_log(EXACT, sample_rate_hz=25.0, seed=3)
    return made.log, made.truth["x"][0]


def estimated(spec, log, **options):
    report = estimate_log(spec, [log], options=Options(**options))
    return report, {row.name: row for row in report.verdicts[log.units[0]]}


# --- predictions ------------------------------------------------------------------------------------------------------


def test_explicit_zeros_are_the_same_model_and_nothing_is_omitted():
    assert absent_terms(EXACT) == []
    bare, exact = gj.predict(BARE), gj.predict(EXACT)
    np.testing.assert_allclose(bare.covariance, exact.covariance, rtol=1e-12)
    for a, b in zip(bare.requirements, exact.requirements, strict=True):
        assert a.decisive == pytest.approx(b.decisive, rel=1e-12)
        assert b.with_typical is None
        assert b.judged == b.decisive
        assert (a.verdict, b.verdict) == ("missed", "met")
        assert a.with_typical > 5.0 * a.decisive
    assert {t.key for t in bare.omitted} == set(ZEROS)


@pytest.mark.parametrize(
    ("key", "name", "size"),
    [
        ("rig.table.mounting[0].accuracy", "M", 2**0.5 * np.radians(0.5) ** 2 * 1e6),
        ("rig.table.axis[0].angle.scale_error", "M", 50.0),
        ("sensor.temperature_offset", "M", 2.0 * slopes_of(BARE.sensor)[1] * 1e6),
        ("sensor.gyro.bias_temperature_gradient", "B", 40.0),
        ("rig.site.latitude", "B", 15.04 / 3**0.5),
    ],
)
def test_a_term_that_is_left_out_counts_with_its_figure(key, name, size):
    """In quadrature, beside what the spec names: each is a constant of a map."""
    row = left(without(key), name)
    # Constant over the box, so that every statistic of the residual is at most this and at least the larger of the two.
    assert row.with_typical == pytest.approx(np.hypot(row.decisive, size), rel=0.08)
    # The prior of 400 deg/h on the bias takes half a per cent off a sensitivity of 40.
    assert row.with_typical > size * (1.0 - 1e-2)
    assert row.decisive == pytest.approx(left(EXACT, name).decisive, rel=1e-12)


QUICK = gj.changed(
    EXACT,
    {
        "rig.chamber": {"range": ["-40 degC", "85 degC"], "max_heating": "40 K/min", "max_cooling": "40 K/min"},
        "rig.table.axis[0].angle.read_every": "5 s",
        **{f"plan.cycle.moves[{k}].read_every": "5 s" for k in (0, 2)},
        "plan.gradient": "30 K/min",
    },
)
RETURN = {
    "plan.temperature": None,
    "plan.gradient": None,
    "plan.programme": [
        {"soak": "1 s", "at": "-20 degC"},
        {"ramp_to": "60 degC", "rate": "30 K/min"},
        {"ramp_to": "-20 degC", "rate": "30 K/min"},
    ],
}


@pytest.mark.parametrize("course", [{}, RETURN], ids=["one way", "there and back"])
@pytest.mark.parametrize(
    ("key", "figure", "gradient", "lag"),
    [
        ("sensor.gyro.bias_temperature_gradient", "9 deg/h/(K/min)", 9.0 * DEG_PER_H * 60.0, 0.0),
        ("sensor.temperature_lag", "40 s", 0.0, 40.0),
    ],
)
def test_a_lag_and_a_gradient_count_by_what_they_leave_in_the_estimate_of_this_plan(course, key, figure, gradient, lag):
    """Against dense least squares on readings that have the error, integrated by hand; on a way there and back most of
    it cancels."""
    spec = gj.changed(QUICK, course)
    built, named = build_imu(spec), gj.changed(spec, {key: figure})
    steps, columns = imu_system(built.motion, built.model, built.body_nodes())
    at, line, (begin, end) = segments_of(built.motion, built.model), built.motion.line, built.motion.line.ends()
    by_bias, by_scale = slopes_of(spec.sensor)
    # A temperature that is late by one lag is lower by lag · dT/dt.
    pieces = (gradient - lag * by_bias) * (end - begin) - lag * by_scale * line.slope * line.turned()
    error = np.add.reduceat(pieces, at.first)[at.row_segment][np.asarray(steps.used)]
    rows = np.asarray(columns)[np.asarray(steps.used)]
    weighed = np.linalg.solve(dense_of(steps), np.column_stack([rows, error]))
    prior = built.model.prior_rows()
    shift = np.linalg.solve(rows.T @ weighed[:, :-1] + prior.T @ prior, rows.T @ weighed[:, -1])
    ours, plain = (gj.predict(s).requirements for s in (named, spec))
    for row, without_it, requirement in zip(ours, plain, spec.requirement, strict=True):
        quantity = residual_of(built, requirement)
        (element,) = quantity.elements
        exact = quantity.map(imu_posterior(built)).values.ravel()
        unit = 1e6 if requirement.name == "M" else 1.0 / DEG_PER_H
        wanted = np.hypot(exact, element.rows[0] @ shift[element.where] * unit)
        assert row.max == pytest.approx(np.max(wanted), rel=1e-6)
        if requirement.name == "B":
            whole = (gradient + lag * by_bias) * 0.5 / DEG_PER_H
            share = (row.max**2 - without_it.max**2) ** 0.5
            assert share < 0.3 * whole if course else share > 0.8 * whole


def test_backlash_counts_as_the_turns_that_it_shortens():
    """Every turn of 1440 deg but the first reverses the one before. Where a spec states the scale error of a gear and
    not its backlash, a typical one counts; the typical scale error of a gear is that of its backlash, too."""
    exact, turn = left(EXACT, "M").decisive, 1440.0
    named = left(gj.changed(EXACT, {"rig.table.axis[0].angle.backlash": "0.05 deg"}), "M")
    assert named.decisive == pytest.approx(np.hypot(exact, 0.05 / turn * 1e6), rel=0.05)
    assert named.with_typical is None
    geared = gj.changed(EXACT, {"rig.table.axis[0].angle.scale_error": "1 ppm"})
    assert [term.key for term in absent_terms(geared)] == ["rig.table.axis[0].angle.backlash"]
    assert left(geared, "M").with_typical == pytest.approx(np.hypot(exact, 0.01 / turn * 1e6), rel=0.05)
    assert not [t for t in absent_terms(without("rig.table.axis[0].angle.scale_error")) if "backlash" in t.key]
    assert absent_terms(with_typical(without("rig.table.axis[0].angle.scale_error"))) == []
    # A turn that is read on the move is many pieces, the first of them small.
    read = gj.changed(geared, {f"plan.cycle.moves[{k}].read_every": "0.01 s" for k in (1, 3)})
    turns = turns_of(build_imu(read).motion)
    np.testing.assert_allclose(np.degrees(turns.size), turn)
    np.testing.assert_allclose(turns.lost * turns.size, np.arange(len(turns.size)) > 0)
    moves = [
        move for move in tables_of(geared)["plan"]["cycle"]["moves"] if not str(move.get("turn", "")).startswith("-")
    ]
    one_way = gj.changed(geared, {"plan.cycle.moves": moves})
    assert left(one_way, "M").with_typical == pytest.approx(left(one_way, "M").decisive, rel=1e-3)


def test_another_power_on_is_a_line_of_its_own_and_decides():
    named = gj.changed(EXACT, {"sensor.gyro.turn_on_bias": "360 deg/h"})
    row = left(named, "B")
    assert (row.verdict, row.another_run) == ("missed", pytest.approx(360.0, rel=0.01))
    assert row.decisive < 10.0
    this = left(gj.changed(named, {"requirement[1].of": "this run"}), "B")
    assert (this.verdict, this.another_run) == ("met", None)
    assert left(named, "M").another_run is None


def test_without_a_key_the_better_clock_counts():
    """A run compares both. What a log without the computer's time gives is predicted by clock = "sensor"."""
    slow, good = (gj.changed(EXACT, {"sensor.sample_clock_error": size}) for size in ("200 ppm", "0.3 ppm"))
    for spec, same in ((slow, {"sensor.clock": "host"}), (good, {"sensor.clock": "sensor"})):
        assert left(spec, "M").decisive == pytest.approx(left(gj.changed(spec, same), "M").decisive, rel=1e-12)
    omitted = without("sensor.sample_clock_error")
    assert {t.key: t.value for t in absent_terms(omitted)} == {"sensor.sample_clock_error": "1 ppm"}
    by_sensor = gj.changed(omitted, {"sensor.clock": "sensor"})
    assert {t.key: t.value for t in absent_terms(by_sensor)} == {"sensor.sample_clock_error": "30 ppm"}
    row = left(by_sensor, "M")
    assert row.with_typical == pytest.approx(np.hypot(row.decisive, 30.0), rel=0.08)


@pytest.mark.long
def test_a_limit_a_derivative_and_a_sensitivity_count_what_no_residual_shows():
    """Half a degree of the input axis: 108 ppm, however long a plan goes on."""
    floor = 2**0.5 * np.radians(0.5) ** 2 * 1e6
    named = gj.changed(EXACT, {"rig.table.mounting[0].accuracy": "0.5 deg"})
    row = left(named, "M")
    assert gj.differentiable(named)({})["M"] == pytest.approx(row.decisive, rel=1e-9)
    found = gj.sensitivity(named)
    assert found.residuals["M"][0] == pytest.approx(row.decisive, rel=1e-6)
    (share,) = (r.percent for r in found.rows if r.requirement == "M" and r.figure.startswith("misalignment of"))
    assert share == pytest.approx((floor / row.decisive) ** 2, rel=1e-3)
    (limit,) = (one for one in gj.limit(named) if one.name == "M")
    assert floor < limit.certified < limit.value == pytest.approx(row.decisive)


# --- whole units ------------------------------------------------------------------------------------------------------

UNIT = parse_spec(gj.presets.text("ferraris"))


def test_a_unit_counts_what_it_omits_too_and_judges_by_coverage_and_risk():
    spec, prediction = UNIT, gj.predict(UNIT)
    row = prediction.requirements[0]
    assert row.with_typical > row.decisive
    assert {"sensor.gyro.turn_on_bias", "sensor.temperature_offset"} <= {t.key for t in prediction.omitted}
    assert next(r for r in prediction.requirements if r.name == "accelerometer bias").another_run > 700.0
    full = with_typical(spec)
    assert absent_terms(full) == []
    # An estimate that knows of the table's scale error weighs the readings by it: it errs a little less.
    assert 0.99 * row.with_typical < left(full, "gyro scale factor").decisive < row.with_typical
    target = f"{1.5 * row.judged:.6f} ppm"
    assert left(gj.changed(spec, {"requirement[0].target": target}), row.name).verdict == "met"
    twice = gj.changed(spec, {"requirement[0].target": target, "requirement[0].coverage": 2})
    assert left(twice, row.name).verdict == "missed"
    assert "2 ×" in left(twice, row.name).rule


def test_a_clock_does_not_scale_a_force_unless_it_is_a_velocity_increment():
    """199 ppm of the accelerometers' scale factor were the clock's."""
    bare = left(UNIT, "accelerometer scale factor")
    spec = gj.changed(UNIT, {"sensor.sample_clock_error": "200 ppm", "sensor.clock": "sensor"})
    assert left(spec, bare.name).decisive == pytest.approx(bare.decisive, rel=1e-9)
    spec = gj.changed(spec, {"sensor.accelerometer.velocity_increments": True})
    assert left(spec, "accelerometer scale factor").decisive > 190.0
    assert left(spec, "gyro scale factor").decisive > 190.0
    # The computer's clock ends the question.
    spec = gj.changed(spec, {"sensor.clock": "host"})
    assert left(spec, bare.name).decisive == pytest.approx(bare.decisive, rel=0.01)


# --- estimates --------------------------------------------------------------------------------------------------------


def test_an_estimate_counts_what_its_spec_omits(recorded):
    log, _ = recorded
    exact, by_exact = estimated(EXACT, log)
    bare, by_bare = estimated(BARE, log)
    for name in ("M", "B"):
        assert by_exact[name].verdict == "met"
        assert by_exact[name].decisive == by_exact[name].judged
        assert by_bare[name].decisive == pytest.approx(by_exact[name].judged, rel=1e-12)
        assert by_bare[name].judged > 5.0 * by_bare[name].decisive
        assert by_bare[name].verdict == "missed"
    assert exact.as_wished
    assert not bare.as_wished
    said = " ".join(bare.messages[log.units[0]])
    assert all(key in said for key in ZEROS if key != "sensor.thermal_lag")
    assert "rig.site" in said
    assert "lag" in said
    assert not any("typical" in m for m in exact.messages[log.units[0]])
    # The covariance of the fit is the same; what no residual shows stands beside it.
    (found,), (bare_found,) = exact.calibrations, bare.calibrations
    assert found.covariance == bare_found.covariance
    assert found.unseen == ()
    assert {e.name for e in bare_found.unseen} >= {
        "misalignment of the input axis from the table's axis",
        "Earth's rate",
        "omitted noise",
    }
    at = np.linspace(-20.0, 60.0, 5)
    (channel,) = bare_found.channel
    shown = calibration_map(bare_found, channel, "scale_factor", at, np.linspace(-200.0, 200.0, 5))[1].values
    assert np.mean(shown.max(axis=0)) == pytest.approx(by_bare["M"].judged, rel=1e-3)


def faults(log):
    """Faults that fit a model perfectly: the term that the spec omits, the map, and the log."""
    time, rate = log.time_s, log.rate_rad_per_s
    minutes = (log.temperature_c[0, -1] - log.temperature_c[0, 0]) / (time[-1] - time[0]) * 60.0
    earth = replace(log, rate_rad_per_s=rate + 10.63 * DEG_PER_H)
    gradient = replace(log, rate_rad_per_s=rate + 9.0 * minutes * DEG_PER_H)
    angle = replace(log, table_angle_rad=log.table_angle_rad * (1.0 + 9e-5))
    tilted = replace(log, rate_rad_per_s=rate * np.cos(np.radians(0.9)))
    warm = replace(log, temperature_c=log.temperature_c - 2.5)
    return {
        "rig.site.latitude": ("B", earth),
        "sensor.gyro.bias_temperature_gradient": ("B", gradient),
        "rig.table.axis[0].angle.scale_error": ("M", angle),
        "rig.table.mounting[0].accuracy": ("M", tilted),
        "sensor.temperature_offset": ("M", warm),
    }


@pytest.mark.parametrize("key", sorted(faults(simulate_log(EXACT, sample_rate_hz=2.0).log)))
def test_an_error_that_no_residual_shows_is_within_the_stated_uncertainty(recorded, key):
    log, truth = recorded
    name, faulty = faults(log)[key]
    report, rows = estimated(without(key), faulty)
    (sensor,) = report.sensors
    assert sensor.solution.test.passed
    model = sensor.built.model.channels[0]
    of, unit = (model.map("scale_factor"), 1e6) if name == "M" else (model.map("bias"), 1.0 / DEG_PER_H)
    where = model.where(of.name)
    at = np.linspace(-20.0, 60.0, 5)
    error = of.values(at, np.full(5, 1.0)) @ (sensor.solution.parameters[: model.size] - truth)[where] * unit
    worst, row = float(np.max(np.abs(error))), rows[name]
    assert worst > 5.0 * row.decisive
    assert worst <= 2.0 * row.worst
    assert key in " ".join(report.messages[log.units[0]])


@pytest.mark.long
def test_clocks_that_are_apart_count_until_someone_says_which_is_right(recorded):
    """The computer's may be the wrong one. So may one that was set, or a sensor's that depends on temperature."""
    log, _ = recorded
    time, jitter = log.time_s, 1e-4 * np.abs(np.random.default_rng(1).standard_normal(len(log.time_s)))
    middle = 0.5 * (time[0] + time[-1])

    def left_of(host, **options):
        report, rows = estimated(EXACT, replace(log, host_time_s=host + jitter), **options)
        return rows["M"].judged, [m for m in report.messages[log.units[0]] if "counts as uncertainty of the scale" in m]

    plain, said = left_of(time)
    assert not said
    # The sensor's clock is fast, and the computer's is used.
    fast, _ = estimated(EXACT, replace(log, host_time_s=time, time_s=time * (1.0 + 5e-4)))
    own, value = (one.calibrations[0].values()["gyro_x.b00"] for one in (estimated(EXACT, log)[0], fast))
    assert value == pytest.approx(own, abs=1e-6)
    assert any("contradict each other: they differ by 499" in m for m in fast.messages[log.units[0]])
    apart, (said,) = left_of(1.0002 * time)
    assert apart == pytest.approx(np.hypot(plain, 200.0), rel=0.02)
    assert "state this as sample_clock_error" in said
    # (A part per million is the computer's own.)
    assert left_of(1.0002 * time, clock="host") == (pytest.approx(np.hypot(plain, 1.0), rel=1e-3), [])
    # Two thousandths of a part of two minutes or more.
    was_set, (*_, said) = left_of(time + 0.5 * (time > middle))
    assert was_set > 1000.0
    assert "do not keep one ratio" in said
    curved = time + 50e-6 * (time - middle) ** 2 / (time[-1] - time[0])
    bent, (said,) = left_of(curved)
    assert 30.0 < bent < 55.0
    assert "depend on temperature" in said
    assert left_of(curved, clock="host")[0] == pytest.approx(bent, rel=1e-3)


# --- contradictions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "convert"), [("°F", lambda t: 1.8 * t + 32.0), ("K", lambda t: t + 273.15)])
def test_temperatures_in_another_unit_are_refused_by_name(recorded, unit, convert):
    log, _ = recorded
    with pytest.raises(LogError, match=f"inside it if the column is in {unit}"):
        estimated(EXACT, replace(log, temperature_c=convert(log.temperature_c)))


@pytest.mark.parametrize(
    ("course", "one_way"),
    [
        ((20.0, 60.0, 55.0), True),
        ((-20.0, 60.0, -20.0, 60.0), False),  # ends where a ramp would end
        ((20.0, 23.0), False),  # about constant
    ],
)
def test_a_temperature_that_returns_does_not_go_one_way(course, one_way):
    noise = 0.05 * np.random.default_rng(0).standard_normal(2000)
    temperature = np.interp(np.linspace(0.0, len(course) - 1.0, 2000), range(len(course)), course) + noise
    assert any("one direction only" in sentence for sentence in omitted_sentences(BARE, temperature)) == one_way


def test_there_is_no_verdict_beyond_the_data(recorded):
    log, _ = recorded
    wide = gj.changed(
        EXACT,
        {"requirement[0].rate": ["-290 deg/s", "290 deg/s"], "requirement[1].temperature": ["-40 degC", "60 degC"]},
    )
    report, rows = estimated(wide, log)
    assert {row.verdict for row in rows.values()} == {"not covered"}
    assert not report.as_wished
    said = " ".join(report.messages[log.units[0]])
    assert "'M' asks for -290 … 290 deg/s, but the data cover" in said
    assert "'B' asks for -40 … 60 °C, but the data cover" in said


def test_angles_that_wrap_are_asked_about():
    turns = np.linspace(0.0, 10.0 * np.pi, 999)[:, None]
    unread = np.where(np.arange(999) % 3 == 0, turns[:, 0], np.nan)[:, None]
    assert "wrap at 360 deg" in wrapped_sentence(np.mod(unread, 2.0 * np.pi))
    for sound in (turns, unread, 0.5 * np.mod(turns, 2.0 * np.pi), np.full((9, 1), np.nan)):
        assert wrapped_sentence(sound) == ""
