"""A whole unit's calibration: its file, what it does to data, and what other programs make of it."""

import re
import shutil
import subprocess
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import unit_twin
from hypothesis import given, settings
from hypothesis import strategies as st

from gradcal_jax.files import c_header, exports, unit_exports
from gradcal_jax.files.log import Log, LogError, read_log, write_log
from gradcal_jax.files.problems import SpecError
from gradcal_jax.files.unit_calibration import (
    UnitCalibration,
    parse_any_calibration,
    read_any_calibration,
    write_unit_calibration,
)
from gradcal_jax.files.unit_correction import apply_unit, term_values

G = 9.80665
TEMPERATURE = {"basis": "polynomial", "degree": 3, "centre": "20 degC", "scale": "50 K"}
LINEAR = TEMPERATURE | {"degree": 1}
RATE = {"basis": "polynomial", "degree": 3, "scale": "300 deg/s"}


def a_truth(seed: int = 3) -> dict[str, float]:
    """Errors of a consumer unit, by the coefficients' names."""
    rng = np.random.default_rng(seed)
    truth = {}
    for a in "xyz":
        truth |= {f"gyro_{a}.a{k}": 2e-3 * v for k, v in enumerate(rng.standard_normal(4))}
        truth |= {f"gyro_{a}.b{j}{i}": 3e-3 * rng.standard_normal() for i in range(4) for j in range(4)}
        truth |= {f"gyro_{a}.g_{b}": 1e-5 * rng.standard_normal() for b in "xyz"}
        truth |= {f"accelerometer_{a}.a{k}": 0.1 * v for k, v in enumerate(rng.standard_normal(4))}
        truth |= {f"accelerometer_{a}.s{k}": 3e-3 * v for k, v in enumerate(rng.standard_normal(4))}
        truth[f"accelerometer_{a}.k2"] = 1e-5 * rng.standard_normal()
        for kind in ("gyro", "accelerometer"):
            truth |= {f"{kind}_{a}.m_{b}{k}": 5e-3 * rng.standard_normal() for b in "xyz" if b != a for k in range(2)}
    return truth


def document(truth: dict[str, float]) -> dict:
    """The file of a unit that has these errors."""
    channels = []
    for kind, own in (("gyro", "rate"), ("accelerometer", "force")):
        for a in "xyz":
            name = f"{kind}_{a}."
            of = {k.removeprefix(name): v for k, v in truth.items() if k.startswith(name)}

            def term(called, unit, signals, prefix, of=of, **bases):
                values = {k: v for k, v in of.items() if k.startswith(prefix)}
                return {"name": called, "unit": unit, "signals": signals, "coefficients": values} | bases

            terms = [term("bias", "rad/s" if kind == "gyro" else "m/s^2", [], "a", temperature=TEMPERATURE)]
            if kind == "gyro":
                terms.append(term("scale_factor", "1", [f"rate {a}"], "b", temperature=TEMPERATURE, rate=RATE))
                terms += [term(f"g_sensitivity_{b}", "rad/s/(m/s^2)", [f"force {b}"], f"g_{b}") for b in "xyz"]
            else:
                terms.append(term("scale_factor", "1", [f"force {a}"], "s", temperature=TEMPERATURE))
                terms.append(term("second_order", "1/(m/s^2)", [f"force {a}"] * 2, "k2"))
            for b in "xyz":
                if b != a:
                    terms.append(term(f"misalignment_{b}", "rad", [f"{own} {b}"], f"m_{b}", temperature=LINEAR))
            channels.append({"kind": kind, "axis": a, "term": terms})
    return {
        "format": "gradcal-calibration/1",
        "serial_number": "SN 1",
        "quantity": "unit",
        "simulated": True,
        "frame": "the table's axes",
        "order": "measured = input + sum",
        "valid_temperature": ["-30 degC", "70 degC"],
        "valid_rate": ["-300 deg/s", "300 deg/s"],
        "channel": channels,
    }


def calibration_of(truth: dict[str, float]) -> UnitCalibration:
    return UnitCalibration.model_validate(document(truth))


