"""A calibration in the terms of other programs, each evaluated in the target's own arithmetic.

    ardupilot   INS_TCALn_*: biases over temperature, cubics about 35 °C in float32; accelerometers' scale at one T
    px4         TC_G*, TC_A*: biases over temperature, cubics in float32; no scale factor; in steps of 1 °C
    c-header    a float32 function of the whole calibration; polynomial bases only
    kalibr, matrices, csv, gains, tracker, ins
                shipped templates, `templates/export-*.j2`: matrices at one temperature, or every coefficient
    template    a Jinja template of the user's, filled with maps, matrices and noise

Each export reports in numbers what its target cannot carry (see `losses`). The formulas are from the targets' public
sources; no export has been run on a flight controller.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration import c_header
from gradcal_jax.calibration.correction import SIGNALS, linear_part
from gradcal_jax.calibration.file import CalibratedChannel, CalibratedTerm, Calibration, common_span
from gradcal_jax.calibration.losses import Corrected, Loss, losses_of, path_notes
from gradcal_jax.calibration.polynomials import bias_polynomial
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.tables.display import summary

_TRIAD: Final = ("x", "y", "z")


class Export(NamedTuple):
    """`text` for the target's file, the losses, and notes for the user."""

    text: str
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]

    __repr__ = summary


class _Options(NamedTuple):
    target: str
    temperature_c: float | None
    instance: int
    device_id: int | None
    template: str | None
    left_out: tuple[str, ...]


class _Filled(NamedTuple):
    """A target's text, its function of readings of `inputs` (None: nothing that could be evaluated), and notes."""

    text: str
    corrected: Corrected | None
    notes: list[str]
    inputs: Sequence[str] = SIGNALS


def export(
    calibration: Calibration,
    target: str,
    *,
    temperature_c: float | None = None,
    instance: int = 1,
    device_id: int | None = None,
    zeroed: Sequence[str] = (),
    template: str | None = None,
) -> Export:
    """The calibration for a target of `FORMATS`.

    `temperature_c`: for targets of one temperature; `instance`: number of the sensor on the controller (from 1 for
    ArduPilot, from 0 for PX4); `device_id`: PX4's; `template`: the text of one; `zeroed`: coefficients that did not
    pass a validation, which are left out ("gyro_x.a3", "x.a3" or, for every channel, "a3"). Returns the text, and every
    loss with its largest value and unit. Errors: `ValueError` with a sentence for what cannot be exported.
    """
    if target not in FORMATS:
        raise ValueError(f'there is no export format "{target}": known are {", ".join(FORMATS)}')
    plain, left_out = _without(calibration, zeroed)
    options = _Options(target, temperature_c, instance, device_id, template, left_out)
    named = plain if target in ("c-header", "csv", "template") else _in_triad(plain)
    done = FORMATS[target](named, options)
    losses = [] if done.corrected is None else losses_of(named, done.inputs, done.corrected)
    notes = [*done.notes, *path_notes(calibration)]
    if calibration.unobservable and target != "csv":
        notes.append(f"not observed by the data: {', '.join(calibration.unobservable)}")
    if left_out:
        notes.append(f"set to zero: {', '.join(left_out)}")
    if calibration.simulated:
        notes.append("this calibration was made from SIMULATED data")
    return Export(done.text, tuple(losses), tuple(notes))


