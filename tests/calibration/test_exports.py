"""Every export, read back in the target's own arithmetic: within the loss it states, and the loss is a real one."""

import csv
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import yaml
from calibration_samples import SPLINE_T, G, a_truth, axis, calibration_of, gyro, largest, of, readings, term
from calibration_samples import WHOLE as CALIBRATION
from controllers import TAKEN_OFF, parameters_of

from gradcal_jax.calibration.c_header import Header
from gradcal_jax.calibration.correction import correct
from gradcal_jax.calibration.equation import SIGNALS, map_of
from gradcal_jax.calibration.exports import FORMATS, export, linear_at
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.spec import presets

DEG_PER_H = np.degrees(1.0) * 3600.0
IMU = calibration_of(a_truth())
T = np.linspace(-30.0, 70.0, 501)
MOVING = "within the ranges of rates and forces"


def loss(done, channel, what):
    return next(one.value for one in done.losses if one.channel == channel and one.what == what)


def bias(channel, temperature):
    return map_of(channel, channel.term_of("bias"), temperature)(0.0 * temperature)


@pytest.mark.parametrize("target", ["ardupilot", "px4"])
@pytest.mark.parametrize("calibration", [CALIBRATION, IMU], ids=["axes", "imu"])
def test_flight_controllers_take_the_biases_off_within_what_is_said(target, calibration):
    done = export(calibration, target, instance=2, device_id=4259850)
    told = parameters_of(done.text, target)
    for channel in calibration.channel:
        taken = TAKEN_OFF[target](told, "xyz".index(channel.axis), T, 2, channel.kind)
        assert largest(taken - bias(channel, T)) < (1e-8 if channel.kind == "gyro" else 1e-6) * 3.0
        if target == "px4":  # it corrects in steps of 1 °C
            fine = np.linspace(-30.0, 70.0, 1001)
            steps = largest(bias(channel, fine) - bias(channel, np.floor(fine)))
            factor = DEG_PER_H if channel.kind == "gyro" else 1e6 / G
            assert loss(done, channel.label, "at rest") == pytest.approx(steps * factor, rel=1e-3)
        assert loss(done, channel.label, MOVING) > 1000.0
    if target == "px4":
        assert (told["TC_G2_ID"], told["TC_G_ENABLE"]) == (4259850, 1)
        rows = [line.split("\t") for line in done.text.splitlines()]
        assert all(len(row) == 5 and row[:2] == ["1", "1"] and row[4] in ("6", "9") for row in rows)
        assert any("device id" in note for note in export(calibration, "px4").notes)
    elif calibration is IMU:
        gain = linear(a_truth(), "accelerometer", 20.0)[0][0, 0]
        assert told["INS_ACC2SCAL_X"] == pytest.approx(1.0 / gain, rel=1e-7)
        # Where the scale is that of the temperature, a share of the bias's rounding is left.
        assert loss(done, "gyro x", "at rest") < 0.1


def test_one_axis_leaves_the_other_channels_as_they_are():
    alone = of(axis("y"))
    done = export(alone, "matrices", temperature_c=25.0)
    matrix = np.array(yaml.safe_load(done.text)["gyro"]["matrix"])
    assert np.count_nonzero(matrix - np.eye(3)) == 1
    assert matrix[1, 1] != 1.0
    assert any("accelerometer z" in note and "gyro y" not in note for note in done.notes)


# Means of the powers of the rate over -1 … 1, in 201 steps.
MEANS = {f"b{j}": np.mean(np.linspace(-1.0, 1.0, 201) ** j) for j in range(4)}