def text_of(calibration: UnitCalibration) -> str:
    with tempfile.TemporaryDirectory() as folder:
        write_unit_calibration(calibration, Path(folder, "unit.toml"))
        return Path(folder, "unit.toml").read_text(encoding="utf-8")


TEXT = text_of(calibration_of(a_truth()))


def readings(truth: dict[str, float], count: int = 400) -> tuple[Log, np.ndarray, np.ndarray]:
    """A log of such a unit by the twin's own formulas, and the true rates and forces."""
    rng = np.random.default_rng(0)
    rate = rng.uniform(-5.0, 5.0, (count, 3))
    force = rng.uniform(-G, G, (count, 3))
    temperature = rng.uniform(-29.0, 69.0, count)
    warm = (temperature - 20.0) / 50.0
    said = np.stack([unit_twin._gyro(truth, a, rate, force, warm, np.radians(300.0)) for a in range(3)], axis=1)
    felt = np.stack([unit_twin._accelerometer(truth, a, force, warm) for a in range(3)], axis=1)
    log = Log(
        np.arange(count) * 0.01, said[None], ("SN 1",), tuple("xyz"), temperature[None],
        specific_force_m_per_s2=felt[None], force_axes=tuple("xyz"),
    )  # fmt: skip
    return log, rate, force


def test_a_corrected_log_is_the_truth(tmp_path):
    truth = a_truth()
    log, rate, force = readings(truth)
    write_log(log, tmp_path / "log.nc")
    read = read_log(tmp_path / "log.nc")
    done = apply_unit(calibration_of(truth), read, "SN 1")
    assert np.max(np.abs(done.log.rate_rad_per_s[0] - rate)) < 1e-14 * 5.0 * 20
    assert np.max(np.abs(done.log.specific_force_m_per_s2[0] - force)) < 1e-13 * G
    assert (done.outside_temperature, done.outside_rate, done.left_alone) == (0, 0, ())


def test_beyond_its_range_the_map_holds_its_edge():
    truth = a_truth()
    log, rate, _ = readings(truth)
    narrow = document(truth) | {"valid_rate": ["-1 rad/s", "1 rad/s"]}
    done = apply_unit(UnitCalibration.model_validate(narrow), log)
    assert done.outside_rate > 0
    inside = np.all(np.abs(rate) < 0.98, axis=1)
    assert inside.sum() == 0 or np.max(np.abs(done.log.rate_rad_per_s[0][inside] - rate[inside])) < 1e-9
    fast = np.abs(rate) > 4.0
    apart = np.abs(done.log.rate_rad_per_s[0] - rate)[fast]
    assert 1e-4 < np.median(apart) < 0.3  # another scale factor, not another rate


def test_a_log_without_a_channel_is_refused():
    log, *_ = readings(a_truth())
    without = replace(log, specific_force_m_per_s2=None, force_axes=())
    with pytest.raises(LogError, match="no accelerometer x"):
        apply_unit(calibration_of(a_truth()), without)


def test_a_file_reads_back_as_it_was_written(tmp_path):
    calibration = calibration_of(a_truth())
    write_unit_calibration(calibration, tmp_path / "unit.toml")
    text = (tmp_path / "unit.toml").read_text(encoding="utf-8")
    assert "SIMULATED" in text
    again = read_any_calibration(tmp_path / "unit.toml")
    assert again.model_dump(exclude_none=True) == calibration.model_dump(exclude_none=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d["channel"][0]["term"][0]["coefficients"].pop("a3"), "as many as the bases have functions"),
        (lambda d: d["channel"][0]["term"][1].update(signals=["rat x"]), "is no signal"),
        (lambda d: d["channel"].__setitem__(1, d["channel"][0]), "two channels"),
        (lambda d: d.update(valid_temperature=["70 degC", "-30 degC"]), "below the first"),
        (lambda d: d.update(covariance={"names": ["gyro_x.a9"], "matrix": [[1.0]]}), "no channel has"),
        (lambda d: d.update(channels=[]), "unknown"),
        (lambda d: d.pop("order"), "missing"),
    ],
)
def test_a_broken_file_is_a_sentence(change, said):
    broken = document(a_truth())
    change(broken)
    from gradcal_jax.files.calibration import FORMAT
    from gradcal_jax.files.document import model_of

    with pytest.raises(SpecError, match=said):
        model_of(UnitCalibration, broken, FORMAT, "unit.toml")


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 10**6), st.integers(0, 40), st.sampled_from(["", "=", "nan", "[", '"', "1e999", "\n", "é", "-"]))
def test_any_mutilated_text_is_a_calibration_or_a_sentence(place, length, instead):
    text = TEXT
    at = place % len(text)
    try:
        parse_any_calibration(text[:at] + instead + text[at + length :])
    except SpecError as error:
        said = str(error)
    else:
        said = "read"
    assert said


