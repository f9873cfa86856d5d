"""A whole unit's calibration in the terms of other programs, each evaluated in the target's own arithmetic.

    ardupilot   INS_TCALn_*: biases of gyros and accelerometers, cubics about 35 °C; accelerometers' scale at one T
    px4         TC_G*, TC_A*: biases over temperature, cubics; no scale factor
    kalibr      imu.yaml at one temperature: scale, misalignment (triangular), sensitivity of gyros to acceleration
    matrices    YAML at one temperature: corrected = matrix · (raw − bias) for gyros and accelerometers
    c-header    a function in float32 with everything that the calibration has (polynomials)
    csv         every coefficient with its standard deviation; nothing is lost

Each export reports in numbers what its target cannot carry: the largest error against the calibration over its range.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.files import c_header, exports
from gradcal_jax.files.bases import TemperaturePolynomial
from gradcal_jax.files.calibration import AxisCalibration, BiasMap, Calibration, ScaleFactorMap
from gradcal_jax.files.exports import Export, Loss
from gradcal_jax.files.log import Floats
from gradcal_jax.files.unit_calibration import CalibratedChannel, CalibratedTerm, UnitCalibration
from gradcal_jax.files.unit_correction import linear_part, term_values
from gradcal_jax.units import DEG_PER_H, G

_GRID: Final = 201
_TRIAD: Final = ("x", "y", "z")
_MICRO_G: Final = 1e6 / G


def export_unit(
    calibration: UnitCalibration,
    target: str,
    *,
    temperature_c: float | None = None,
    instance: int = 1,
    device_id: int | None = None,
) -> Export:
    """A unit's calibration for a target of `UNIT_FORMATS`: ardupilot, px4, kalibr, matrices, c-header, csv.

    `temperature_c`: for targets of one temperature; `instance`: number of the sensor on the controller (from 1 for
    ArduPilot, from 0 for PX4); `device_id`: PX4's. Returns the text, and every loss with its largest value and unit.
    The formulas are those of the targets' firmware. Errors: `ValueError` with a sentence for what cannot be exported.
    """
    if target not in UNIT_FORMATS:
        known = ", ".join(UNIT_FORMATS)
        raise ValueError(f'there is no export format "{target}" of a whole unit: known are {known}')
    options = {"temperature_c": temperature_c, "instance": instance, "device_id": device_id}
    done = UNIT_FORMATS[target](calibration, options)
    warning = ("this calibration was made from SIMULATED data",) if calibration.simulated else ()
    return done._replace(notes=(*done.notes, *warning))


# --- parts that serve the targets of single axes ----------------------------------------------------------------------


def single_axes_of(calibration: UnitCalibration, kind: str) -> Calibration | None:
    """The biases and scale factors of one kind, as a calibration of single axes without their noise; None where there
    is no such channel.

    Of accelerometers rates stand for specific forces: rad/s for m/s².
    """
    axes = [_axis(calibration, c) for c in calibration.channel if c.kind == kind]
    if not axes:
        return None
    return Calibration(
        format="gradcal-calibration/1",
        serial_number=calibration.serial_number,
        quantity="gyro",
        simulated=calibration.simulated,
        frame=calibration.frame,
        order=calibration.order,
        axis=tuple(axes),
        provenance=calibration.provenance,
    )


def _axis(calibration: UnitCalibration, channel: CalibratedChannel) -> AxisCalibration:
    maps: dict[str, Any] = {}
    if (bias := channel.term_of("bias")) is not None:
        # A constant has no number in a unit's file.
        named = {"a" + name.removeprefix("a").rjust(1, "0"): value for name, value in bias.coefficients.items()}
        maps["bias"] = BiasMap(temperature=_basis(bias), coefficients=named)
    scale = channel.term_of("scale_factor")
    if scale is not None and scale.rate is not None:
        maps["scale_factor"] = ScaleFactorMap(
            temperature=_basis(scale), rate=scale.rate, coefficients=dict(scale.coefficients)
        )
    return AxisCalibration(
        name=channel.axis,
        thermal_lag=calibration.thermal_lag,
        valid_temperature=calibration.valid_temperature,
        valid_rate=calibration.valid_rate,
        **maps,
    )


def _basis(term: CalibratedTerm) -> Any:
    if term.temperature is not None:
        return term.temperature
    return TemperaturePolynomial.model_validate({"basis": "polynomial", "degree": 0, "scale": "50 K"})


class LinearUnit(NamedTuple):
    """A unit at one temperature, for slow rates: measured rate = `gyro` ω + `sensitivity` f + `gyro_bias`, measured
    force = `accelerometer` f + `accelerometer_bias`; SI."""

    gyro: Floats
    gyro_bias: Floats
    sensitivity: Floats
    accelerometer: Floats
    accelerometer_bias: Floats


def linear_at(calibration: UnitCalibration, temperature_c: float) -> LinearUnit:
    """The linear part of every channel at one temperature; absent terms count as zero."""
    matrix, bias = linear_part(calibration.channel, temperature_c)
    return LinearUnit(matrix[:3, :3], bias[:3], matrix[:3, 3:], matrix[3:, 3:], bias[3:])


def _lost(calibration: UnitCalibration, carried: Callable[[CalibratedTerm], bool]) -> list[Loss]:
    """The largest value over its range of every term that a target cannot carry, at 1 g and its largest rate."""
    return [loss for term, loss in _left(calibration, lambda _: (0.0, "")) if not carried(term)]


def _left(
    calibration: UnitCalibration, held: Callable[[CalibratedTerm], tuple[float, str]]
) -> Iterator[tuple[CalibratedTerm, Loss]]:
    """Every term with its largest difference from the target's value over its range, and the name of that range."""
    low, high = (float(t) for t in calibration.valid_temperature)
    fastest = max(abs(float(r)) for r in calibration.valid_rate)
    temperature = np.linspace(low, high, _GRID)
    for channel in calibration.channel:
        for term in channel.term:
            value, over = held(term)
            rates = np.linspace(-fastest, fastest, 61) if term.rate is not None else np.zeros(1)
            t, w = (x.ravel() for x in np.meshgrid(temperature, rates, indexing="ij"))
            largest = float(np.max(np.abs(term_values(term, t, w) - value)))
            unit, factor = _people(term, channel.kind)
            what = term.name.replace("_", " ") + over
            yield term, Loss(f"{channel.kind} {channel.axis}", what, largest * factor, unit)


