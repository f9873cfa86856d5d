"""A calibration in the terms of other programs, each read back and evaluated in the target's own arithmetic.

    ardupilot   INS_TCALn_*: biases over temperature, cubics about 35 °C in float32; accelerometers' scale at one T
    px4         TC_G*, TC_A*: biases over temperature, cubics in float32; no scale factor; in steps of 1 °C
    kalibr      imu.yaml at one temperature: scale, misalignment (triangular), gyros' sensitivity to acceleration
    matrices    YAML at one temperature: corrected = matrix · (raw − bias) for gyros and accelerometers
    c-header    a float32 function of the whole calibration; polynomial bases only
    template    a Jinja template of the user's, filled with maps, matrices and noise
    csv         every coefficient with its standard deviation, for spreadsheets; nothing is lost

Each export reports in numbers what its target cannot carry: the largest error against the calibration over its range.
The formulas are from the targets' public sources; no export has been run on a flight controller.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.calibration import c_header
from gradcal_jax.calibration.correction import linear_part, term_values, value_at
from gradcal_jax.calibration.file import TEMPERATURE_RATE, CalibratedChannel, CalibratedTerm, Calibration, common_span
from gradcal_jax.calibration.path_losses import Loss, lag_losses, path_losses
from gradcal_jax.calibration.polynomials import bias_polynomial
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.records.log import Floats
from gradcal_jax.tables.display import summary
from gradcal_jax.units import DEG_PER_H, G

_GRID: Final = 201
_TRIAD: Final = ("x", "y", "z")
_MICRO_G: Final = 1e6 / G


class Export(NamedTuple):
    """`text` for the target's file, the losses, and notes for the user."""

    text: str
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]

    __repr__ = summary


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
    """The calibration for a target of `FORMATS`: ardupilot, px4, kalibr, matrices, c-header, template, csv.

    `temperature_c`: for targets of one temperature; `instance`: number of the sensor on the controller (from 1 for
    ArduPilot, from 0 for PX4); `device_id`: PX4's; `template`: the text of one; `zeroed`: coefficients that did not
    pass a validation, which are left out ("gyro_x.a3", "x.a3" or, for every channel, "a3"). Returns the text, and every
    loss with its largest value and unit; the functions here name the targets' formulas. Errors: `ValueError`
    with a sentence for what cannot be exported.
    """
    if target not in FORMATS:
        raise ValueError(f'there is no export format "{target}": known are {", ".join(FORMATS)}')
    plain, left_out = _without(calibration, zeroed)
    of_path = list(path_losses(calibration))
    lost = [loss for loss, _ in of_path if loss is not None] + ([] if target == "csv" else list(lag_losses(plain)))
    options: dict[str, Any] = {"temperature_c": temperature_c, "instance": instance, "device_id": device_id}
    options |= {"template": template, "left_out": left_out, "lost": lost}
    done = FORMATS[target](plain, options | {"unknown": [words for loss, words in of_path if loss is None]})
    notes = [*done.notes]
    if target != "csv":
        lags = {channel.thermal_lag: channel.label for channel in calibration.channel if channel.thermal_lag}
        notes += [f"the thermal lag of {label}, {float(lag):.3g} s, is lost" for lag, label in lags.items()]
        late = {(term.name, float(term.lag)) for channel in plain.channel for term in channel.term if term.lag}
        notes += [f"the lag of the {name.replace('_', ' ')}, {lag:.3g} s, is lost" for name, lag in sorted(late)]
        if calibration.unobservable:
            notes.append(f"not observed by the data: {', '.join(calibration.unobservable)}")
    notes += [words for _, words in of_path]
    if left_out:
        notes.append(f"set to zero: {', '.join(left_out)}")
    if calibration.simulated:
        notes.append("this calibration was made from SIMULATED data")
    return done._replace(losses=(*done.losses, *lost), notes=tuple(notes))


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


# --- what every target shares -----------------------------------------------------------------------------------------


def _range_temperatures(channel: CalibratedChannel) -> Floats:
    """Temperatures over a channel's range, °C."""
    return np.linspace(float(channel.valid_temperature[0]), float(channel.valid_temperature[1]), _GRID)