def _without(calibration: Calibration, zeroed: Sequence[str]) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration with some coefficients set to zero, and their names. Raises `ValueError` for unknown names."""
    known: set[str] = set()
    gone: list[str] = []

    def left(channel: CalibratedChannel, term: CalibratedTerm) -> CalibratedTerm:
        spellings = {n: {n, f"{channel.axis}.{n}", f"{channel.name}.{n}"} for n in term.coefficients}
        zero = [name for name, known_as in spellings.items() if known_as.intersection(zeroed)]
        known.update(*spellings.values())
        gone.extend(f"{channel.name}.{name}" for name in zero)
        return term.model_copy(update={"coefficients": term.coefficients | dict.fromkeys(zero, 0.0)})

    channels = tuple(c.model_copy(update={"term": tuple(left(c, t) for t in c.term)}) for c in calibration.channel)
    if unknown := [name for name in dict.fromkeys(zeroed) if name not in known]:
        raise ValueError(f"the calibration has no coefficient {', '.join(unknown)} that could be set to zero")
    return calibration.model_copy(update={"channel": channels}), tuple(gone)


def _in_triad(calibration: Calibration) -> Calibration:
    """The channels along x, y, z. Raises `ValueError` where there is none."""

    def plain(term: CalibratedTerm) -> CalibratedTerm:
        return term.model_copy(update={"signals": tuple(signal.lower() for signal in term.signals)})

    channels = tuple(
        c.model_copy(update={"axis": c.axis.lower(), "term": tuple(map(plain, c.term))})
        for c in calibration.channel
        if c.axis.lower() in _TRIAD
    )
    if not channels:
        names = ", ".join(channel.axis for channel in calibration.channel)
        raise ValueError(f"the target has axes x, y, z, and the calibration has {names}: none of them fits")
    return calibration.model_copy(update={"channel": channels})


# --- flight controllers -----------------------------------------------------------------------------------------------

ARDUPILOT_REFERENCE: Final = 35.0


def _require_biases(calibration: Calibration, target: str) -> None:
    """Zeros in place of an unknown bias are refused."""
    if without := [channel.label for channel in calibration.channel if channel.term_of("bias") is None]:
        raise ValueError(
            f"{target} takes the bias over temperature, and this calibration has no bias of {', '.join(without)}: "
            "zeros would look like a calibration. Estimate the bias with a spec that has it, or export to c-header or "
            "csv"
        )


def _of_each(calibration: Calibration, one: Callable[[CalibratedChannel, Floats, Floats], Floats]) -> Corrected:
    """A target's function of all channels from that of `one`, of its readings and temperatures."""

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        done = raw.copy()
        for channel in calibration.channel:
            k = SIGNALS.index(channel.input)
            done[:, k] = one(channel, raw[:, k], temperature_c)
        return done

    return corrected


def _single(value: float) -> str:
    """A number that reads back as the same float32."""
    return f"{np.float32(value):.9g}"


def _range_notes(calibration: Calibration, low: float, high: float) -> list[str]:
    return [
        f"{channel.label}: the target's range is {low:g} … {high:g} °C; outside it, the value at its edge is used"
        for channel in calibration.channel
        if low > channel.valid_temperature[0] + 1e-6 or high < channel.valid_temperature[1] - 1e-6
    ]


def _ardupilot(calibration: Calibration, options: _Options) -> _Filled:
    _require_biases(calibration, "ArduPilot")
    number = options.instance
    if not 1 <= number <= 3:
        raise ValueError(f"ArduPilot numbers its sensors 1 to 3, not {number}")
    cold, warm = calibration.valid_temperature
    low, high = max(float(cold), -70.0), min(float(warm), 80.0)
    if high - low < 10.0:
        raise ValueError(f"ArduPilot needs a range of at least 10 K, and this calibration covers {low:g} … {high:g} °C")
    at, place = 0.5 * (low + high), "" if number == 1 else str(number)
    span = (("ENABLE", 1.0), ("TMIN", low), ("TMAX", high))
    parameters = {f"INS_TCAL{number}_{name}": value for name, value in span}
    for kind, of in (("GYR", "gyro"), ("ACC", "accelerometer")):
        channels = [channel for channel in calibration.channel if channel.kind == of]
        for channel in channels:
            letter, b = channel.axis.upper(), bias_polynomial(channel, ARDUPILOT_REFERENCE, 3)
            parameters |= {f"INS_TCAL{number}_{kind}{k}_{letter}": 1e6 * b[k] for k in (1, 2, 3)}
            offset = float(np.polynomial.polynomial.polyval(at - ARDUPILOT_REFERENCE, b))
            parameters[f"INS_{kind}{place}OFFS_{letter}"] = offset
            if kind == "ACC":
                gain = linear_part([channel], at, [channel.input])[0][0, 0]
                parameters[f"INS_{kind}{place}SCAL_{letter}"] = 1.0 / gain
        if channels:
            parameters[f"INS_{kind}{number}_CALTEMP"] = at

    def corrected(channel: CalibratedChannel, raw: Floats, temperature_c: Floats) -> Floats:
        kind = "GYR" if channel.kind == "gyro" else "ACC"
        done = raw - ardupilot_correction(parameters, channel.axis, temperature_c, number, kind)
        return done * parameters.get(f"INS_{kind}{place}SCAL_{channel.axis.upper()}", 1.0)

    notes = _range_notes(calibration, low, high)
    notes.append("sensor's own axes, before the board's rotation; corrected = raw - P(T-35) + P(Tcal-35) - OFFS")
    if any(channel.kind == "accelerometer" for channel in calibration.channel):
        notes.append(
            "accelerometers: the result is also multiplied by SCAL, computed for the middle of the temperature range"
        )
    text = "".join(f"{name} {_single(value)}\n" for name, value in parameters.items())
    return _Filled(text, _of_each(calibration, corrected), notes)


