"""Every export, read back in the target's own arithmetic: within the loss it states, and the loss is a real one."""

import csv
import shutil
import subprocess

import numpy as np
import pytest
from calibration_samples import HEAD, POLYNOMIAL_W, SPLINE_T, WHOLE, axis_text

from gradcal_jax.files import c_header
from gradcal_jax.files.calibration import parse_calibration
from gradcal_jax.files.correction import bias, correct, measured, scale_factor
from gradcal_jax.files.exports import FORMATS, export, px4_correction

DEG_PER_H = np.degrees(1.0) * 3600.0
CALIBRATION = parse_calibration(WHOLE)
T = np.linspace(-30.0, 70.0, 501)


def loss(done, axis, what):
    return next(one.value for one in done.losses if one.axis == axis and one.what == what)


def ardupilot_by_the_book(parameters, axis, temperature):
    """The firmware's own order of operations, one temperature at a time."""
    f = np.float32
    p = {name: f(value) for name, value in parameters.items()}

    def polynomial(t):
        d = f(min(max(f(t), p["INS_TCAL1_TMIN"]), p["INS_TCAL1_TMAX"]) - f(35.0))
        c = [p[f"INS_TCAL1_GYR{k}_{axis}"] for k in (1, 2, 3)]
        return f(f(d * c[0] + d * d * c[1] + d * d * d * c[2]) * f(1e-6))

    at = polynomial(p["INS_GYR1_CALTEMP"])
    # corrected = raw − P(T − 35) + P(Tcal − 35) − OFFS, of a raw rate of zero
    return np.array([-float(polynomial(t)) + float(at) - float(p[f"INS_GYROFFS_{axis}"]) for t in temperature])


def test_ardupilot_takes_off_the_bias_within_what_it_says():
    done = export(CALIBRATION, "ardupilot")
    parameters = {name: float(value) for name, value in (line.split() for line in done.text.splitlines())}
    for axis in CALIBRATION.axis:
        left = -ardupilot_by_the_book(parameters, axis.name.upper(), T) - bias(axis, T)
        said = loss(done, axis.name, "bias")
        assert np.max(np.abs(left)) * DEG_PER_H <= 1.5 * said + 1e-3
        assert said < 0.05  # a cubic is exact but for float32
        map_ = scale_factor(axis, T, np.full_like(T, np.radians(300.0)))
        assert loss(done, axis.name, "scale factor") >= np.max(np.abs(map_)) * 1e6 * (1 - 1e-6)
    assert any("no gyro scale factor" in note for note in done.notes)


def test_px4_takes_off_the_bias_within_what_it_says():
    done = export(CALIBRATION, "px4", instance=2, device_id=4259850)
    rows = [line.split("\t") for line in done.text.splitlines()]
    assert all(len(row) == 5 and row[:2] == ["1", "1"] and row[4] in ("6", "9") for row in rows)
    parameters = {row[2]: float(row[3]) for row in rows}
    assert parameters["TC_G2_ID"] == 4259850
    assert parameters["TC_G_ENABLE"] == 1
    for place, axis in enumerate(CALIBRATION.axis):
        d = np.clip(T, parameters["TC_G2_TMIN"], parameters["TC_G2_TMAX"]) - parameters["TC_G2_TREF"]
        offset = sum(parameters[f"TC_G2_X{k}_{place}"] * d**k for k in range(4))
        said = loss(done, axis.name, "bias")
        assert np.max(np.abs(offset - bias(axis, T))) * DEG_PER_H < 0.05
        left = px4_correction(parameters, axis.name, T, 2) - bias(axis, T)
        assert np.max(np.abs(left)) * DEG_PER_H <= 1.5 * said + 1e-3
        steps = np.abs(bias(axis, T + 0.5) - bias(axis, T - 0.5))[5:-5]
        assert loss(done, axis.name, "bias between two updates, 1 °C apart") >= 0.95 * np.max(steps) * DEG_PER_H
    assert any("device id" in note for note in export(CALIBRATION, "px4").notes)


def test_kalibr_carries_the_mean_scale_factor_at_one_temperature():
    done = export(CALIBRATION, "kalibr", temperature_c=25.0)
    lines = done.text.splitlines()
    start = lines.index("  M:") + 1
    matrix = np.array([[float(v) for v in line.strip("- []").split(",")] for line in lines[start : start + 3]])
    rates = np.radians(np.linspace(-300.0, 300.0, 301))
    for k, axis in enumerate(CALIBRATION.axis):
        found = scale_factor(axis, np.full_like(rates, 25.0), rates)
        left = np.max(np.abs(found - (matrix[k, k] - 1.0))) * 1e6
        assert left == pytest.approx(loss(done, axis.name, "scale factor over rate at 25 °C"), rel=1e-3)
    assert np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0
    with pytest.raises(ValueError, match="--temperature"):
        export(CALIBRATION, "kalibr")
    with pytest.raises(ValueError, match="is outside"):
        export(CALIBRATION, "kalibr", temperature_c=90.0)