def linear(truth, kind, at):
    """Matrix and bias of a kind at one temperature, by names: an own reading of them. Scale factors multiply the rows
    of the sensors' axes."""
    warm, axes, gain, bias = (at - 20.0) / 50.0, np.eye(3), np.ones(3), np.zeros(3)
    for i, a in enumerate("xyz"):
        for name, value in truth.items():
            head, _, symbol = name.partition(".")
            if head != f"{kind}_{a}":
                continue
            if symbol[0] == "a":
                bias[i] += value * warm ** int(symbol[1:])
            elif symbol[0] == "s" or symbol[:2] in MEANS:
                gain[i] += MEANS.get(symbol[:2], 1.0) * value * warm ** int(symbol[-1])
            elif symbol.startswith("m_"):
                axes[i, "xyz".index(symbol[2])] += value * warm ** int(symbol[3:])
    return np.diag(gain) @ axes, bias


def test_kalibr_s_form_is_the_same_imu_in_its_own_frame():
    truth, at = a_truth(), 33.0
    gyro, _ = linear(truth, "gyro", at)
    force, _ = linear(truth, "accelerometer", at)
    form = {name: np.array(of) for name, of in linear_at(IMU, at)["kalibr"].items()}
    for matrix in (form["accelerometer"], form["gyro"]):
        assert largest(np.triu(matrix, 1)) < 1e-15
    for rotation in (form["rotation"], form["frame"]):
        assert largest(rotation @ rotation.T - np.eye(3)) < 1e-14
        assert np.linalg.det(rotation) > 0.0
    assert largest(form["accelerometer"] @ form["frame"] - force) < 1e-14
    assert largest(form["gyro"] @ form["rotation"] @ form["frame"] - gyro) < 1e-14
    text = export(IMU, "kalibr", temperature_c=at).text
    written = yaml.safe_load(text)
    assert largest(np.array(written["accelerometers"]["M"]) - form["accelerometer"]) == 0.0
    assert largest(np.array(written["gyroscopes"]["C_gyro_i"]) - form["rotation"]) == 0.0


def test_matrices_correct_what_the_imu_says():
    truth, at = a_truth(), -12.0
    written = yaml.safe_load(export(IMU, "matrices", temperature_c=at).text)
    force = np.array([1.0, -4.0, 8.0])
    matrix, bias = linear(truth, "accelerometer", at)
    raw = matrix @ force + bias
    again = np.array(written["accelerometer"]["matrix"]) @ (raw - np.array(written["accelerometer"]["bias"]))
    assert largest(again - force) < 1e-13


def csv_rows(calibration):
    text = export(calibration, "csv").text
    return list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))


@pytest.mark.parametrize("calibration", [CALIBRATION, IMU], ids=["axes", "imu"])
def test_csv_loses_nothing(calibration):
    read = {f"{row['channel']}.{row['name']}": float(row["value"]) for row in csv_rows(calibration)}
    assert read == calibration.values()
    assert export(calibration, "csv").losses == ()