def ardupilot_correction(
    parameters: Mapping[str, float], axis: str, temperature_c: Floats, number: int = 1, kind: str = "GYR"
) -> Floats:
    """ArduPilot's correction of a raw rate (rad/s), or force (m/s², before its scale; `kind` ACC), in float32."""
    value = {name: np.float32(v) for name, v in parameters.items()}
    letter, place = axis.upper(), "" if number == 1 else str(number)
    c1, c2, c3 = (value[f"INS_TCAL{number}_{kind}{k}_{letter}"] for k in (1, 2, 3))
    low, high = value[f"INS_TCAL{number}_TMIN"], value[f"INS_TCAL{number}_TMAX"]

    def polynomial(t: Any) -> Any:
        d = np.clip(t, low, high) - np.float32(ARDUPILOT_REFERENCE)
        return (d * c1 + d * d * c2 + d * d * d * c3) * np.float32(1e-6)

    at = polynomial(value[f"INS_{kind}{number}_CALTEMP"])
    offset = value[f"INS_{kind}{place}OFFS_{letter}"]
    return np.asarray(polynomial(temperature_c.astype(np.float32)) - at + offset, np.float64)


def _px4(calibration: Calibration, options: _Options) -> _Filled:
    _require_biases(calibration, "PX4")
    number, identity = options.instance, options.device_id
    if not 0 <= number <= 3:
        raise ValueError(f"PX4 numbers its sensors 0 to 3, not {number}")
    low, high = map(float, common_span(c.valid_temperature for c in calibration.channel))
    if not high >= low:
        raise ValueError("the channels' temperature ranges do not overlap, and PX4 has one range for all of them")
    about = float(round(0.5 * (low + high)))
    parameters: dict[str, float] = {}
    lines: list[str] = []
    notes = _range_notes(calibration, low, high)
    for of, letter, offsets in (("gyro", "G", "CAL_GYRO"), ("accelerometer", "A", "CAL_ACC")):
        channels = [channel for channel in calibration.channel if channel.kind == of]
        if not channels:
            continue
        head = f"TC_{letter}{number}"
        lines += [f"1\t1\tTC_{letter}_ENABLE\t1\t6", f"1\t1\t{head}_ID\t{int(identity or 0)}\t6"]
        values = {f"{head}_{name}": value for name, value in (("TREF", about), ("TMIN", low), ("TMAX", high))}
        for channel in channels:
            b, place = bias_polynomial(channel, about, 3), _TRIAD.index(channel.axis)
            values |= {f"{head}_X{k}_{place}": float(b[k]) for k in range(4)}
        lines += [f"1\t1\t{name}\t{_single(value)}\t9" for name, value in values.items()]
        parameters |= values
        if identity is None:
            notes.append(
                f"{head}_ID must be the sensor's device id, otherwise PX4 ignores these parameters: give --device-id"
            )
        notes.append(
            f"{offsets} offsets must be zero; corrected = R (raw - offset), offset = X0 + X1 d + X2 d^2 + X3 d^3"
        )

    def corrected(channel: CalibratedChannel, raw: Floats, temperature_c: Floats) -> Floats:
        # Between two updates, the temperature changes by 1 °C.
        letter = "G" if channel.kind == "gyro" else "A"
        return raw - px4_correction(parameters, channel.axis, np.floor(temperature_c), number, letter)

    return _Filled("".join(f"{line}\n" for line in lines), _of_each(calibration, corrected), notes)