def _people(term: CalibratedTerm, kind: str) -> tuple[str, float]:
    forces = sum(signal.strip("|").startswith("force") for signal in term.signals)
    if kind == "gyro" and forces:
        return "deg/h at 1 g", DEG_PER_H * G**forces
    if not term.signals:
        return ("deg/h", DEG_PER_H) if kind == "gyro" else ("ug", _MICRO_G)
    if forces > 1:
        return "ug at 1 g", _MICRO_G * G**forces
    return ("urad", 1e6) if term.unit == "rad" else ("ppm", 1e6)


def _both(
    calibration: UnitCalibration, target: str, options: Mapping[str, Any]
) -> tuple[list[str], list[Loss], list[str]]:
    """The export of the gyros to a target of single axes, where there are any."""
    gyros = single_axes_of(calibration, "gyro")
    if gyros is None:
        return [], [], []
    done = exports.export(
        gyros.model_copy(update={"simulated": False}),
        target,
        instance=int(options["instance"]),
        device_id=options["device_id"],
    )
    losses = [loss._replace(axis=f"gyro {loss.axis}") for loss in done.losses if loss.what != "scale factor"]
    return done.text.splitlines(), losses, list(done.notes)


# --- ArduPilot and PX4 ------------------------------------------------------------------------------------------------