def test_every_coefficient_is_in_the_csv():
    truth = a_truth()
    done = unit_exports.export_unit(calibration_of(truth), "csv")
    rows = [line.split(",") for line in done.text.splitlines() if not line.startswith("#")][1:]
    assert {f"{row[0]}.{row[3]}": float(row[4]) for row in rows} == truth
    assert done.losses == ()


def linear(truth, kind, at):
    """Matrix and bias of a kind at one temperature, by names: an own reading of them."""
    warm, matrix, bias = (at - 20.0) / 50.0, np.eye(3), np.zeros(3)
    for i, a in enumerate("xyz"):
        for name, value in truth.items():
            head, _, symbol = name.partition(".")
            if head != f"{kind}_{a}":
                continue
            if symbol[0] == "a":
                bias[i] += value * warm ** int(symbol[1:])
            elif symbol[0] == "s" or symbol.startswith("b0"):
                matrix[i, i] += value * warm ** int(symbol[-1])
            elif symbol.startswith("m_"):
                matrix[i, "xyz".index(symbol[2])] += value * warm ** int(symbol[3:])
    return matrix, bias


def test_kalibr_s_form_is_the_same_unit_in_its_own_frame():
    truth, at = a_truth(), 33.0
    gyro, _ = linear(truth, "gyro", at)
    force, _ = linear(truth, "accelerometer", at)
    form = unit_exports.kalibr_form(unit_exports.linear_at(calibration_of(truth), at))
    for matrix in (form.accelerometer, form.gyro):
        assert np.all(np.triu(matrix, 1) == 0.0) or np.max(np.abs(np.triu(matrix, 1))) < 1e-15
    for rotation in (form.rotation, form.frame):
        assert np.max(np.abs(rotation @ rotation.T - np.eye(3))) < 1e-14
        assert np.linalg.det(rotation) > 0.0
    assert np.max(np.abs(form.accelerometer @ form.frame - force)) < 1e-14
    assert np.max(np.abs(form.gyro @ form.rotation @ form.frame - gyro)) < 1e-14
    text = unit_exports.export_unit(calibration_of(truth), "kalibr", temperature_c=at).text
    import yaml

    written = yaml.safe_load(text)
    assert np.max(np.abs(np.array(written["accelerometers"]["M"]) - form.accelerometer)) == 0.0
    assert np.max(np.abs(np.array(written["gyroscopes"]["C_gyro_i"]) - form.rotation)) == 0.0


def test_matrices_correct_what_the_unit_says():
    import yaml

    truth, at = a_truth(), -12.0
    written = yaml.safe_load(unit_exports.export_unit(calibration_of(truth), "matrices", temperature_c=at).text)
    force = np.array([1.0, -4.0, 8.0])
    matrix, bias = linear(truth, "accelerometer", at)
    raw = matrix @ force + bias
    again = np.array(written["accelerometer"]["matrix"]) @ (raw - np.array(written["accelerometer"]["bias"]))
    assert np.max(np.abs(again - force)) < 1e-13
    with pytest.raises(ValueError, match="--temperature"):
        unit_exports.export_unit(calibration_of(truth), "matrices")


