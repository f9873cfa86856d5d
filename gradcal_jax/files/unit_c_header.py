"""A whole unit's calibration as a C header: tables of terms, and a pure function in float32 with a self-test."""

import numpy as np

from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.c_header import CLIP, c_array, comment, header_head, header_self_test, in_powers, literal
from gradcal_jax.files.log import Floats
from gradcal_jax.files.unit_calibration import SIGNALS, CalibratedTerm, UnitCalibration
from gradcal_jax.files.unit_correction import correct_unit, linear_part
from gradcal_jax.units import DEG_PER_H, G

_ROUNDS = 6
_POINTS = 200
_NONE, _SIZE = 6, 8


def write_unit(calibration: UnitCalibration) -> tuple[str, list[tuple[str, str, float, str]]]:
    """The header's text, and the largest error of its float32 against the calibration itself, by channel."""
    terms = [(c, term) for c in calibration.channel for term in c.term]
    for channel, term in terms:
        for basis, kind in ((term.temperature, TemperaturePolynomial), (term.rate, RatePolynomial)):
            if basis is not None and not isinstance(basis, kind):
                raise ValueError(
                    f"{channel.name}'s {term.name} is no polynomial ({basis.basis}), and the header knows nothing "
                    "else: export to csv, or estimate with polynomials"
                )
    errors, test = _errors(calibration)
    inverse = _inverse(calibration)
    low, high = (float(t) for t in calibration.valid_temperature)
    slow, fast = (float(r) for r in calibration.valid_rate)
    remarks = [
        "measured = input + sum of map(T) * signals, solved for the inputs; frame: " + comment(calibration.frame),
        "temperature in degC, rates in rad/s, specific force in m/s^2; x, y, z. Beyond its range the values at the",
        "edge hold. Channels that the calibration lacks stay unchanged.",
    ]
    lines = [*header_head(calibration, "calibration of the unit", remarks, "GRADCAL_UNIT_CALIBRATION_H"), _STRUCT]
    lines += [c_array(f"gradcal_c{k}[]", term.coefficients.values()) for k, (_, term) in enumerate(terms)]
    lines += ["", f"#define GRADCAL_TERMS {len(terms)}"]
    lines += ["static const struct gradcal_term gradcal_terms[GRADCAL_TERMS] = {"]
    for k, (channel, term) in enumerate(terms):
        signals = [_signal(name) for name in term.signals] + [_NONE] * (3 - len(term.signals))
        t0, ts, nt, w0, ws, nw = _shape(term)
        numbers = ", ".join(literal(v) for v in (t0, 1.0 / ts, w0, 1.0 / ws))
        lines.append(
            f"    {{{channel.place}, {{{', '.join(map(str, signals))}}}, {numbers}, {nt}, {nw}, gradcal_c{k}}},"
        )
    lines += ["};", "", "/* of the linear part at the middle of the temperatures */"]
    rows = ",\n".join("    {" + ", ".join(literal(v) for v in row) + "}" for row in inverse)
    lines += [f"static const float gradcal_inverse[6][6] = {{\n{rows}\n}};"]
    lines += ["", f"#define GRADCAL_T_MIN {literal(low)}", f"#define GRADCAL_T_MAX {literal(high)}"]
    lines += [f"#define GRADCAL_W_MIN {literal(slow)}", f"#define GRADCAL_W_MAX {literal(fast)}", "", _FUNCTION]
    temperature, raw, expected = test
    rounding = float(np.max(np.abs(inverse) @ np.abs(raw)))  # of raw counts far off zero
    tolerance = max(4e-6 * float(np.max(np.abs(expected))), 4e-7 * rounding, 1e-7)
    lines += header_self_test(temperature, raw, expected, "6", tolerance)
    return "\n".join(lines) + "\n", errors


_STRUCT = """\
struct gradcal_term {
    int of;                /* 0-2: gyro x, y, z; 3-5: accelerometer x, y, z */
    int signal[3];         /* factors: numbered likewise; 6: none; 8 more: its magnitude */
    float t_centre, t_inverse;   /* degC, 1/K */
    float w_centre, w_inverse;   /* rad/s, s/rad: of the gyro's own rate */
    int t_count, w_count;
    const float *c;        /* SI; powers of temperature slow, of rate fast */
};
"""
_FUNCTION = (
    CLIP
    + """\
/* Corrects one reading: rates x, y, z, then specific forces x, y, z; `out` must not be `raw`. */
static inline void gradcal_correct(float temperature, const float raw[6], float out[6])
{
    const float t = gradcal_clip(temperature, GRADCAL_T_MIN, GRADCAL_T_MAX);
    for (int k = 0; k < 6; k++) out[k] = 0.0f;
    for (int round = 0; round < """
    + str(_ROUNDS)
    + """; round++) {
        float error[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
        for (int k = 0; k < GRADCAL_TERMS; k++) {
            const struct gradcal_term *a = &gradcal_terms[k];
            const float x = (t - a->t_centre) * a->t_inverse;
            const float own = gradcal_clip(out[a->of], GRADCAL_W_MIN, GRADCAL_W_MAX);
            const float w = (own - a->w_centre) * a->w_inverse;
            float value = 0.0f;
            for (int i = a->t_count - 1; i >= 0; i--) {
                float row = 0.0f;
                for (int j = a->w_count - 1; j >= 0; j--) row = row * w + a->c[i * a->w_count + j];
                value = value * x + row;
            }
            for (int j = 0; j < 3; j++) {
                const int s = a->signal[j] & 7;
                if (s == 6) continue;
                value *= (a->signal[j] & 8) && out[s] < 0.0f ? -out[s] : out[s];
            }
            error[a->of] += value;
        }
        for (int k = 0; k < 6; k++) error[k] = raw[k] - out[k] - error[k];
        for (int k = 0; k < 6; k++) {
            for (int j = 0; j < 6; j++) out[k] += gradcal_inverse[k][j] * error[j];
        }
    }
}
"""
)