def px4_correction(
    parameters: Mapping[str, float], axis: str, temperature_c: Floats, number: int = 0, letter: str = "G"
) -> Floats:
    """PX4's correction of a raw rate (rad/s), or specific force (m/s²; `letter` A), in float32."""
    value = {name: np.float32(v) for name, v in parameters.items()}
    place = _TRIAD.index(axis)
    x = [value[f"TC_{letter}{number}_X{k}_{place}"] for k in range(4)]
    low, high, about = (value[f"TC_{letter}{number}_{name}"] for name in ("TMIN", "TMAX", "TREF"))
    d = np.clip(temperature_c.astype(np.float32), low, high) - about
    return np.asarray(x[0] + x[1] * d + x[2] * d * d + x[3] * d * d * d, np.float64)


# --- templates --------------------------------------------------------------------------------------------------------


def linear_at(calibration: Calibration, temperature_c: float) -> dict[str, dict[str, Any]]:
    """The linear part of every channel at one temperature, of maps over rate their mean; absent terms and channels
    count as zero: measured rate = gyro.matrix ω + sensitivity.matrix f + gyro.bias, measured force =
    accelerometer.matrix f + accelerometer.bias; SI. `kalibr`: the same with rotations factored out, measured rate =
    gyro · rotation · ω + sensitivity · f in a frame in which the accelerometers' matrix is lower triangular (`frame`:
    from the calibration's)."""
    matrix, bias = linear_part(calibration.channel, temperature_c, mean_over_rates=True)
    gyro, felt, force = matrix[:3, :3], matrix[:3, 3:], matrix[3:, 3:]
    triangle, frame = _triangular(force)
    of_gyro, rotation = _triangular(gyro @ frame.T)
    kalibr = {"accelerometer": triangle, "gyro": of_gyro, "rotation": rotation, "sensitivity": felt @ frame.T}
    return {
        "gyro": {"matrix": gyro.tolist(), "inverse": np.linalg.inv(gyro).tolist(), "bias": bias[:3].tolist()},
        "accelerometer": {
            "matrix": force.tolist(),
            "inverse": np.linalg.inv(force).tolist(),
            "bias": bias[3:].tolist(),
        },
        "sensitivity": {"matrix": felt.tolist()},
        "kalibr": {name: value.tolist() for name, value in (kalibr | {"frame": frame}).items()},
    }


def _triangular(matrix: Floats) -> tuple[Floats, Floats]:
    """`L Q = matrix`, L lower triangular with a positive diagonal, Q a rotation."""
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return (r * signs[:, None]).T, (q * signs).T


