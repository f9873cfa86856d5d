"""Features of both_kinds.py, of one gyro axis and of an IMU by the same words: runs on simulated devices, calibrations
and what is made of them, noise of records, and files to begin with."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from both_bench import Answer, Checks, FeatureBench, benches, drawn, named
from both_kinds import FORMATS
from both_specs import DRIFT, DRIFT_TIME_S, FORCE_WALK, WALK

from gradcal_jax.calibration import read_calibration
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.hardware import execute
from gradcal_jax.hardware.runner import Runner, RunProgress
from gradcal_jax.recipe.recipe import read_recipe
from gradcal_jax.records.log import Log
from gradcal_jax.records.log_file import read_log
from gradcal_jax.spec.spec import read_spec

CHECKS = Checks()
PREPARED: dict[str, Callable[[FeatureBench], None]] = {}


@pytest.fixture(scope="module")
def kinds(tmp_path_factory):
    with benches(tmp_path_factory.mktemp("runs"), PREPARED) as made:
        yield made


# ------------------------------------------------------------------------------------------- a run and its calibration


@CHECKS.of("recipe")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    recipe = read_recipe(bench.folder / "recipe.toml")
    for words in ("from 10 degC to 26 degC", "when stable", "scale factor", "deg/s"):
        assert words in answers[1].out
    assert {row.name: row.decisive for row in recipe.prediction.requirements} == pytest.approx(
        bench.predicted("recipe.toml")
    )


@CHECKS.of("simulated run")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    run, status = (answer.json for answer in answers)
    assert run["exit_status"] == "success"
    assert run["verified_safe"]
    assert (status["simulated"], status["state"]) == (True, "safe")
    hidden = json.loads((bench.folder / "run/hidden_truth.json").read_text(encoding="utf-8"))
    assert {name.split(".")[0] for name in hidden["units"]["unit1"]} >= bench.channels


@CHECKS.of("log of a run")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    log = read_log(bench.folder / "run/log.nc")
    assert log.simulated
    assert log.units == ("unit1",)
    assert log.temperature_c is not None
    assert np.nanmin(log.temperature_c) < 11.0
    assert bool(np.any(log.specific_force_m_per_s2)) == bench.of_imu
    assert len(log.table_axes) == 1 + bench.of_imu


def off(calibration: Calibration, run: Path, unit: str = "unit1") -> dict[str, float]:
    """The errors of the gyros' biases and scale factors against the hidden truth, in standard deviations."""
    truth = json.loads((run / "hidden_truth.json").read_text(encoding="utf-8"))["units"][unit]
    values = {
        f"{channel.kind}_{channel.axis}.{name}": value
        for channel in calibration.channel
        for term in channel.term
        for name, value in term.coefficients.items()
    }
    names = list(calibration.covariance.names)
    deviations = np.sqrt(np.diag(np.array(calibration.covariance.matrix)))
    return {
        name: (values[name] - truth[name]) / deviation
        for name, deviation in zip(names, deviations, strict=True)
        if re.fullmatch(r"gyro_.\.[ab]\d+", name)
    }


@CHECKS.of("estimate")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = read_calibration(bench.folder / "run/calibration.toml")
    assert found.simulated
    assert {f"{channel.kind}_{channel.axis}" for channel in found.channel} == bench.channels
    errors = off(found, bench.folder / "run")
    assert len(errors) == 6 * len(bench.gyros)
    assert max(map(abs, errors.values())) < 5.0
    assert found.fit[0].chance > 0.01
    assert drawn(bench.folder / "fit.png")
    (unit,) = answers[0].json["units"]
    assert unit["simulated"]


@CHECKS.of("result of each requirement")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    """As the data give it: what no residual shows counts with the sensor's own map, which the prediction lacks."""
    plan = {name: named(row) for name, row in answers[0].rows.items()}
    found = read_calibration(bench.folder / "run/calibration.toml").result
    assert len(found) == len(plan)
    for row in found:
        assert row.verdict in ("met", "missed")
        left = row.value if row.named is None else row.named
        assert left == pytest.approx(plan[row.name.split(",")[0]], rel=0.25), row.name


@CHECKS.of("validation by a second run")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[-1].json
    assert found["simulated"]
    gyros = found["axes"][0]
    assert gyros["moves"] > 20
    for name in ("scale_factor_ppm", *(["bias_deg_per_h"] if bench.of_imu else [])):
        before, after = gyros[name]
        assert after < 0.1 * before, name


@CHECKS.of("correction of a log")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    raw, corrected = (read_log(bench.folder / name) for name in ("run/log.nc", "corrected.nc"))
    rests = standing(raw)

    def scatter(log: Log) -> float:
        rate = log.rate_rad_per_s[0]
        means = np.array([rate[part, :].mean(axis=0) for part in rests])
        axis = log.axes.index("x")
        return float(np.std(means[:, axis]))

    assert len(rests) > 10
    assert scatter(corrected) < 0.1 * scatter(raw)