def _signal(name: str) -> int:
    return SIGNALS.index(name.strip("|")) + (_SIZE if name.startswith("|") else 0)


def _shape(term: CalibratedTerm) -> tuple[float, float, int, float, float, int]:
    """Centre, scale and number of powers, of temperature and of rate."""
    t, w = term.temperature, term.rate
    t0, ts, nt = (float(t.centre), float(t.scale), t.size) if isinstance(t, TemperaturePolynomial) else (0.0, 1.0, 1)
    w0, ws, nw = (float(w.centre), float(w.scale), w.size) if isinstance(w, RatePolynomial) else (0.0, 1.0, 1)
    return t0, ts, nt, w0, ws, nw


def _inverse(calibration: UnitCalibration) -> Floats:
    """(6, 6): the divisor of each channel's error."""
    low, high = (float(t) for t in calibration.valid_temperature)
    return np.asarray(np.linalg.inv(linear_part(calibration.channel, 0.5 * (low + high))[0]), np.float64)


def corrected_in_single(calibration: UnitCalibration, raw: Floats, temperature_c: Floats) -> Floats:
    """The result of the header's function, computed in float32 as there: `(n, 6)`."""
    f = np.float32
    low, high = (f(float(v)) for v in calibration.valid_temperature)
    slow, fast = (f(float(v)) for v in calibration.valid_rate)
    t, reading = np.clip(temperature_c.astype(f), low, high), raw.astype(f)
    out, inverse = np.zeros_like(reading), _inverse(calibration).astype(f)
    for _ in range(_ROUNDS):
        error = np.zeros_like(out)
        for channel in calibration.channel:
            for term in channel.term:
                t0, ts, nt, w0, ws, nw = _shape(term)
                x = (t - f(t0)) * f(1.0 / ts)
                w = (np.clip(out[:, channel.place], slow, fast) - f(w0)) * f(1.0 / ws)
                table = np.array(list(term.coefficients.values()), f).reshape(nt, nw)
                value = in_powers(table, x, w)
                for name in term.signals:
                    signal = out[:, SIGNALS.index(name.strip("|"))]
                    value = value * (np.abs(signal) if name.startswith("|") else signal)
                error[:, channel.place] += value
        left = reading - out - error
        for j in range(6):
            out += inverse[:, j] * left[:, j : j + 1]
    return out.astype(np.float64)


def _errors(calibration: UnitCalibration) -> tuple[list[tuple[str, str, float, str]], tuple[float, Floats, Floats]]:
    """The largest error of the header by channel; and a reading, no round number, with the header's result."""
    rng = np.random.default_rng(0)
    low, high = (float(t) for t in calibration.valid_temperature)
    slow, fast = (float(r) for r in calibration.valid_rate)
    temperature = rng.uniform(low, high, _POINTS)
    inputs = np.concatenate([rng.uniform(slow, fast, (_POINTS, 3)), rng.uniform(-G, G, (_POINTS, 3))], axis=1)
    matrix, bias = linear_part(calibration.channel, 0.5 * (low + high))
    raw = inputs @ matrix.T + bias
    raw, temperature = raw.astype(np.float32).astype(np.float64), temperature.astype(np.float32).astype(np.float64)
    rate, force = correct_unit(
        calibration.channel, raw[:, :3], raw[:, 3:], temperature, temperatures=(low, high), rates=(slow, fast)
    )
    in_header = corrected_in_single(calibration, raw, temperature)
    apart = np.max(np.abs(in_header - np.concatenate([rate, force], axis=1)), axis=0)
    errors: list[tuple[str, str, float, str]] = []
    for channel in calibration.channel:
        unit, factor = ("deg/h", DEG_PER_H) if channel.kind == "gyro" else ("ug", 1e6 / G)
        errors.append((f"{channel.kind} {channel.axis}", "rounding", float(apart[channel.place]) * factor, unit))
    return errors, (float(temperature[0]), raw[0], in_header[0])
