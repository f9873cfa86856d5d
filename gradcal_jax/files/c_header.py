"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.files import correction
from gradcal_jax.files.calibration import AxisCalibration, Calibration
from gradcal_jax.files.log import Floats
from gradcal_jax.files.polynomials import normalised_bias, normalised_scale_factor
from gradcal_jax.files.unit_calibration import UnitCalibration
from gradcal_jax.units import DEG_PER_H

_ROUNDS = 8
_GRID = 41


def header_text(calibration: Calibration, left_out: Sequence[str]) -> tuple[str, list[tuple[str, str, float, str]]]:
    """The header's text, and for each axis the largest error of its float32 against the calibration itself."""
    errors: list[tuple[str, str, float, str]] = []
    body: list[str] = []
    tables = ["static const struct gradcal_axis gradcal_axes[GRADCAL_AXES] = {"]
    for number, axis in enumerate(calibration.axis):
        constants, entry = _of_axis(axis, number)
        body += constants
        tables.append(entry)
        temperature, rate = _grid(axis)
        output = correction.measured(axis, rate, temperature)
        off = np.abs(corrected(axis, output, temperature) - rate)
        still = np.abs(rate) < 1e-12
        errors.append((axis.name, "at rest", float(np.max(off[still], initial=0.0)) * DEG_PER_H, "deg/h"))
        turning = np.abs(rate) > 0.1 * max(float(np.max(np.abs(rate))), 1e-12)
        if turning.any():
            relative = float(np.max(off[turning] / np.abs(rate[turning]))) * 1e6
            errors.append((axis.name, "turning, of the rate", relative, "ppm"))
    count = len(calibration.axis)
    temperature, raw, out = _self_test(calibration)
    axes = ", ".join(f"[{k}] {comment(axis.name)}" for k, axis in enumerate(calibration.axis))
    remarks = [f"set to zero, since they did not pass: {comment(', '.join(left_out))}"] if left_out else []
    remarks += ["measured = (1 + M(T, rate)) * rate + B(T), on each axis alone, in the sensor's own frame:", axes]
    remarks += ["temperature in degC, rates in rad/s. Outside its range the calibration holds its value at the edge."]
    head = header_head(calibration, "gyro calibration of", remarks, "GRADCAL_CALIBRATION_H")
    head += [f"#define GRADCAL_AXES {count}", "", _STRUCT]
    tables += ["};", ""]
    test = header_self_test(temperature, raw, out, "GRADCAL_AXES", max(2e-6 * float(np.max(np.abs(out))), 1e-9))
    return "\n".join([*head, *body, *tables, _FUNCTION, *test]) + "\n", errors


def header_head(calibration: Calibration | UnitCalibration, what: str, remarks: Sequence[str], guard: str) -> list[str]:
    """The comment at the head of a header, and its guard against being included twice."""
    simulated = ["SIMULATED: made from simulated data, of no real unit."] if calibration.simulated else []
    known = [comment(f"{name}: {text}") for name, text in calibration.provenance.items()]
    return [
        f"/* {what} {comment(calibration.serial_number)}, made by gradcal",
        *(f" * {line}" for line in (*known, *simulated, *remarks)),
        " */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "",
    ]


def header_self_test(
    temperature: float, raw: Iterable[float], out: Iterable[float], count: str, within: float
) -> list[str]:
    """The end of a header: a temperature (°C), readings, and the function's expected results."""
    return [
        "/* self-test: gradcal_correct(GRADCAL_TEST_T, raw, out) must give these within GRADCAL_TEST_TOLERANCE */",
        f"#define GRADCAL_TEST_T {literal(temperature)}",
        c_array(f"gradcal_test_raw[{count}]", raw),
        c_array(f"gradcal_test_out[{count}]", out),
        f"#define GRADCAL_TEST_TOLERANCE {literal(within)}",
        "",
        "#endif",
    ]


def c_array(name: str, values: Iterable[float]) -> str:
    """A constant array."""
    return f"static const float {name} = {{{', '.join(literal(v) for v in values)}}};"


_STRUCT = """\
struct gradcal_axis {
    float t_min, t_max;          /* degC */
    float w_min, w_max;          /* rad/s */
    float bt_centre, bt_scale;   /* degC, K */
    int b_count;
    const float *b;              /* rad/s, powers of (T - bt_centre)/bt_scale */
    float mt_centre, mt_scale;   /* degC, K */
    float mw_centre, mw_scale;   /* rad/s */
    int mt_count, mw_count;
    const float *m;              /* ratio; powers of temperature slow, of rate fast */
};
"""