def standing(log: Log) -> list[slice]:
    """The rows of each rest in the data, without its first and last quarter of a second."""
    number = np.asarray(log.standstill)
    edges = np.flatnonzero(np.diff(number)) + 1
    parts = [slice(a + 32, b - 32) for a, b in pairwise([0, *edges, len(number)]) if b - a > 200]
    used = np.asarray(log.status)[0] == 0
    return [part for part in parts if number[part.start] >= 0 and used[part].all()]


def recorded_elsewhere(bench: FeatureBench) -> None:
    """The run's log as a table that the sensor's own logger wrote, whose clock began at another time."""
    log = read_log(bench.folder / "run/log.nc")
    names, columns = ["t"], [log.time_s + 5000.0]
    axes = {"rate": log.axes}
    names += [f"w{axis}" for axis in log.axes]
    columns += list(np.degrees(log.rate_rad_per_s[0]).T)
    if log.specific_force_m_per_s2 is not None:
        axes["force"] = log.force_axes
        names += [f"f{axis}" for axis in log.force_axes]
        columns += list(log.specific_force_m_per_s2[0].T)
    names.append("temp")
    columns.append(log.temperature_c[0])
    table = np.array(columns).T
    table = table[np.isfinite(table).all(axis=1)]
    # The logger was on before the first turn and after the last one, at rest.
    step, still = 0.008, np.arange(1, 25_001)[:, None]
    before, after = (np.repeat(part.mean(axis=0)[None], len(still), axis=0) for part in (table[:200], table[-50:]))
    before[:, :1], after[:, :1] = table[0, 0] - step * still[::-1], table[-1, 0] + step * still
    whole = np.concatenate((before, table, after))
    path = bench.folder / "own.csv"
    np.savetxt(path, whole, delimiter=",", header=",".join(names), comments="", fmt="%.10g")
    lines = ['format = "gradcal-columns/1"', 'name = "unit1"', 'time = { column = "t", unit = "s" }']
    lines.append('temperature = { column = "temp", unit = "degC" }')
    for table, letter, unit in (("rate", "w", "deg/s"), ("force", "f", "m/s^2")):
        if table in axes:
            lines += [f"[{table}]", *(f'{a} = {{ column = "{letter}{a}", unit = "{unit}" }}' for a in axes[table])]
    (bench.folder / "columns.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


PREPARED["import of a recording"] = recorded_elsewhere


@CHECKS.of("import of a recording")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    own, other = (read_calibration(bench.folder / name) for name in ("run/calibration.toml", "recorded.toml"))
    for axis in bench.gyros:
        for term, size in (("bias", 20.0), ("scale_factor", 100e-6)):
            a, b = (one.channel_of("gyro", axis).term_of(term).coefficients for one in (own, other))
            limit = np.radians(size) / 3600.0 if term == "bias" else size
            assert list(a) == list(b)
            assert max(abs(a[name] - b[name]) for name in a) < limit


@CHECKS.of("export, every format")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    gyro = read_calibration(bench.folder / "run/calibration.toml").channel_of("gyro", "x")
    bias, scale = (gyro.term_of(term).coefficients for term in ("bias", "scale_factor"))
    texts = {name: (bench.folder / f"{name}.txt").read_text(encoding="utf-8") for name in (*FORMATS, "gains")}
    # The maps are of (T - 18 degC)/8 K, so that a0 is the bias at 18 degC, and a1/8 its slope.
    slope = bias["a1"] / 8.0
    assert float(re.findall(r"INS_TCAL1_GYR1_X (\S+)", texts["ardupilot"])[0]) == pytest.approx(slope * 1e6, rel=1e-3)
    assert float(re.findall(r"TC_G0_X1_0\t(\S+)", texts["px4"])[0]) == pytest.approx(slope, rel=1e-3)
    for name in ("c-header", "csv"):
        assert closest(texts[name], bias["a0"]) < 1e-6 * abs(bias["a0"])
    assert closest(texts["matrices"], bias["a0"]) < 1e-3 * abs(bias["a0"])
    assert closest(texts["kalibr"], 1.0 + scale["b00"]) < 0.1 * abs(scale["b00"])
    zero, unit = bias["a0"], np.radians(1.0)
    assert int(re.findall(r"gyro_zero_x = (\S+)", texts["gains"])[0]) == pytest.approx(zero / unit * 16.4, abs=1.0)


def closest(text: str, value: float) -> float:
    """How far the nearest number of a text is from a value."""
    return min(abs(float(number) - value) for number in re.findall(r"[-+]?\d+\.\d+(?:e[-+]\d+)?", text))


@CHECKS.of("page")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    plan, calibration = ((bench.folder / f"{name}.html").read_text(encoding="utf-8") for name in ("plan", "page"))
    for html in (plan, calibration):
        assert html.count("<svg") > 3
        assert "scale factor" in html
    assert "SIMULATED" in calibration
    found = answers[1].json
    for row, kept in zip(
        found["requirements"], read_calibration(bench.folder / "run/calibration.toml").result, strict=True
    ):
        assert row["achieved"] == kept.value


@CHECKS.of("certificate and DCC")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    html = (bench.folder / "certificate.html").read_text(encoding="utf-8")
    assert "simulated" in html.lower()
    assert "Laboratory" in html
    root = ET.parse(bench.folder / "certificate.xml").getroot()
    text = " ".join(root.itertext())
    assert root.tag.endswith("digitalCalibrationCertificate")
    assert "Laboratory" in text


@CHECKS.of("several in one run, and a lot")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    for k in (1, 2, 3):
        found = read_calibration(bench.folder / f"several/unit{k}.toml")
        assert max(map(abs, off(found, bench.folder / "several", f"unit{k}").values())) < 5.0
    lot = answers[-1].json
    assert lot["simulated"]
    assert lot["imus"] == ["unit1", "unit2", "unit3"]
    maps = {(row["channel"], row["term"]): row for row in lot["maps"]}
    assert {channel for channel, _ in maps} == bench.channels
    for row in maps.values():
        # Of three, whose mean is theirs at every temperature.
        assert len(row["mean"]) == len(row["temperature_c"])
        assert min(row["mean_half_95"]) > 0.0


def stopped_in_the_middle(bench: FeatureBench) -> None:
    """A simulated run that ends with more than a cycle left. (No command line stops another in one process.)"""
    runners: list[Runner] = []
    recipe = read_recipe(bench.folder / "recipe.toml")

    def look(progress: RunProgress) -> None:
        if progress.track_left_s < 0.6 * recipe.spec.schedule.duration:
            runners[0].request("stop", "enough")

    result = execute.run(
        recipe, bench.folder / "stopped", simulate=True, seed=1, on_progress=look, with_runner=runners.append
    )
    assert result.exit_status == "stopped"


PREPARED["stopped run, continued by a new plan"] = stopped_in_the_middle


@CHECKS.of("stopped run, continued by a new plan")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    rest = read_recipe(bench.folder / "rest.toml")
    known = {row["name"]: row for row in answers[0].json}
    assert len(rest.spec.done) == 1
    for name, row in answers[2].rows.items():
        assert named(row) < known[name]["now"]
    log = read_log(bench.folder / "stopped/log.nc")
    assert len(log.stretch_starts) >= 2
    assert log.provenance["sessions"] == "2"
    found = read_calibration(bench.folder / "stopped/calibration.toml")
    assert max(map(abs, off(found, bench.folder / "stopped").values())) < 5.0


# --------------------------------------------------------------------------------------------------------------- noise


@CHECKS.of("Direct Bound")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].json["channels"]
    assert [channel["axis"] for channel in found] == list(bench.gyros)
    for channel in found:
        # The bound is of the largest of many draws: above the drift, but not by much.
        assert 0.8 < np.radians(channel["drift_std_deg_per_h"]) / 3600.0 / DRIFT < 2.5
        assert 0.1 < channel["correlation_time_s"] / DRIFT_TIME_S < 5.0


