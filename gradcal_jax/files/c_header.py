"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The headers' texts are `templates/calibration.h`, of single axes, and `templates/unit_calibration.h`, of a whole unit.
"""

from collections.abc import Iterable, Sequence
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.files import correction, presets
from gradcal_jax.files.bases import RatePolynomial, TemperaturePolynomial
from gradcal_jax.files.calibration import AxisCalibration, Calibration
from gradcal_jax.files.log import Floats
from gradcal_jax.files.polynomials import normalised_bias, normalised_scale_factor
from gradcal_jax.files.unit_calibration import SIGNALS, CalibratedTerm, UnitCalibration
from gradcal_jax.files.unit_correction import correct_unit, linear_part
from gradcal_jax.units import DEG_PER_H, G

_ROUNDS, _UNIT_ROUNDS = 8, 6
_GRID, _POINTS = 41, 200
# Numbers of a header's signals: of none, and what a magnitude's has in addition.
_NONE, _SIZE = 6, 8

Errors = list[tuple[str, str, float, str]]


def axes_header(calibration: Calibration, left_out: Sequence[str]) -> tuple[str, Errors]:
    """The header's text, and for each axis the largest error of its float32 against the calibration itself."""
    errors: Errors = []
    arrays: list[str] = []
    rows: list[str] = []
    for number, axis in enumerate(calibration.axis):
        constants, row = _of_axis(axis, number)
        arrays += constants
        rows.append(row)
        temperature, rate = _grid(axis)
        output = correction.measured(axis, rate, temperature)
        off = np.abs(corrected(axis, output, temperature) - rate)
        still = np.abs(rate) < 1e-12
        errors.append((axis.name, "at rest", float(np.max(off[still], initial=0.0)) * DEG_PER_H, "deg/h"))
        turning = np.abs(rate) > 0.1 * max(float(np.max(np.abs(rate))), 1e-12)
        if turning.any():
            relative = float(np.max(off[turning] / np.abs(rate[turning]))) * 1e6
            errors.append((axis.name, "turning, of the rate", relative, "ppm"))
    at, raw, out = _self_test(calibration)
    text = _filled(
        "calibration.h",
        calibration,
        [f"set to zero, since they did not pass: {_comment(', '.join(left_out))}"] if left_out else [],
        (at, raw, out, max(2e-6 * float(np.max(np.abs(out))), 1e-9)),
        axes=", ".join(f"[{k}] {_comment(axis.name)}" for k, axis in enumerate(calibration.axis)),
        count=len(rows),
        rounds=_ROUNDS,
        arrays="\n".join(arrays),
        rows="\n".join(rows),
    )
    return text, errors


def unit_header(calibration: UnitCalibration) -> tuple[str, Errors]:
    """The header's text, and the largest error of its float32 against the calibration itself, by channel."""
    terms = [(c, term) for c in calibration.channel for term in c.term]
    for channel, term in terms:
        for basis, kind in ((term.temperature, TemperaturePolynomial), (term.rate, RatePolynomial)):
            if basis is not None and not isinstance(basis, kind):
                raise ValueError(
                    f"{channel.name}'s {term.name} is no polynomial ({basis.basis}), and the header knows nothing "
                    "else: export to csv, or estimate with polynomials"
                )
    errors, (at, raw, out) = _unit_errors(calibration)
    inverse = _inverse(calibration)
    rows: list[str] = []
    for k, (channel, term) in enumerate(terms):
        signals = [_signal(name) for name in term.signals] + [_NONE] * (3 - len(term.signals))
        t0, ts, nt, w0, ws, nw = _shape(term)
        numbers = _listed((t0, 1.0 / ts, w0, 1.0 / ws))
        rows.append(
            f"    {{{channel.place}, {{{', '.join(map(str, signals))}}}, {numbers}, {nt}, {nw}, gradcal_c{k}}},"
        )
    rounding = float(np.max(np.abs(inverse) @ np.abs(raw)))  # of raw counts far off zero
    (low, high), (slow, fast) = calibration.valid_temperature, calibration.valid_rate
    text = _filled(
        "unit_calibration.h",
        calibration,
        [],
        (at, raw, out, max(4e-6 * float(np.max(np.abs(out))), 4e-7 * rounding, 1e-7)),
        frame=_comment(calibration.frame),
        count=len(terms),
        rounds=_UNIT_ROUNDS,
        arrays="\n".join(_array(f"gradcal_c{k}[]", term.coefficients.values()) for k, (_, term) in enumerate(terms)),
        rows="\n".join(rows),
        inverse=",\n".join(f"    {{{_listed(row)}}}" for row in inverse),
        t_min=_literal(low),
        t_max=_literal(high),
        w_min=_literal(slow),
        w_max=_literal(fast),
    )
    return text, errors


