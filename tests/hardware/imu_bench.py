"""A short plan of a whole unit on a two-axis table, and its estimate from a log, for the tests of unit runs."""

import json
from pathlib import Path

import numpy as np
from hardware_bench import unpredicted
from matrix_errors import nees_of

from gradcal_jax.estimation.fit_of_log import fit_readings
from gradcal_jax.estimation.log_rows import Options, clock_fit, imu_rows, with_options
from gradcal_jax.hardware import execute
from gradcal_jax.information import segments_of, whiten
from gradcal_jax.model.build import build_imu
from gradcal_jax.spec.changes import changed, tables_of
from gradcal_jax.spec.spec import parse_spec
from gradcal_jax.tables.writing import write_toml

HAND = Path(__file__).parents[2] / "experiments" / "imu" / "hand2.toml"
# Two axes, a stop of an instant between two of their turns, and back to where it began.
MOVES = [
    {"rest": "3 s"},
    {"turn": "720 deg", "axis": "spin"},
    {"rest": "3 s"},
    {"turn": "-720 deg", "axis": "spin"},
    {"turn": "90 deg", "axis": "tilt"},
    {"rest": "4 s"},
    {"turn": "360 deg", "axis": "tilt", "peak_rate": "150 deg/s"},
    {"rest": "3 s"},
    {"turn": "-360 deg", "axis": "tilt", "peak_rate": "150 deg/s"},
    {"rest": "3 s"},
    {"pose": {"tilt": "45 deg", "spin": "135 deg"}, "rest": "3 s"},
    {"pose": {"tilt": "-90 deg", "spin": "180 deg"}, "rest": "3 s"},
    {"pose": {"tilt": "0 deg", "spin": "0 deg"}},
]


def short(cycles=1):
    """A plan of `cycles` cycles of less than a minute, 20 to 30 degC, of a simpler unit."""
    minutes = 0.9 * cycles
    temperature = {"degree": 1, "centre": "25 degC", "scale": "5 K"}
    rate = {"degree": 1, "scale": "300 deg/s"}
    keys = {f"sensor.{kind}.bias.temperature": temperature for kind in ("gyro", "accelerometer")}
    keys |= {
        "plan.temperature": ["20 degC", "30 degC"],
        "plan.gradient": f"{10.0 / minutes:.3f} K/min",
        "plan.cycle.moves": MOVES,
        "sensor.gyro.scale_factor": {"temperature": temperature, "rate": rate, "prior": "1000 ppm"},
        "sensor.accelerometer.scale_factor.temperature": temperature,
    }
    text = HAND.read_text(encoding="utf-8").replace('["-30 degC", "70 degC"]', '["20 degC", "30 degC"]')
    return changed(parse_spec(text), keys | {"rig.chamber.max_heating": "60 K/min"})


def triad():
    """The short plan of a unit of three gyros alone."""
    spec = short()
    kept = [r for r in tables_of(spec)["requirement"] if r["quantity"].startswith("gyro_")]
    return changed(spec, {"sensor.accelerometer": None, "sensor.gyro.g_sensitivity": None, "requirement": kept})


def made(spec):
    """Its recipe, without a prediction."""
    return unpredicted(spec)


def write(folder):
    """The recipe of the short plan, and its simulated run with two units."""
    recipe = made(short())
    write_toml(recipe, folder / "recipe.toml")
    result = execute.run(recipe, folder / "run", simulate=True, seed=3, units=2)
    assert (result.exit_status, result.verified_safe) == ("success", True), result.reason


def hidden_truth(folder, unit="unit1"):
    """What the simulation hides of a unit and of how it hangs, by the names of the parameters."""
    hidden = json.loads((folder / "hidden_truth.json").read_text(encoding="utf-8"))
    return hidden["units"][unit] | hidden["installation"]


def estimated(log, spec, truth, clock=None):
    """χ² of a log and its degrees of freedom, and the normalised square of all errors of the estimate and theirs.

    As `estimate` does: where rates are integrated over the computer's time, the clock's error is a parameter, whose
    hidden truth is that of the comparison: the simulated unit's clock is right.
    """
    counted, options, _ = with_options(spec, [log], Options(clock=clock))
    built = build_imu(counted)
    model = built.model
    rows, _ = imu_rows(built, [log], log.units[0], options)
    # As it was read: what smooths a thermometer's steps in a ramp of an hour is too slow for one of a minute.
    fit = fit_readings(built, log.units[0], rows, log.temperature_c[0])
    readings, found = fit.readings, fit.solution
    steps, _ = readings.linear(found.parameters)
    used = np.asarray(steps.used)
    apart = readings.observed - readings.expected(found.parameters)
    apart = np.where(segments_of(readings.done.motion, model).used, apart, 0.0)
    prior = model.prior_rows()
    chi_squared = float(np.sum(np.asarray(whiten(steps, apart[:, None]))[used] ** 2))
    chi_squared += float(np.sum((prior @ found.parameters) ** 2))
    degrees = int(used.sum()) + len(prior) - model.size
    names, reported = model.names(), model.to_reported
    if counted.sensor.sample_clock_error is not None and spec.sensor.sample_clock_error is None:
        truth = {"sample_clock": clock_fit(log).slope - 1.0} | truth
    assert set(names) == set(truth)
    # What gyros feel of rotation is a product of two draws, so that its square is not that of a normal error.
    kept = [k for k, name in enumerate(names) if ".ww_" not in name]
    of_kept = [names[k] for k in kept]
    values, true = reported[kept] @ found.parameters, np.array([truth[name] for name in of_kept])
    nees = nees_of(of_kept, values, true, found.known.covariance(reported[kept]))
    return chi_squared, degrees, nees, len(kept)