def _bias(channel: CalibratedChannel, temperature_c: Floats) -> Floats:
    term = channel.term_of("bias")
    return np.zeros_like(temperature_c) if term is None else term_values(term, temperature_c)


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


def _of_biases(calibration: Calibration, target: str) -> tuple[list[CalibratedChannel], list[CalibratedChannel]]:
    """Gyros and accelerometers for a target of biases: zeros in place of an unknown bias are refused."""
    channels = _in_triad(calibration).channel
    if without := [channel.label for channel in channels if channel.term_of("bias") is None]:
        raise ValueError(
            f"{target} takes the bias over temperature, and this calibration has no bias of {', '.join(without)}: "
            "zeros would look like a calibration. Estimate the bias with a spec that has it, or export to c-header or "
            "csv"
        )
    gyros = [channel for channel in channels if channel.kind == "gyro"]
    return gyros, [channel for channel in channels if channel.kind == "accelerometer"]


def _losses(
    channels: Iterable[CalibratedChannel], held: Callable[[CalibratedChannel, CalibratedTerm], tuple[float, str] | None]
) -> Iterator[Loss]:
    """The largest difference of every term from the value that a target holds of it, over the channel's range; `held`
    gives that value and over what the term changes, or None for a term that the target carries."""
    for channel in channels:
        slow, fast = (float(r) for r in channel.valid_rate)
        for term in channel.term:
            if (kept := held(channel, term)) is None:
                continue
            rates = np.linspace(slow, fast, 61) if term.rate is not None else np.zeros(1)
            t, w = (x.ravel() for x in np.meshgrid(_range_temperatures(channel), rates, indexing="ij"))
            largest = float(np.max(np.abs(term_values(term, t, w) - kept[0])))
            unit, factor = _for_people(term, channel.kind)
            yield Loss(channel.label, term.name.replace("_", " ") + kept[1], largest * factor, unit)


def _for_people(term: CalibratedTerm, kind: str) -> tuple[str, float]:
    forces = sum(signal.strip("|").startswith("force") for signal in term.signals)
    if TEMPERATURE_RATE in term.signals:
        return ("deg/h at 1 K/min", DEG_PER_H / 60.0) if kind == "gyro" else ("ug at 1 K/min", _MICRO_G / 60.0)
    if kind == "gyro" and forces:
        return "deg/h at 1 g", DEG_PER_H * G**forces
    if not term.signals:
        return ("deg/h", DEG_PER_H) if kind == "gyro" else ("ug", _MICRO_G)
    if forces > 1:
        return "ug at 1 g", _MICRO_G * G**forces
    return ("urad", 1e6) if term.unit == "rad" else ("ppm", 1e6)


def _all_but(*carried: str) -> Callable[[CalibratedChannel, CalibratedTerm], tuple[float, str] | None]:
    """What a target holds that carries these terms alone."""
    return lambda _, term: None if term.name in carried else (0.0, "")


def _bias_losses(
    channels: Iterable[CalibratedChannel], taken_off: Callable[[CalibratedChannel, Floats], Floats]
) -> Iterator[Loss]:
    """What a target's own arithmetic leaves of the biases."""
    for channel in channels:
        t = _range_temperatures(channel)
        unit, factor = ("deg/h", DEG_PER_H) if channel.kind == "gyro" else ("ug", _MICRO_G)
        left = float(np.max(np.abs(taken_off(channel, t) - _bias(channel, t))))
        yield Loss(channel.label, "bias", left * factor, unit)


def _single(value: float) -> str:
    """A number that reads back as the same float32."""
    return f"{np.float32(value):.9g}"


# --- ArduPilot --------------------------------------------------------------------------------------------------------

ARDUPILOT_REFERENCE: Final = 35.0