@pytest.mark.parametrize("calibration", [CALIBRATION, IMU], ids=["axes", "imu"])
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_c_header_compiles_and_does_what_apply_does(calibration, tmp_path):
    done = export(calibration, "c-header")
    (tmp_path / "calibration.h").write_text(done.text, encoding="utf-8")
    (tmp_path / "main.c").write_text(PROGRAM, encoding="utf-8")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-ffp-contract=off"]
    subprocess.run(["cc", *strict, "main.c", "-o", "main"], cwd=tmp_path, check=True)
    log, *_ = readings(a_truth(), 200)
    read = np.concatenate([log.rate_rad_per_s[0], log.specific_force_m_per_s2[0]], axis=1)
    known = dict(zip(SIGNALS, read.T, strict=True))
    header = Header(calibration)
    inputs = header.inputs
    said = np.float32(np.stack([known[name] for name in inputs], axis=1)).astype(float)
    temperature = np.float32(log.temperature_c[0]).astype(float)
    lines = "\n".join(" ".join(f"{v:.9g}" for v in (t, *row)) for t, row in zip(temperature, said, strict=True))
    ran = subprocess.run([tmp_path / "main"], input=lines, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, "the header's own self-test failed"
    out = np.array([[float(v) for v in line.split()] for line in ran.stdout.splitlines()])
    assert largest(out - header.corrected(said.T, temperature).T) < 1e-5
    exact = correct(calibration.channel, inputs, said.T, temperature)
    for channel in calibration.channel:
        off = largest(out[:, inputs.index(channel.input)] - exact[inputs.index(channel.input)])
        stated = next(one for one in done.losses if (one.channel, one.what) == (channel.label, MOVING))
        full_scale = np.radians(300.0) if channel.kind == "gyro" else G
        assert off / full_scale * 1e6 < 2.0 * stated.value + 0.5
        assert stated.value < 1.0
    code = re.sub(r"/\*.*?\*/", "", done.text, flags=re.DOTALL)
    assert "/" not in code  # no division


def test_what_follows_the_path_of_the_temperature_is_counted_or_named():
    """Of a gyro whose error depends on dT/dt as a term and under [[path]], on a lag and a hysteresis."""
    path = {"channel": "gyro_y", "name": "hysteresis_10K", "value": 1e-5, "standard_deviation": 1e-5}
    path |= {"unit": "rad/s/K", "width": "10 K"}
    slope = term("bias_gradient", "rad/K", ["temperature rate"], {"d": 2e-3})
    made = IMU.model_dump(mode="json", exclude_unset=True)
    made["channel"][0] |= {"term": [*made["channel"][0]["term"], slope], "thermal_lag": "120 s"}
    calibration = Calibration.model_validate(made | {"path": [path]})
    lags = {(row["channel"], row["term"]): row["lag_s"] for row in csv_rows(calibration)}
    assert (lags["gyro_x", "bias"], lags["gyro_y", "bias"]) == ("120.0", "0.0")
    of_x = calibration.channel[0]
    behind = bias(of_x, T[:-10] + 2.0) - bias(of_x, T[:-10])
    for target in set(FORMATS) - {"template"}:
        done = export(calibration, target, temperature_c=25.0)
        assert "gyro y hysteresis 10K, 1e-05 rad/s/K: the target has no place for it" in done.notes
    # The lag and the term in dT/dt together, at the worst temperature.
    one = next(one for one in export(calibration, "c-header").losses if one.what == "while the temperature changes")
    assert (one.channel, one.unit) == ("gyro x", "deg/h at 1 K/min")
    assert one.value == pytest.approx(largest(2e-3 / 60.0 - behind) * DEG_PER_H, rel=1e-2)


PROGRAM = """
#include <stdio.h>
#include "calibration.h"
int main(void)
{
    float out[GRADCAL_CHANNELS], raw[GRADCAL_CHANNELS], t;
    gradcal_correct(GRADCAL_TEST_T, gradcal_test_raw, out);
    for (int k = 0; k < GRADCAL_CHANNELS; k++) {
        float d = out[k] - gradcal_test_out[k];
        if ((d < 0 ? -d : d) > GRADCAL_TEST_TOLERANCE) return 1;
    }
    while (scanf("%f", &t) == 1) {
        for (int k = 0; k < GRADCAL_CHANNELS; k++) if (scanf("%f", &raw[k]) != 1) return 2;
        gradcal_correct(t, raw, out);
        for (int k = 0; k < GRADCAL_CHANNELS; k++) printf("%.9g ", (double)out[k]);
        printf("\\n");
    }
    return 0;
}
"""


def test_the_header_takes_the_rounds_that_large_errors_need():
    large = of(axis("x", size=0.05))
    done = export(large, "c-header")
    header = Header(large)
    assert int(re.search(r"round < (\d+)", done.text)[1]) == header.rounds > 6
    assert loss(done, "gyro x", "at rest") < 0.2
    truth, at = np.radians(np.linspace(-290.0, 290.0, 41)), np.full(41, 55.0)
    last = header.corrected(gyro(large, truth, at)[None], at)
    assert largest(last[0] - truth) < 2e-6


def test_what_a_target_cannot_take_is_a_sentence():
    for target, how, said in (
        ("betaflight", {}, "known are"),
        ("ardupilot", {"instance": 4}, "1 to 3"),
        ("kalibr", {}, "--temperature"),
        ("matrices", {}, "--temperature"),
        ("kalibr", {"temperature_c": 90.0}, "is outside"),
    ):
        with pytest.raises(ValueError, match=said):
            export(CALIBRATION, target, **how)
    with pytest.raises(ValueError, match="bias of gyro x has knots"):
        export(of(axis("x", SPLINE_T)), "c-header")
    named = of(axis("roll"))
    for target in ("ardupilot", "px4"):
        with pytest.raises(ValueError, match="none of them fits"):
            export(named, target)
    done = [export(CALIBRATION, t, temperature_c=20.0, template="x") for t in FORMATS]
    assert all("SIMULATED" in of.notes[-1] for of in done)


@pytest.mark.parametrize("target", ["ardupilot", "px4"])
def test_a_bias_that_is_unknown_is_not_exported_as_zeros(target):
    of_y = CALIBRATION.channel[1]
    less = of_y.model_copy(update={"term": of_y.term[1:]})
    without = CALIBRATION.model_copy(update={"channel": (CALIBRATION.channel[0], less, CALIBRATION.channel[2])})
    with pytest.raises(ValueError, match="no bias of gyro y: zeros would look like a calibration"):
        export(without, target, instance=1, device_id=7)
    assert export(without, "csv").text


# --- a template of one's own ------------------------------------------------------------------------------------------


def test_a_template_sees_matrices_maps_and_noise():
    form = linear_at(CALIBRATION, 25.0)
    text = (
        '{{ "%.12g" | format(gyro.bias[0] | unit("deg/h")) }} {{ "%.12g" | format(accelerometer.inverse[1][2]) }} '
        '{{ "%.12g" | format(at(40).gyro.matrix[2][0]) }} {{ serial_number }}'
    )
    done = export(CALIBRATION, "template", temperature_c=25.0, template=text)
    bias, inverse, later, name = done.text.split(maxsplit=3)
    assert float(bias) == pytest.approx(form["gyro"]["bias"][0] * DEG_PER_H, rel=1e-9)
    assert float(inverse) == pytest.approx(np.linalg.inv(form["accelerometer"]["matrix"])[1, 2], rel=1e-9)
    assert float(later) == pytest.approx(linear_at(CALIBRATION, 40.0)["gyro"]["matrix"][2][0], rel=1e-9)
    assert name == CALIBRATION.serial_number
    assert done.losses
    assert not export(CALIBRATION, "template", template="nothing").losses


@pytest.mark.parametrize("name", ["gains", "tracker", "ins"])
def test_the_templates_that_are_shipped_fill_in(name):
    text = export(CALIBRATION, name, temperature_c=25.0).text
    own = presets.template(f"export-{name}.j2")
    assert export(CALIBRATION, "template", temperature_c=25.0, template=own).text == text
    assert CALIBRATION.serial_number in text
    assert "{{" not in text
    if name == "tracker":
        matrix = np.array(json.loads(text)["gyro"]["matrix"])
        assert matrix == pytest.approx(np.linalg.inv(linear_at(CALIBRATION, 25.0)["gyro"]["matrix"]))


@pytest.mark.parametrize(
    ("template", "said"),
    [
        ("{{ nothing }}", "the template can use the names"),
        ("{{ gyro.bias }}", "'gyro' is undefined"),
        ("{% for %}", "line 1"),
        ("{{ serial_number.__class__.__mro__ }}", "__mro__|unsafe"),
        ('{{ 1.0 | unit("parrot") }}', "parrot"),
        ('{{ "{0.__class__.__mro__}".format(serial_number) }}', "unsafe"),
        ("{% for i in range(10000000) %}{% endfor %}", "too big"),
        ("{{ 1 / 0 }}", "division by zero"),
    ],
)
def test_templates_that_cannot_be_filled_in_are_sentences(template, said):
    with pytest.raises(ValueError, match=said):
        export(CALIBRATION, "template", template=template)