def _ardupilot(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    lines, losses, notes = _both(calibration, "ardupilot", options)
    number = int(options["instance"])
    if (parts := single_axes_of(calibration, "accelerometer")) is not None:
        low = max(float(calibration.valid_temperature[0]), -70.0)
        high = min(float(calibration.valid_temperature[1]), 80.0)
        if high - low < 10.0:
            raise ValueError(f"ArduPilot needs a range of at least 10 K; this calibration covers {low:g} … {high:g} °C")
        at = 0.5 * (low + high)
        span = exports.ardupilot_range(number, low, high)
        gains = linear_at(calibration, at).accelerometer
        scales = {axis: 1.0 / gains[i, i] for i, axis in enumerate(_TRIAD)}
        parameters = exports.ardupilot_bias(parts.axis, number, at, "ACC", scales)
        written = parameters if lines else span | parameters
        lines += [f"{name} {exports.single(value)}" for name, value in written.items()]
        losses += _accelerometer_bias_losses(
            parts, lambda name, t: exports.ardupilot_correction(span | parameters, name, t, number, "ACC")
        )
        losses += [
            loss
            for term, loss in _left(calibration, lambda term: _held(term, at))
            if term.name == "scale_factor" and loss.axis.startswith("accelerometer")
        ]
        notes.append(
            "accelerometers: corrected = (raw - P(T-35) + P(Tcal-35) - OFFS) * SCAL, SCAL at the middle of the range"
        )
    losses += _lost(
        calibration, lambda term: term.name == "bias" or (term.name == "scale_factor" and term.rate is None)
    )
    return Export("".join(f"{line}\n" for line in lines), tuple(losses), tuple(dict.fromkeys(notes)))


def _accelerometer_bias_losses(parts: Calibration, taken_off: Callable[[str, Floats], Floats]) -> list[Loss]:
    left = {a.name: exports.bias_left(a, taken_off(a.name, exports.range_temperatures(a))) for a in parts.axis}
    return [Loss(f"accelerometer {name}", "bias", value * _MICRO_G, "ug") for name, value in left.items()]


def _px4(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    lines, losses, notes = _both(calibration, "px4", options)
    parts = single_axes_of(calibration, "accelerometer")
    if parts is not None:
        number, identity = int(options["instance"]), options["device_id"]
        low, high = (float(t) for t in calibration.valid_temperature)
        rows = exports.px4_rows(parts.axis, "A", number, identity, low, high)
        lines += exports.px4_lines(rows)
        parameters = {name: value for name, value, _ in rows}
        losses += _accelerometer_bias_losses(
            parts, lambda name, t: exports.px4_correction(parameters, name, t, number, "A")
        )
        if identity is None:
            notes.append(f"TC_A{number}_ID must be the sensor's device id: with 0 PX4 ignores the set (--device-id)")
        notes.append("CAL_ACC offsets must be zero; corrected = R (raw - offset)")
    losses += _lost(calibration, lambda term: term.name == "bias")
    return Export("".join(f"{line}\n" for line in lines), tuple(losses), tuple(dict.fromkeys(notes)))


# --- one temperature --------------------------------------------------------------------------------------------------


class KalibrForm(NamedTuple):
    """Kalibr's: measured rate = `gyro` · `rotation` · ω + `sensitivity` · f, measured force = `accelerometer` · f, in a
    frame in which the accelerometers' matrix is lower triangular; `frame`: from the calibration's frame to that one.
    """

    accelerometer: Floats
    gyro: Floats
    rotation: Floats
    sensitivity: Floats
    frame: Floats


def kalibr_form(linear: LinearUnit) -> KalibrForm:
    """The same matrices with their rotations factored out: lower triangular times rotation, positive diagonals."""
    accelerometer, frame = _triangular(linear.accelerometer)
    gyro, rotation = _triangular(linear.gyro @ frame.T)
    return KalibrForm(accelerometer, gyro, rotation, linear.sensitivity @ frame.T, frame)


def _triangular(matrix: Floats) -> tuple[Floats, Floats]:
    """`L Q = matrix`, L lower triangular with a positive diagonal, Q a rotation."""
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return (r * signs[:, None]).T, (q * signs).T


def _held(term: CalibratedTerm, at: float) -> tuple[float, str]:
    """The value of a term that a target holds at one temperature, and over what it changes."""
    if len(term.signals) > 1 or any(s.startswith("|") for s in term.signals):
        return 0.0, ""
    value = float(term_values(term, np.array([at]), np.zeros(1))[0])
    return value, " over temperature" + (" and rate" if term.rate else "")


def _one_temperature(calibration: UnitCalibration, at: float) -> list[Loss]:
    """The errors at other temperatures and rates of terms that are held at one."""
    return [loss for _, loss in _left(calibration, lambda term: _held(term, at)) if loss.value > 0.0]


def _kalibr(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    at = exports.one_temperature(options, calibration.valid_temperature, "Kalibr")
    form = kalibr_form(linear_at(calibration, at))
    notes = ["Kalibr estimates the biases itself and takes none from this file"]
    lines = [
        exports.file_comment(calibration, at),
        "# measured rate = M * C_gyro_i * rate + A * specific_force + bias + noise",
        "# measured force = M * specific_force + bias + noise",
        "# in the frame in which the accelerometers' M is lower triangular, turned from the calibration's by",
        f"# {exports.list_text(form.frame.ravel())}",
        "rostopic: /imu0",
    ]
    lines += exports.kalibr_noise(calibration.noise)
    notes.append("the file wants an accelerometer_random_walk, which no calibration tells")
    lines += ["model: scale-misalignment", "accelerometers:", "  M:", *exports.matrix_lines(form.accelerometer)]
    lines += ["gyroscopes:", "  M:", *exports.matrix_lines(form.gyro), "  A:", *exports.matrix_lines(form.sensitivity)]
    lines += ["  C_gyro_i:", *exports.matrix_lines(form.rotation)]
    return Export("\n".join(lines) + "\n", tuple(_one_temperature(calibration, at)), tuple(notes))


def _matrices(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    at = exports.one_temperature(options, calibration.valid_temperature, "This")
    linear = linear_at(calibration, at)
    lines = [
        exports.file_comment(calibration, at),
        "# force = accelerometer.matrix * (raw force - accelerometer.bias)",
        "# rate = gyro.matrix * (raw rate - gyro.bias - gyro.sensitivity * force); SI; frame: " + calibration.frame,
    ]
    for name, matrix, bias in (
        ("accelerometer", linear.accelerometer, linear.accelerometer_bias),
        ("gyro", linear.gyro, linear.gyro_bias),
    ):
        lines += [
            f"{name}:",
            "  matrix:",
            *exports.matrix_lines(np.asarray(np.linalg.inv(matrix), np.float64)),
            f"  bias: {exports.list_text(bias)}",
        ]
    lines += ["  sensitivity:", *exports.matrix_lines(linear.sensitivity)]
    return Export("\n".join(lines) + "\n", tuple(_one_temperature(calibration, at)), ())


# --- C and CSV --------------------------------------------------------------------------------------------------------


def _c_header(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    text, errors = c_header.unit_header(calibration)
    losses = tuple(Loss(*error) for error in errors)
    lag = [] if calibration.thermal_lag is None else [f"the thermal lag of {calibration.thermal_lag} is not carried"]
    return Export(text, losses, (*lag, "float32, no allocation, no division; all axes in the calibration's frame"))


def _csv(calibration: UnitCalibration, options: Mapping[str, Any]) -> Export:
    std = exports.coefficient_deviations(calibration.covariance)
    rows: list[Sequence[str]] = [
        ("channel", "term", "signals", "name", "value", "std", "unit", "temperature_basis", "rate_basis")
    ]
    for channel in calibration.channel:
        for term in channel.term:
            bases = (exports.basis_words(term.temperature), exports.basis_words(term.rate))
            known = (channel.name, term.name, " * ".join(term.signals))
            for name, value in term.coefficients.items():
                rows.append((*known, name, repr(value), std.get(f"{channel.name}.{name}", ""), term.unit, *bases))
    return exports.csv_file(calibration, rows)


UNIT_FORMATS: Final[Mapping[str, Callable[[UnitCalibration, Mapping[str, Any]], Export]]] = {
    "ardupilot": _ardupilot,
    "px4": _px4,
    "kalibr": _kalibr,
    "matrices": _matrices,
    "c-header": _c_header,
    "csv": _csv,
}