@pytest.mark.parametrize("target", ["ardupilot", "px4"])
def test_flight_controllers_take_the_biases_off(target):
    truth = a_truth()
    done = unit_exports.export_unit(calibration_of(truth), target, instance=1, device_id=77)
    if target == "ardupilot":
        told = {name: float(value) for name, value in (line.split() for line in done.text.splitlines())}
        of = {"gyro": exports.ardupilot_correction, "accelerometer": partial(exports.ardupilot_correction, kind="ACC")}
    else:
        told = {row[2]: float(row[3]) for row in (line.split("\t") for line in done.text.splitlines())}
        of = {"gyro": exports.px4_correction, "accelerometer": partial(exports.px4_correction, letter="A")}
    t = np.linspace(-30.0, 70.0, 41)
    for kind, tolerance in (("gyro", 1e-8), ("accelerometer", 1e-6)):
        for i, a in enumerate("xyz"):
            taken = of[kind](told, a, t, 1)
            true = np.array([linear(truth, kind, at)[1][i] for at in t])
            assert np.max(np.abs(taken - true)) < tolerance
    what = {(loss.axis, loss.what) for loss in done.losses}
    assert ("gyro x", "misalignment y") in what
    assert any(axis == "accelerometer z" and "scale" in name for axis, name in what)
    if target == "ardupilot":
        assert told["INS_ACCSCAL_X"] == pytest.approx(1.0 / linear(truth, "accelerometer", 20.0)[0][0, 0], rel=1e-7)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_header_compiled_is_apply_in_single_precision(tmp_path):
    truth = a_truth()
    calibration = calibration_of(truth)
    log, rate, force = readings(truth, 200)
    raw = np.concatenate([log.rate_rad_per_s[0], log.specific_force_m_per_s2[0]], axis=1)
    (tmp_path / "unit.h").write_text(unit_exports.export_unit(calibration, "c-header").text, encoding="utf-8")
    rows = ",\n".join("{" + ", ".join(f"{np.float32(v):.9g}f" for v in row) + "}" for row in raw)
    heats = ", ".join(f"{np.float32(v):.9g}f" for v in log.temperature_c[0])
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "unit.h"\n'
        f"static const float raw[200][6] = {{{rows}}};\nstatic const float heat[200] = {{{heats}}};\n"
        "int main(void) {\n    float out[6];\n"
        "    gradcal_correct(GRADCAL_TEST_T, gradcal_test_raw, out);\n"
        "    for (int k = 0; k < 6; k++) {\n"
        "        const float d = out[k] - gradcal_test_out[k];\n"
        "        if (d > GRADCAL_TEST_TOLERANCE || -d > GRADCAL_TEST_TOLERANCE) return 1;\n    }\n"
        "    for (int i = 0; i < 200; i++) {\n        gradcal_correct(heat[i], raw[i], out);\n"
        '        for (int k = 0; k < 6; k++) printf("%.9g ", (double)out[k]);\n    }\n    return 0;\n}\n',
        encoding="utf-8",
    )
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off"]
    subprocess.run(["cc", *strict, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    ran = subprocess.run([tmp_path / "main"], check=True, capture_output=True, text=True)
    found = np.array(ran.stdout.split(), float).reshape(200, 6)
    true = np.concatenate([rate, force], axis=1)
    assert np.max(np.abs(found - true) / np.array([5.0] * 3 + [G] * 3)) < 2e-6
    mine = c_header.corrected_in_single(calibration, raw, log.temperature_c[0])
    assert np.max(np.abs(found - mine)) < 1e-5
    code = re.sub(r"/\*.*?\*/", "", (tmp_path / "unit.h").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert "/" not in code  # no division


def test_terms_are_what_the_names_say():
    truth = a_truth()
    channel = calibration_of(truth).channel_of("gyro", "y")
    at, rate = np.array([47.0]), np.array([2.0])
    value = term_values(channel.term_of("scale_factor"), at, rate)[0]
    u, v = 27.0 / 50.0, 2.0 / np.radians(300.0)
    assert value == pytest.approx(
        sum(truth[f"gyro_y.b{j}{i}"] * v**j * u**i for i in range(4) for j in range(4)), rel=1e-12
    )