CLIP = """\
static inline float gradcal_clip(float x, float low, float high)
{
    return x < low ? low : (x > high ? high : x);
}

"""
_FUNCTION = (
    CLIP
    + """\
/* Corrects one reading of all axes; `out` may be `raw`. */
static inline void gradcal_correct(float temperature, const float raw[GRADCAL_AXES], float out[GRADCAL_AXES])
{
    for (int k = 0; k < GRADCAL_AXES; k++) {
        const struct gradcal_axis *a = &gradcal_axes[k];
        const float t = gradcal_clip(temperature, a->t_min, a->t_max);
        const float tb = (t - a->bt_centre) / a->bt_scale;
        const float tm = (t - a->mt_centre) / a->mt_scale;
        float bias = 0.0f;
        for (int i = a->b_count - 1; i >= 0; i--) bias = bias * tb + a->b[i];
        const float unbiased = raw[k] - bias;
        float rate = unbiased;
        for (int round = 0; round < """
    + str(_ROUNDS)
    + """; round++) {
            const float w = (gradcal_clip(rate, a->w_min, a->w_max) - a->mw_centre) / a->mw_scale;
            float scale = 0.0f;
            for (int i = a->mt_count - 1; i >= 0; i--) {
                float row = 0.0f;
                for (int j = a->mw_count - 1; j >= 0; j--) row = row * w + a->m[i * a->mw_count + j];
                scale = scale * tm + row;
            }
            rate = unbiased / (1.0f + scale);
        }
        out[k] = rate;
    }
}
"""
)


def corrected(axis: AxisCalibration, measured_rad_per_s: Floats, temperature_c: Floats) -> Floats:
    """The result of the header's function, computed in float32 as there: `(n,)`, rad/s."""
    single = np.float32
    bt0, bts, b = normalised_bias(axis)
    (mt0, mts), (mw0, mws), table = normalised_scale_factor(axis)
    low, high = (single(v) for v in axis.valid_temperature)
    slow, fast = (single(v) for v in axis.valid_rate)
    t = np.clip(temperature_c.astype(single), low, high)
    tb, tm = (t - single(bt0)) / single(bts), (t - single(mt0)) / single(mts)
    unbiased = measured_rad_per_s.astype(single) - in_powers(b[:, None], tb, tb)
    rate: Any = unbiased
    for _ in range(_ROUNDS):
        w = (np.clip(rate, slow, fast) - single(mw0)) / single(mws)
        rate = unbiased / (single(1.0) + in_powers(table, tm, w))
    return rate.astype(np.float64)


def in_powers(table: NDArray[Any], x: Any, w: Any) -> Any:
    """Σ table[i, j] xⁱ wʲ in float32, in the order of the headers' loops."""
    total: Any = np.zeros(x.shape, np.float32)
    for line in table[::-1]:
        row: Any = np.zeros(x.shape, np.float32)
        for value in line[::-1]:
            row = row * w + np.float32(value)
        total = total * x + row
    return total


def _of_axis(axis: AxisCalibration, number: int) -> tuple[list[str], str]:
    """An axis's constants, and its entry in the table of axes."""
    bt0, bts, b = normalised_bias(axis)
    (mt0, mts), (mw0, mws), table = normalised_scale_factor(axis)
    t, w = axis.valid_temperature, axis.valid_rate
    row = [
        ", ".join(literal(v) for v in (t[0], t[1], w[0], w[1])),
        f"{literal(bt0)}, {literal(bts)}, {len(b)}, gradcal_b{number}",
        ", ".join(literal(v) for v in (mt0, mts, mw0, mws))
        + f", {table.shape[0]}, {table.shape[1]}, gradcal_m{number}",
    ]
    constants = [c_array(f"gradcal_b{number}[]", b), c_array(f"gradcal_m{number}[]", table.ravel())]
    return constants, "    {" + ",\n     ".join(row) + "},"


def _grid(axis: AxisCalibration) -> tuple[Floats, Floats]:
    t = np.linspace(float(axis.valid_temperature[0]), float(axis.valid_temperature[1]), _GRID)
    rates = np.linspace(float(axis.valid_rate[0]), float(axis.valid_rate[1]), _GRID)
    grid_t, grid_w = np.meshgrid(t, np.append(rates, 0.0), indexing="ij")
    return grid_t.ravel(), grid_w.ravel()


def _self_test(calibration: Calibration) -> tuple[float, list[float], list[float]]:
    """A temperature and a reading, none a round number, and the result by the header's own polynomials."""
    low = max(float(axis.valid_temperature[0]) for axis in calibration.axis)
    high = min(float(axis.valid_temperature[1]) for axis in calibration.axis)
    at = float(np.float32(low + 0.37 * (high - low)))
    raw: list[float] = []
    out: list[float] = []
    for k, axis in enumerate(calibration.axis):
        slow, fast = float(axis.valid_rate[0]), float(axis.valid_rate[1])
        reading = float(np.float32(slow + (0.71 - 0.11 * (k % 3)) * (fast - slow)))
        raw.append(reading)
        out.append(float(corrected(axis, np.array([reading]), np.array([at]))[0]))
    return at, raw, out


def literal(value: float) -> str:
    """A float32 literal of C."""
    text = f"{np.float32(value):.9g}"
    return (text if any(c in text for c in ".en") else text + ".0") + "f"


def comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