def coefficients(text):
    """By axis and name, from what the csv export wrote."""
    result = {}
    for row in csv.DictReader(line for line in text.splitlines() if not line.startswith("#")):
        result.setdefault(row["axis"], {})[row["name"]] = float(row["value"])
    return result


def test_csv_loses_nothing():
    found = coefficients(export(CALIBRATION, "csv").text)
    assert found == {axis.name: axis.values() for axis in CALIBRATION.axis}


@pytest.mark.parametrize(
    "calibration",
    [CALIBRATION, parse_calibration(HEAD + axis_text("x", SPLINE_T, POLYNOMIAL_W, n_t=6))],
    ids=["polynomials", "spline"],
)
def test_the_c_header_compiles_and_does_what_apply_does(calibration, tmp_path):
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("there is no C compiler here")
    done = export(calibration, "c-header")
    (tmp_path / "calibration.h").write_text(done.text, encoding="utf-8")
    (tmp_path / "main.c").write_text(PROGRAM, encoding="utf-8")
    command = [compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off"]
    built = subprocess.run(
        [*command, "-o", "main", "main.c", "-lm"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    rng = np.random.default_rng(0)
    count = len(calibration.axis)
    temperature = np.float32(rng.uniform(-30, 70, 200)).astype(float)
    truth = np.radians(rng.uniform(-295, 295, (200, count)))
    said = np.stack([measured(a, truth[:, k], temperature) for k, a in enumerate(calibration.axis)], axis=1)
    lines = "\n".join(" ".join(f"{v:.9g}" for v in (t, *row)) for t, row in zip(temperature, said, strict=True))
    ran = subprocess.run([tmp_path / "main"], input=lines, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, "the header's own self-test failed"
    out = np.array([[float(v) for v in line.split()] for line in ran.stdout.splitlines()])
    for k, axis in enumerate(calibration.axis):
        np.testing.assert_allclose(out[:, k], c_header.corrected(axis, said[:, k], temperature), rtol=2e-6, atol=1e-8)
        off = np.abs(out[:, k] - correct(axis, said[:, k], temperature))
        turning = np.abs(truth[:, k]) > np.radians(40.0)
        stated = loss(done, axis.name, "turning, of the rate")
        assert np.max(off[turning] / np.abs(truth[turning, k])) * 1e6 < 1.5 * stated + 0.5


PROGRAM = """
#include <stdio.h>
#include "calibration.h"
int main(void)
{
    float out[GRADCAL_AXES], raw[GRADCAL_AXES], t;
    gradcal_correct(GRADCAL_TEST_T, gradcal_test_raw, out);
    for (int k = 0; k < GRADCAL_AXES; k++) {
        float d = out[k] - gradcal_test_out[k];
        if ((d < 0 ? -d : d) > GRADCAL_TEST_TOLERANCE) return 1;
    }
    while (scanf("%f", &t) == 1) {
        for (int k = 0; k < GRADCAL_AXES; k++) if (scanf("%f", &raw[k]) != 1) return 2;
        gradcal_correct(t, raw, out);
        for (int k = 0; k < GRADCAL_AXES; k++) printf("%.9g ", (double)out[k]);
        printf("\\n");
    }
    return 0;
}
"""


def test_what_did_not_pass_is_zero_and_says_so():
    done = export(CALIBRATION, "csv", zeroed=("x.a3", "b33"))
    found = coefficients(done.text)
    assert found["x"]["a3"] == found["x"]["b33"] == found["z"]["b33"] == 0.0
    assert found["y"]["a3"] == CALIBRATION.axis_of("y").values()["a3"]
    assert "set to zero: x.a3, x.b33, y.b33, z.b33" in done.notes
    assert "set to zero" in export(CALIBRATION, "c-header", zeroed=("x.a3",)).text
    with pytest.raises(ValueError, match="no coefficient q9"):
        export(CALIBRATION, "csv", zeroed=("q9",))


def test_what_a_target_cannot_take_is_a_sentence():
    with pytest.raises(ValueError, match="known are"):
        export(CALIBRATION, "betaflight")
    with pytest.raises(ValueError, match="1 to 3"):
        export(CALIBRATION, "ardupilot", instance=4)
    named = parse_calibration(HEAD + axis_text("roll"))
    for target in ("ardupilot", "px4"):
        with pytest.raises(ValueError, match="none of them fits"):
            export(named, target)
    assert set(FORMATS) == {"ardupilot", "px4", "kalibr", "c-header", "csv"}
    assert all("SIMULATED" in export(CALIBRATION, t, temperature_c=20.0).notes[-1] for t in FORMATS)


@pytest.mark.parametrize("target", ["ardupilot", "px4"])
def test_a_bias_that_is_unknown_is_not_exported_as_zeros(target):
    text = WHOLE
    head, rest = text.split('name = "y"', 1)
    begin, end = rest.index("[axis.bias]"), rest.index("[axis.scale_factor]")
    without = parse_calibration(f'{head}name = "y"{rest[:begin]}{rest[end:]}')
    with pytest.raises(ValueError, match="none of axis y: zeros would pass for a calibration"):
        export(without, target, instance=1, device_id=7)
    assert export(without, "csv").text