def _ardupilot(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    gyros, forces = _of_biases(calibration, "ArduPilot")
    number = int(options["instance"])
    if not 1 <= number <= 3:
        raise ValueError(f"ArduPilot numbers its sensors 1 to 3, not {number}")
    cold, warm = common_span(c.valid_temperature for c in (*gyros, *forces))
    low, high = max(float(cold), -70.0), min(float(warm), 80.0)
    if high - low < 10.0:
        raise ValueError(f"ArduPilot needs a range of at least 10 K, and this calibration covers {low:g} … {high:g} °C")
    at = 0.5 * (low + high)
    span = (("ENABLE", 1.0), ("TMIN", low), ("TMAX", high))
    parameters = {f"INS_TCAL{number}_{name}": value for name, value in span}
    kinds = {"gyro": "GYR", "accelerometer": "ACC"}
    for channels in filter(None, (gyros, forces)):
        parameters |= _ardupilot_biases(channels, number, at, kinds[channels[0].kind])
    losses = list(
        _bias_losses([*gyros, *forces], lambda c, t: ardupilot_correction(parameters, c.axis, t, number, kinds[c.kind]))
    )
    # Accelerometers have a scale, gyros none.
    losses += _losses(gyros, _all_but("bias"))
    losses += _losses(forces, lambda c, t: _held(c, t, at) if t.name == "scale_factor" else _all_but("bias")(c, t))
    notes = [_range_note(c, low, high) for c in (*gyros, *forces)]
    notes.append("sensor's own axes, before the board's rotation; corrected = raw - P(T-35) + P(Tcal-35) - OFFS")
    if forces:
        notes.append(
            "accelerometers: the result is also multiplied by SCAL, computed for the middle of the temperature range"
        )
    text = "".join(f"{name} {_single(value)}\n" for name, value in parameters.items())
    return Export(text, tuple(losses), tuple(filter(None, notes)))


def _range_note(channel: CalibratedChannel, low: float, high: float) -> str:
    cold, warm = channel.valid_temperature
    if low <= cold + 1e-6 and high >= warm - 1e-6:
        return ""
    return f"{channel.label}: the target's range is {low:g} … {high:g} °C; outside it, the value at its edge is used"


def _ardupilot_biases(channels: Sequence[CalibratedChannel], number: int, at: float, kind: str) -> dict[str, float]:
    """The parameters of gyros (GYR, rad/s) or accelerometers (ACC, m/s²), with the offsets and scales `at` (°C)."""
    rows: dict[str, float] = {}
    place = "" if number == 1 else str(number)
    for channel in channels:
        letter, b = channel.axis.upper(), bias_polynomial(channel, ARDUPILOT_REFERENCE, 3)
        rows |= {f"INS_TCAL{number}_{kind}{k}_{letter}": 1e6 * b[k] for k in (1, 2, 3)}
        offset = float(np.polynomial.polynomial.polyval(at - ARDUPILOT_REFERENCE, b))
        rows[f"INS_{kind}{place}OFFS_{letter}"] = offset
        if kind == "ACC":
            gain = linear_part([channel], at, [channel.input])[0][0, 0]
            rows[f"INS_{kind}{place}SCAL_{letter}"] = 1.0 / gain
    return rows | {f"INS_{kind}{number}_CALTEMP": at}


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


# --- PX4 --------------------------------------------------------------------------------------------------------------


def _px4(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    gyros, forces = _of_biases(calibration, "PX4")
    number, identity = int(options["instance"]), options["device_id"]
    if not 0 <= number <= 3:
        raise ValueError(f"PX4 numbers its sensors 0 to 3, not {number}")
    low, high = map(float, common_span(c.valid_temperature for c in (*gyros, *forces)))
    if not high >= low:
        raise ValueError("the channels' temperature ranges do not overlap, and PX4 has one range for all of them")
    lines: list[str] = []
    losses: list[Loss] = []
    notes = [_range_note(c, low, high) for c in (*gyros, *forces)]
    for channels, letter, offsets in ((gyros, "G", "CAL_GYRO"), (forces, "A", "CAL_ACC")):
        if not channels:
            continue
        rows = _px4_rows(channels, letter, number, identity, low, high)
        lines += [f"1\t1\t{name}\t{int(v) if kind == 6 else _single(v)}\t{kind}" for name, v, kind in rows]
        parameters = {name: float(np.float32(value)) for name, value, _ in rows}
        losses += _bias_losses(
            channels, lambda c, t, p=parameters, letter=letter: px4_correction(p, c.axis, t, number, letter)
        )
        for channel in channels:
            t = _range_temperatures(channel)
            slope = float(np.max(np.abs(np.gradient(_bias(channel, t), t)))) if t[-1] > t[0] else 0.0
            unit, factor = ("deg/h", DEG_PER_H) if letter == "G" else ("ug", _MICRO_G)
            losses.append(Loss(channel.label, "bias between two updates, 1 °C apart", slope * factor, unit))
        if identity is None:
            name = f"TC_{letter}{number}_ID"
            notes.append(
                f"{name} must be the sensor's device id, otherwise PX4 ignores these parameters: give --device-id"
            )
        notes.append(
            f"{offsets} offsets must be zero; corrected = R (raw - offset), offset = X0 + X1 d + X2 d^2 + X3 d^3"
        )
    losses += _losses([*gyros, *forces], _all_but("bias"))
    return Export("".join(f"{line}\n" for line in lines), tuple(losses), tuple(filter(None, notes)))


def _px4_rows(
    channels: Iterable[CalibratedChannel], letter: str, number: int, identity: int | None, low: float, high: float
) -> list[tuple[str, float, int]]:
    """Name, value and MAVLink's type of every parameter of gyros ("G", rad/s) or accelerometers ("A", m/s²)."""
    about = float(round(0.5 * (low + high)))
    whole = [(f"TC_{letter}_ENABLE", 1, 6), (f"TC_{letter}{number}_ID", int(identity or 0), 6)]
    rows = [*whole, *((f"TC_{letter}{number}_{n}", v, 9) for n, v in (("TREF", about), ("TMIN", low), ("TMAX", high)))]
    for channel in channels:
        b, place = bias_polynomial(channel, about, 3), _TRIAD.index(channel.axis)
        rows += [(f"TC_{letter}{number}_X{k}_{place}", float(b[k]), 9) for k in range(4)]
    return rows


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


# --- one temperature --------------------------------------------------------------------------------------------------


class LinearForm(NamedTuple):
    """An IMU at one temperature: measured rate = `gyro` ω + `sensitivity` f + `gyro_bias`, measured force =
    `accelerometer` f + `accelerometer_bias`; SI."""

    gyro: Floats
    gyro_bias: Floats
    sensitivity: Floats
    accelerometer: Floats
    accelerometer_bias: Floats


def linear_at(calibration: Calibration, temperature_c: float) -> LinearForm:
    """The linear part of every channel at one temperature, of maps over rate their mean; absent terms and channels
    count as zero."""
    matrix, bias = linear_part(calibration.channel, temperature_c, mean_over_rates=True)
    return LinearForm(matrix[:3, :3], bias[:3], matrix[:3, 3:], matrix[3:, 3:], bias[3:])


class KalibrForm(NamedTuple):
    """Kalibr's: measured rate = `gyro` · `rotation` · ω + `sensitivity` · f, measured force = `accelerometer` · f, in a
    frame in which the accelerometers' matrix is lower triangular; `frame`: from the calibration's frame to that one.
    """

    accelerometer: Floats
    gyro: Floats
    rotation: Floats
    sensitivity: Floats
    frame: Floats


def kalibr_form(linear: LinearForm) -> KalibrForm:
    """The same matrices with their rotations factored out: lower triangular times rotation, positive diagonals."""
    accelerometer, frame = _triangular(linear.accelerometer)
    gyro, rotation = _triangular(linear.gyro @ frame.T)
    return KalibrForm(accelerometer, gyro, rotation, linear.sensitivity @ frame.T, frame)


def _triangular(matrix: Floats) -> tuple[Floats, Floats]:
    """`L Q = matrix`, L lower triangular with a positive diagonal, Q a rotation."""
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return (r * signs[:, None]).T, (q * signs).T


def _held(channel: CalibratedChannel, term: CalibratedTerm, at: float) -> tuple[float, str]:
    """The value of a term that a target holds at one temperature, and over what it changes."""
    if len(term.signals) > 1 or any(s.startswith("|") or s == TEMPERATURE_RATE for s in term.signals):
        return 0.0, ""
    return value_at(channel, term, at, mean_over_rates=True), " over temperature" + (" and rate" if term.rate else "")


def _at_one_temperature(
    calibration: Calibration, options: Mapping[str, Any], target: str
) -> tuple[float, LinearForm, list[Loss], list[str]]:
    """The requested temperature (°C), the linear form there, and what it leaves. Raises `ValueError` without one within
    the range."""
    calibration = _in_triad(calibration)
    at = options["temperature_c"]
    if at is None:
        raise ValueError(f"{target} is for one temperature: state this temperature with --temperature")
    low, high = (float(end) for end in calibration.valid_temperature)
    if not low - 1e-9 <= at <= high + 1e-9:
        raise ValueError(f"the calibration covers {low:g} … {high:g} °C, and {at:g} °C is outside")
    known = {channel.label for channel in calibration.channel}
    labels = (f"{kind} {axis}" for kind in ("gyro", "accelerometer") for axis in _TRIAD)
    absent = [label for label in labels if label not in known]
    notes = [f"not calibrated, so assumed to be without errors: {', '.join(absent)}"] if absent else []
    losses = [loss for loss in _losses(calibration.channel, lambda c, t: _held(c, t, float(at))) if loss.value > 0.0]
    return float(at), linear_at(calibration, float(at)), losses, notes


def _kalibr(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    at, linear, losses, notes = _at_one_temperature(calibration, options, "a Kalibr file")
    form = kalibr_form(linear)
    notes.append("Kalibr estimates the biases itself and takes none from this file")
    lines = [
        _file_comment(calibration, at),
        "# measured rate = M * C_gyro_i * rate + A * specific_force + bias + noise",
        "# measured force = M * specific_force + bias + noise",
        "# frame: that in which the accelerometers' M is lower triangular; rotation from the calibration's frame:",
        f"# {_list_text(form.frame.ravel())}",
        "rostopic: /imu0",
    ]
    for key, name, unit in (
        ("gyroscope_noise_density", "angle_random_walk", "rad/s/sqrt(Hz)"),
        ("gyroscope_random_walk", "rate_random_walk", "rad/s^2/sqrt(Hz)"),
        ("accelerometer_noise_density", "velocity_random_walk", "m/s^2/sqrt(Hz)"),
        ("update_rate", "sample_rate", "Hz"),
    ):
        if (value := getattr(calibration.noise, name, None)) is not None:
            lines.append(f"{key}: {float(value):.9g}  # {unit}")
    if calibration.noise is None:
        notes.append("the calibration states no noise: enter the noise densities and random walks")
    notes.append("the file needs accelerometer_random_walk, which a calibration does not state: enter it")
    lines += ["model: scale-misalignment", "accelerometers:", *_matrix_lines("M", form.accelerometer)]
    lines += ["gyroscopes:", *_matrix_lines("M", form.gyro), *_matrix_lines("A", form.sensitivity)]
    lines += _matrix_lines("C_gyro_i", form.rotation)
    return Export("\n".join(lines) + "\n", tuple(losses), tuple(notes))


def _matrices(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    at, linear, losses, notes = _at_one_temperature(calibration, options, "a file of matrices")
    lines = [
        _file_comment(calibration, at),
        "# force = accelerometer.matrix * (raw force - accelerometer.bias)",
        "# rate = gyro.matrix * (raw rate - gyro.bias - gyro.sensitivity * force); SI; frame: " + calibration.frame,
    ]
    for name, matrix, bias in (
        ("accelerometer", linear.accelerometer, linear.accelerometer_bias),
        ("gyro", linear.gyro, linear.gyro_bias),
    ):
        lines += [f"{name}:", *_matrix_lines("matrix", np.linalg.inv(matrix)), f"  bias: {_list_text(bias)}"]
    lines += _matrix_lines("sensitivity", linear.sensitivity)
    return Export("\n".join(lines) + "\n", tuple(losses), tuple(notes))


def _file_comment(calibration: Calibration, at: float | None = None) -> str:
    """The comment with the sensor and the temperature (°C) of a file."""
    where = "" if at is None else f", {at:g} degC"
    return f"# gradcal {calibration.serial_number}{where}" + (", SIMULATED" if calibration.simulated else "")


def _matrix_lines(name: str, values: NDArray[Any]) -> list[str]:
    """A matrix in YAML, row by row."""
    return [f"  {name}:", *(f"  - {_list_text(row)}" for row in values)]


def _list_text(values: Floats) -> str:
    """A list of numbers in YAML."""
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"


# --- C and CSV --------------------------------------------------------------------------------------------------------


def _c_header(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    of_slope = _losses(calibration.channel, lambda _, t: (0.0, "") if TEMPERATURE_RATE in t.signals else None)
    slopes = [loss._replace(what=f"{loss.what}: follows dT/dt") for loss in of_slope]
    lost = [f"{of}, {what}: {value:.3g} {unit}" for of, what, value, unit in (*slopes, *options["lost"])]
    text, errors = c_header.header(calibration, options["left_out"], (*lost, *options["unknown"]))
    notes = ("float32, no allocation, no division; channels in the order of the header",)
    return Export(text, (*errors, *slopes), notes)


def _csv(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    known = calibration.covariance
    std = {} if known is None else {n: repr(float(np.sqrt(known.matrix[k][k]))) for k, n in enumerate(known.names)}
    rows: list[Sequence[str]] = [
        ("channel", "term", "signals", "name", "value", "std", "unit", "temperature_basis", "rate_basis", "lag_s")
    ]
    for channel in calibration.channel:
        for term in channel.term:
            lag = float(channel.thermal_lag or 0.0) + float(term.lag or 0.0) if term.temperature is not None else 0.0
            written = ({} if of is None else of.model_dump(mode="json") for of in (term.temperature, term.rate))
            bases = ["; ".join(f"{k}={v}" for k, v in of.items() if k != "internal") for of in written]
            where = (channel.name, term.name, " * ".join(term.signals))
            for name, value in term.coefficients.items():
                known_std = std.get(f"{channel.name}.{name}", "")
                rows.append((*where, name, repr(value), known_std, term.unit, *bases, repr(lag)))
    stream = io.StringIO()
    stream.write(f"{_file_comment(calibration)}\n# {calibration.order}\n")
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return Export(stream.getvalue(), (), ())


def _template(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    template, at = options["template"], options["temperature_c"]
    if template is None:
        raise ValueError(
            "the template is missing: name it with --template; gradcal start export-gains -o gains.j2 writes one"
        )

    def linear(temperature_c: float) -> dict[str, dict[str, Any]]:
        of = linear_at(calibration, temperature_c)
        return {
            name: {"matrix": matrix.tolist(), "inverse": np.linalg.inv(matrix).tolist(), "bias": bias.tolist()}
            for name, matrix, bias in (
                ("gyro", of.gyro, of.gyro_bias),
                ("accelerometer", of.accelerometer, of.accelerometer_bias),
            )
        } | {"sensitivity": {"matrix": of.sensitivity.tolist()}}

    noise = {} if calibration.noise is None else dict(calibration.noise)
    known = {
        "serial_number": calibration.serial_number,
        "simulated": calibration.simulated,
        "frame": calibration.frame,
        "temperature_range": [float(t) for t in calibration.valid_temperature],
        "coefficients": calibration.values(),
        "noise": {name: float(value) for name, value in noise.items() if value is not None},
        "at": linear,
    }
    losses, notes = [], ["terms that the template does not use are lost; they are not listed here"]
    if at is not None:
        at, _, losses, more = _at_one_temperature(calibration, options, "a template")
        known |= linear(at) | {"temperature": at}
        notes += more
    return Export(rendered(template, known), tuple(losses), tuple(notes))


FORMATS: Final[Mapping[str, Callable[[Calibration, Mapping[str, Any]], Export]]] = {
    "ardupilot": _ardupilot,
    "px4": _px4,
    "kalibr": _kalibr,
    "matrices": _matrices,
    "c-header": _c_header,
    "template": _template,
    "csv": _csv,
}