def _template(calibration: Calibration, options: _Options) -> _Filled:
    template, at = options.template, options.temperature_c
    if template is None:
        raise ValueError(
            "the template is missing: name it with --template; gradcal start export-gains -o gains.j2 writes one"
        )
    noise = {} if calibration.noise is None else dict(calibration.noise)

    def linear(temperature_c: float) -> dict[str, dict[str, Any]]:
        return linear_at(calibration, temperature_c)

    values: dict[str, Any] = {
        "serial_number": calibration.serial_number,
        "simulated": calibration.simulated,
        "frame": calibration.frame,
        "order": calibration.order,
        "temperature_range": [float(t) for t in calibration.valid_temperature],
        "coefficients": calibration.values(),
        "rows": _rows(calibration),
        "noise": {name: float(value) for name, value in noise.items() if value is not None},
        "at": linear,
    }
    if at is None:
        return _Filled(
            rendered(template, values), None, ["what the template does not use is lost, and not listed here"]
        )
    low, high = (float(end) for end in calibration.valid_temperature)
    if not low - 1e-9 <= at <= high + 1e-9:
        raise ValueError(f"the calibration covers {low:g} … {high:g} °C, and {at:g} °C is outside")
    calibration = _in_triad(calibration)
    known = {channel.label for channel in calibration.channel}
    labels = (f"{kind} {axis}" for kind in ("gyro", "accelerometer") for axis in _TRIAD)
    absent = [label for label in labels if label not in known]
    notes = [f"not calibrated, so assumed to be without errors: {', '.join(absent)}"] if absent else []
    notes.append("the losses are those of matrices and biases at this temperature")
    matrix, bias = linear_part(calibration.channel, at, mean_over_rates=True)
    inverse = np.linalg.inv(matrix)

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        return (raw - bias) @ inverse.T

    text = rendered(template, values | linear_at(calibration, at) | {"temperature": at})
    return _Filled(text, corrected, notes)


def _rows(calibration: Calibration) -> list[dict[str, str]]:
    """A row for each coefficient, all in text: its term, value, standard deviation and bases."""
    known = calibration.covariance
    std = {} if known is None else {n: repr(float(np.sqrt(known.matrix[k][k]))) for k, n in enumerate(known.names)}
    rows: list[dict[str, str]] = []
    for channel in calibration.channel:
        for term in channel.term:
            lag = float(channel.thermal_lag or 0.0) + float(term.lag or 0.0) if term.temperature is not None else 0.0
            written = ({} if of is None else of.model_dump(mode="json") for of in (term.temperature, term.rate))
            of_temperature, of_rate = ("; ".join(f"{k}={v}" for k, v in of.items()) for of in written)
            for name, value in term.coefficients.items():
                row = {"channel": channel.name, "term": term.name, "signals": " * ".join(term.signals), "name": name}
                row |= {"value": repr(value), "std": std.get(f"{channel.name}.{name}", ""), "unit": term.unit}
                row |= {"temperature_basis": of_temperature, "rate_basis": of_rate, "lag_s": repr(lag)}
                rows.append(row)
    return rows


def _shipped(calibration: Calibration, options: _Options) -> _Filled:
    if options.temperature_c is None:
        raise ValueError(f"{options.target} is for one temperature: state this temperature with --temperature")
    return _template(calibration, options._replace(template=presets.template(f"export-{options.target}.j2")))


def _csv(calibration: Calibration, options: _Options) -> _Filled:
    template = presets.template("export-csv.j2")
    done = _template(calibration, options._replace(template=template, temperature_c=None))
    return done._replace(notes=[])


# --- C ----------------------------------------------------------------------------------------------------------------


def _c_header(calibration: Calibration, options: _Options) -> _Filled:
    inputs = c_header.inputs_of(calibration)
    rounds, sample = c_header.settled(calibration, inputs)

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        return c_header.after_rounds(calibration, raw, temperature_c, rounds)

    lost = [
        f"{of}, {what}: {value:.3g} {unit}"
        for of, what, value, unit in losses_of(calibration, inputs, corrected)
        if what.startswith("while")
    ]
    text = c_header.header(calibration, rounds, sample, options.left_out, [*lost, *path_notes(calibration)])
    return _Filled(
        text, corrected, ["float32, no allocation, no division; channels in the order of the header"], inputs
    )


FORMATS: Final[Mapping[str, Callable[[Calibration, _Options], _Filled]]] = {
    "ardupilot": _ardupilot,
    "px4": _px4,
    "c-header": _c_header,
    "kalibr": _shipped,
    "matrices": _shipped,
    "gains": _shipped,
    "tracker": _shipped,
    "ins": _shipped,
    "csv": _csv,
    "template": _template,
}