@CHECKS.of("Allan deviation")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    found = answers[0].json["channels"]
    assert [channel["axis"] for channel in found] == list(bench.gyros)
    for channel in found:
        value = channel["coefficients"]["angle_random_walk_deg_per_sqrt_h"]["value"]
        assert np.radians(value) / 60.0 == pytest.approx(WALK, rel=0.2)
    assert drawn(bench.folder / "allan.png")
    noise = (bench.folder / "noise.yaml").read_text(encoding="utf-8")
    densities = {name: float(value) for name, value in re.findall(r"(\w+)_noise_density: (\S+)", noise)}
    sizes = {"gyroscope": WALK} | ({"accelerometer": FORCE_WALK} if bench.of_imu else {})
    assert densities == pytest.approx(sizes, rel=0.2)


# --------------------------------------------------------------------------------------------------------------- begin


@CHECKS.of("first files")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    made = {path.name for path in (bench.folder / "mine").iterdir()}
    assert made >= {"spec.toml", "rig.toml", "columns.toml"}
    spec = read_spec(bench.folder / "mine/spec.toml")
    assert (spec.sensor.accelerometer is not None) == bench.of_imu
    assert {row.name for row in spec.requirement} == set(answers[2].rows)


@CHECKS.of("specs of earlier versions")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    old, new = (bench.folder / name for name in ("old.toml", "new.toml"))
    assert "[sensor.gyro]" in new.read_text(encoding="utf-8")
    assert "[sensor.gyro]" not in old.read_text(encoding="utf-8")
    assert read_spec(new) == read_spec(old)


@CHECKS.of("calibrations of earlier versions")
def _(bench: FeatureBench, answers: list[Answer]) -> None:
    old, new = (bench.folder / name for name in ("old-calibration.toml", "new-calibration.toml"))
    assert 'format = "gradcal-calibration/3"' in new.read_text(encoding="utf-8")
    assert read_calibration(new) == read_calibration(old)
    assert answers[1].status == 0


@pytest.mark.usefixtures("without_prices")
@pytest.mark.parametrize(("name", "kind"), CHECKS.cells())
def test_a_feature_of_runs_is_there_for_both(name, kind, kinds) -> None:
    CHECKS[name](kinds[kind], kinds[kind].done(name))