def _filled(
    template: str,
    calibration: Calibration | UnitCalibration,
    remarks: Sequence[str],
    test: tuple[float, Iterable[float], Iterable[float], float],
    **entries: object,
) -> str:
    """A header. `test`: a temperature (°C), readings, the function's results, and how near they must come."""
    at, raw, out, tolerance = test
    known = [_comment(f"{name}: {text}") for name, text in calibration.provenance.items()]
    simulated = ["SIMULATED: made from simulated data, of no real unit."] if calibration.simulated else []
    return Template(presets.template(template)).substitute(
        entries,
        serial_number=_comment(calibration.serial_number),
        remarks="".join(f" * {line}\n" for line in (*known, *simulated, *remarks)),
        temperature=_literal(at),
        raw=_listed(raw),
        out=_listed(out),
        tolerance=_literal(tolerance),
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
    unbiased = measured_rad_per_s.astype(single) - _in_powers(b[:, None], tb, tb)
    rate: Any = unbiased
    for _ in range(_ROUNDS):
        w = (np.clip(rate, slow, fast) - single(mw0)) / single(mws)
        rate = unbiased / (single(1.0) + _in_powers(table, tm, w))
    return rate.astype(np.float64)


def _in_powers(table: NDArray[Any], x: Any, w: Any) -> Any:
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
    n_t, n_w = table.shape
    row = [
        _listed((*axis.valid_temperature, *axis.valid_rate)),
        f"{_listed((bt0, bts))}, {len(b)}, gradcal_b{number}",
        f"{_listed((mt0, mts, mw0, mws))}, {n_t}, {n_w}, gradcal_m{number}",
    ]
    constants = [_array(f"gradcal_b{number}[]", b), _array(f"gradcal_m{number}[]", table.ravel())]
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
    for _ in range(_UNIT_ROUNDS):
        error = np.zeros_like(out)
        for channel in calibration.channel:
            for term in channel.term:
                t0, ts, nt, w0, ws, nw = _shape(term)
                x = (t - f(t0)) * f(1.0 / ts)
                w = (np.clip(out[:, channel.place], slow, fast) - f(w0)) * f(1.0 / ws)
                table = np.array(list(term.coefficients.values()), f).reshape(nt, nw)
                value = _in_powers(table, x, w)
                for name in term.signals:
                    signal = out[:, SIGNALS.index(name.strip("|"))]
                    value = value * (np.abs(signal) if name.startswith("|") else signal)
                error[:, channel.place] += value
        left = reading - out - error
        for j in range(6):
            out += inverse[:, j] * left[:, j : j + 1]
    return out.astype(np.float64)


def _unit_errors(calibration: UnitCalibration) -> tuple[Errors, tuple[float, Floats, Floats]]:
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
    errors: Errors = []
    for channel in calibration.channel:
        unit, factor = ("deg/h", DEG_PER_H) if channel.kind == "gyro" else ("ug", 1e6 / G)
        errors.append((f"{channel.kind} {channel.axis}", "rounding", float(apart[channel.place]) * factor, unit))
    return errors, (float(temperature[0]), raw[0], in_header[0])


def _literal(value: float) -> str:
    """A float32 literal of C."""
    text = f"{np.float32(value):.9g}"
    return (text if any(c in text for c in ".en") else text + ".0") + "f"


def _listed(values: Iterable[float]) -> str:
    return ", ".join(_literal(v) for v in values)


def _array(name: str, values: Iterable[float]) -> str:
    return f"static const float {name} = {{{_listed(values)}}};"


def _comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
