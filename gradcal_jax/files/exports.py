"""A calibration in the terms of other programs, each read back and evaluated in the target's own arithmetic.

    ardupilot   INS_TCALn_*: bias over temperature, a cubic about 35 °C in float32; no scale factor
    px4         TC_G*: bias over temperature, a cubic in float32; no scale factor; published in steps of 1 °C
    kalibr      imu.yaml at one temperature: scale factor and noise
    c-header    a function in float32 with all that the calibration has (polynomials)
    csv         every coefficient with its standard deviation, for spreadsheets; nothing is lost

Each export reports in numbers what its target cannot carry: the largest error against the calibration over its range.
The formulas are from the targets' public sources; no export has been run on a flight controller.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.files import c_header, correction
from gradcal_jax.files.calibration import AxisCalibration, Calibration, Covariance, Noise
from gradcal_jax.files.log import Floats
from gradcal_jax.files.polynomials import bias_polynomial
from gradcal_jax.files.unit_calibration import UnitCalibration, UnitNoise
from gradcal_jax.units import DEG_PER_H, PPM

_GRID: Final = 201
_TRIAD: Final = ("x", "y", "z")


class Loss(NamedTuple):
    """One thing that the target cannot carry: at most `value` in `unit`, of `what`, on `axis`."""

    axis: str
    what: str
    value: float
    unit: str


class Export(NamedTuple):
    """`text` for the target's file, the losses, and notes for the user."""

    text: str
    losses: tuple[Loss, ...]
    notes: tuple[str, ...]


def export(
    calibration: Calibration,
    target: str,
    *,
    temperature_c: float | None = None,
    instance: int = 1,
    device_id: int | None = None,
    zeroed: Sequence[str] = (),
) -> Export:
    """The calibration for a target of `FORMATS`.

    `temperature_c`: for targets of one temperature; `instance`: number of the sensor on the controller (from 1 for
    ArduPilot, from 0 for PX4); `device_id`: PX4's; `zeroed`: coefficients that did not pass a validation, which are
    left out ("x.a3" or, for every axis, "a3"). Returns the text, and every loss with its largest value and unit. The
    formulas are those of the targets' firmware, which their functions here name. Errors: `ValueError` with a sentence
    for what cannot be exported.
    """
    if target not in FORMATS:
        raise ValueError(f'there is no export format "{target}": known are {", ".join(FORMATS)}')
    plain, left_out = without(calibration, zeroed)
    options: dict[str, Any] = {"temperature_c": temperature_c, "instance": instance, "device_id": device_id}
    done = FORMATS[target](plain, options | {"left_out": left_out})
    notes = [*done.notes]
    if left_out:
        notes.append(f"set to zero: {', '.join(left_out)}")
    if calibration.simulated:
        notes.append("this calibration was made from SIMULATED data")
    return done._replace(notes=tuple(notes))


def export_units(calibrations: Sequence[Calibration], firmware: str) -> Export:
    """Several sensors of one flight controller ("px4", "ardupilot"), in one file.

    PX4 identifies sensors by device id (their serial numbers) and numbers them in their order; ArduPilot's numbers come
    from their names (IMU0 is the first). Errors: `ValueError` as `export`, and for too many sensors.
    """
    lines: dict[str, None] = {}
    losses: list[Loss] = []
    notes: dict[str, None] = {}
    for order, calibration in enumerate(calibrations):
        name = calibration.serial_number
        digits = "".join(c for c in name if c.isdigit())
        number = order if firmware == "px4" else int(digits or order) + 1
        done = export(calibration, firmware, instance=number, device_id=int(digits) if digits else None)
        lines |= dict.fromkeys(done.text.splitlines())
        losses += [loss._replace(axis=f"{name} {loss.axis}") for loss in done.losses]
        notes |= dict.fromkeys(done.notes)
    return Export("".join(f"{line}\n" for line in lines), tuple(losses), tuple(notes))


def without(calibration: Calibration, zeroed: Sequence[str]) -> tuple[Calibration, tuple[str, ...]]:
    """The calibration with some coefficients set to zero, and their names. Raises `ValueError` for unknown names."""
    known: set[str] = set()
    gone: list[str] = []
    axes: list[AxisCalibration] = []
    for axis in calibration.axis:
        changed: dict[str, Any] = {}
        for key, part in (("bias", axis.bias), ("scale_factor", axis.scale_factor)):
            if part is not None:
                known |= {spelling for name in part.coefficients for spelling in (name, f"{axis.name}.{name}")}
                zero = [name for name in part.coefficients if name in zeroed or f"{axis.name}.{name}" in zeroed]
                gone += [f"{axis.name}.{name}" for name in zero]
                changed[key] = part.model_copy(update={"coefficients": part.coefficients | dict.fromkeys(zero, 0.0)})
        axes.append(axis.model_copy(update=changed))
    if unknown := [name for name in dict.fromkeys(zeroed) if name not in known]:
        raise ValueError(f"the calibration has no coefficient {', '.join(unknown)} that could be set to zero")
    return calibration.model_copy(update={"axis": tuple(axes)}), tuple(gone)


# --- what every target shares -----------------------------------------------------------------------------------------


def range_temperatures(axis: AxisCalibration) -> Floats:
    """Temperatures over an axis's range, °C."""
    return np.linspace(float(axis.valid_temperature[0]), float(axis.valid_temperature[1]), _GRID)


def common_range(axes: Iterable[AxisCalibration]) -> tuple[float, float]:
    """The temperatures that all axes cover, °C."""
    lowest, highest = zip(*(axis.valid_temperature for axis in axes), strict=True)
    return float(max(lowest)), float(min(highest))


def _lost_scale_factor(axis: AxisCalibration, carried: Floats | float = 0.0) -> Loss | None:
    """The largest scale-factor error over the calibration's range after the correction by `carried`."""
    if axis.scale_factor is None:
        return None
    slow, fast = axis.valid_rate
    temperature, rate = np.meshgrid(range_temperatures(axis), np.linspace(slow, fast, 61), indexing="ij")
    error = correction.scale_factor(axis, temperature.ravel(), rate.ravel()) - carried
    return Loss(axis.name, "scale factor", float(np.max(np.abs(error))) * PPM, "ppm")


def _lost_terms(axis: AxisCalibration) -> Iterator[str]:
    if axis.bias_temperature_gradient is not None:
        per_k_min = abs(axis.bias_temperature_gradient) * DEG_PER_H / 60.0
        yield f"axis {axis.name}: the bias from dT/dt, {per_k_min:.3g} deg/h for each K/min, is not carried"
    if axis.thermal_lag is not None:
        yield f"axis {axis.name}: the thermal lag of {float(axis.thermal_lag):.3g} s is not carried"
    if axis.unobservable:
        yield f"axis {axis.name}: the data said nothing of {', '.join(axis.unobservable)}"


def _triad(calibration: Calibration) -> dict[str, AxisCalibration]:
    axes = {axis.name.lower(): axis for axis in calibration.axis if axis.name.lower() in _TRIAD}
    if not axes:
        names = ", ".join(axis.name for axis in calibration.axis)
        raise ValueError(f"the target has axes x, y, z, and the calibration has {names}: none of them fits")
    return axes


def _of_bias(calibration: Calibration, target: str) -> dict[str, AxisCalibration]:
    """The triad for a target that carries the bias alone: zeros in place of an unknown bias are refused."""
    triad = _triad(calibration)
    without_bias = [name for name, axis in triad.items() if axis.bias is None]
    if without_bias:
        raise ValueError(
            f"{target} takes the bias over temperature, and this calibration has none of axis "
            f"{', '.join(without_bias)}: zeros would pass for a calibration. Estimate it with a [sensor.bias], or "
            "export to c-header or csv"
        )
    return triad


def single(value: float) -> str:
    """A number that reads back as the same float32."""
    return f"{np.float32(value):.9g}"


# --- ArduPilot --------------------------------------------------------------------------------------------------------

ARDUPILOT_REFERENCE: Final = 35.0


def _ardupilot(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    triad = _of_bias(calibration, "ArduPilot")
    number = int(options["instance"])
    if not 1 <= number <= 3:
        raise ValueError(f"ArduPilot numbers its sensors 1 to 3, not {number}")
    low, high = common_range(triad.values())
    low, high = max(low, -70.0), min(high, 80.0)
    if high - low < 10.0:
        raise ValueError(f"ArduPilot needs a range of at least 10 K, and this calibration covers {low:g} … {high:g} °C")
    parameters = ardupilot_range(number, low, high) | ardupilot_bias(triad.values(), number, 0.5 * (low + high))
    losses, notes = _bias_only(triad, lambda name, t: ardupilot_correction(parameters, name, t, number), low, high)
    absent = [n for n in _TRIAD if n not in triad]
    if absent:
        notes.append(f"no parameters for axis {', '.join(absent)}: the calibration does not have them")
    notes.append("sensor's own axes, before the board's rotation; corrected = raw - P(T-35) + P(Tcal-35) - OFFS")
    text = "".join(f"{name} {single(value)}\n" for name, value in parameters.items())
    return Export(text, tuple(losses), tuple(notes))


def ardupilot_range(number: int, low: float, high: float) -> dict[str, float]:
    """The parameters that enable the correction of one sensor over a range (°C)."""
    return {f"INS_TCAL{number}_{name}": value for name, value in (("ENABLE", 1.0), ("TMIN", low), ("TMAX", high))}


def ardupilot_bias(
    axes: Iterable[AxisCalibration],
    number: int,
    at: float,
    kind: str = "GYR",
    scales: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """The parameters of biases (rad/s, m/s²) whose offsets are those `at` (°C); `kind`: GYR or ACC, with `scales`."""
    rows: dict[str, float] = {}
    for axis in axes:
        letter, b = axis.name.upper(), bias_polynomial(axis, ARDUPILOT_REFERENCE, 3)
        rows |= {f"INS_TCAL{number}_{kind}{k}_{letter}": 1e6 * b[k] for k in (1, 2, 3)}
        offset = float(np.polynomial.polynomial.polyval(at - ARDUPILOT_REFERENCE, b))
        rows[f"INS_{kind}{_place(number)}OFFS_{letter}"] = offset
        if scales is not None:
            rows[f"INS_{kind}{_place(number)}SCAL_{letter}"] = scales[axis.name]
    return rows | {f"INS_{kind}{number}_CALTEMP": at}


def _place(number: int) -> str:
    return "" if number == 1 else str(number)


def ardupilot_correction(
    parameters: Mapping[str, float], axis: str, temperature_c: Floats, number: int = 1, kind: str = "GYR"
) -> Floats:
    """ArduPilot's correction of a raw rate (rad/s), or force (m/s², before its scale; `kind` ACC), in float32."""
    value = {name: np.float32(v) for name, v in parameters.items()}
    letter = axis.upper()
    c1, c2, c3 = (value[f"INS_TCAL{number}_{kind}{k}_{letter}"] for k in (1, 2, 3))
    low, high = value[f"INS_TCAL{number}_TMIN"], value[f"INS_TCAL{number}_TMAX"]

    def polynomial(t: Any) -> Any:
        d = np.clip(t, low, high) - np.float32(ARDUPILOT_REFERENCE)
        return (d * c1 + d * d * c2 + d * d * d * c3) * np.float32(1e-6)

    at = polynomial(value[f"INS_{kind}{number}_CALTEMP"])
    offset = value[f"INS_{kind}{_place(number)}OFFS_{letter}"]
    return np.asarray(polynomial(temperature_c.astype(np.float32)) - at + offset, np.float64)


def bias_left(axis: AxisCalibration, taken_off: Floats) -> float:
    """The largest bias after a target's correction, over the axis's range."""
    return float(np.max(np.abs(taken_off - correction.bias(axis, range_temperatures(axis)))))


def _bias_only(
    triad: Mapping[str, AxisCalibration], taken_off: Callable[[str, Floats], Floats], low: float, high: float
) -> tuple[list[Loss], list[str]]:
    """Losses of a target that carries the bias alone, in its own arithmetic."""
    losses: list[Loss] = []
    notes: list[str] = []
    for name, axis in triad.items():
        t = range_temperatures(axis)
        losses.append(Loss(axis.name, "bias", bias_left(axis, taken_off(name, t)) * DEG_PER_H, "deg/h"))
        if (lost := _lost_scale_factor(axis)) is not None:
            losses.append(lost)
            notes.append(f"axis {axis.name}: the target takes no gyro scale factor: up to {lost.value:.4g} ppm stay")
        if low > t[0] + 1e-6 or high < t[-1] - 1e-6:
            notes.append(f"axis {axis.name}: the target's range is {low:g} … {high:g} °C; beyond it the edge holds")
        notes += _lost_terms(axis)
    return losses, notes


# --- PX4 --------------------------------------------------------------------------------------------------------------


def _px4(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    triad = _of_bias(calibration, "PX4")
    number, identity = int(options["instance"]), options["device_id"]
    if not 0 <= number <= 3:
        raise ValueError(f"PX4 numbers its sensors 0 to 3, not {number}")
    low, high = common_range(triad.values())
    if not high >= low:
        raise ValueError("the axes' temperature ranges do not overlap, and PX4 has one range for all of them")
    rows = px4_rows(triad.values(), "G", number, identity, low, high)
    parameters = {name: float(np.float32(value)) for name, value, _ in rows}
    losses, notes = _bias_only(triad, lambda name, t: px4_correction(parameters, name, t, number), low, high)
    for axis in triad.values():
        t = range_temperatures(axis)
        slope = float(np.max(np.abs(np.gradient(correction.bias(axis, t), t)))) if t[-1] > t[0] else 0.0
        losses.append(Loss(axis.name, "bias between two updates, 1 °C apart", slope * DEG_PER_H, "deg/h"))
    if identity is None:
        notes.append(f"TC_G{number}_ID must be the sensor's device id: with 0 PX4 ignores the set (give --device-id)")
    notes.append("CAL_GYRO offsets must be zero; corrected = R (raw - offset), offset = X0 + X1 d + X2 d^2 + X3 d^3")
    return Export("".join(f"{line}\n" for line in px4_lines(rows)), tuple(losses), tuple(notes))


def px4_rows(
    axes: Iterable[AxisCalibration], letter: str, number: int, identity: int | None, low: float, high: float
) -> list[tuple[str, float, int]]:
    """Name, value and MAVLink's type of every parameter of gyros ("G", rad/s) or accelerometers ("A", m/s²)."""
    about = float(round(0.5 * (low + high)))
    whole = [(f"TC_{letter}_ENABLE", 1, 6), (f"TC_{letter}{number}_ID", int(identity or 0), 6)]
    rows = [*whole, *((f"TC_{letter}{number}_{n}", v, 9) for n, v in (("TREF", about), ("TMIN", low), ("TMAX", high)))]
    for axis in axes:
        b, place = bias_polynomial(axis, about, 3), _TRIAD.index(axis.name.lower())
        rows += [(f"TC_{letter}{number}_X{k}_{place}", float(b[k]), 9) for k in range(4)]
    return rows


def px4_lines(rows: Iterable[tuple[str, float, int]]) -> list[str]:
    """The lines of PX4's file."""
    return [f"1\t1\t{name}\t{int(v) if kind == 6 else single(v)}\t{kind}" for name, v, kind in rows]


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


# --- Kalibr -----------------------------------------------------------------------------------------------------------


def _kalibr(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    triad = _triad(calibration)
    low, high = common_range(triad.values())
    at = one_temperature(options, (low, high), "Kalibr")
    gains: dict[str, float] = {}
    losses: list[Loss] = []
    notes: list[str] = []
    for name in _TRIAD:
        axis = triad.get(name)
        if axis is None:
            gains[name] = 0.0
            notes.append(f"axis {name} is not calibrated: its scale factor is taken as 1")
            continue
        rates = np.linspace(float(axis.valid_rate[0]), float(axis.valid_rate[1]), _GRID)
        along = correction.scale_factor(axis, np.full_like(rates, at), rates)
        gains[name] = float(f"{float(np.mean(along)):.12g}")
        here = float(np.max(np.abs(along - gains[name]))) * PPM
        losses.append(Loss(axis.name, f"scale factor over rate at {at:g} °C", here, "ppm"))
        lost = _lost_scale_factor(axis, gains[name])
        if lost is not None:
            losses.append(lost._replace(what="scale factor over rate and temperature"))
        spread = correction.bias(axis, range_temperatures(axis)) - correction.bias(axis, np.array([at]))
        losses.append(Loss(axis.name, "bias over temperature", float(np.max(np.abs(spread))) * DEG_PER_H, "deg/h"))
        notes += _lost_terms(axis)
    notes.append("Kalibr estimates the bias itself and takes none from this file")
    lines = [
        file_comment(calibration, at),
        "# measured = M * C_gyro_i * rate + A * specific_force + bias + noise   (M lower triangular)",
        "rostopic: /imu0",
    ]
    lines += kalibr_noise(calibration.noise)
    if calibration.noise is None:
        notes.append("the calibration holds no noise: fill in gyroscope_noise_density and gyroscope_random_walk")
    lines += [
        "model: scale-misalignment",
        "gyroscopes:",
        "  M:",
        *matrix_lines(np.diag([1.0 + gains[a] for a in _TRIAD])),
    ]
    lines += ["  A:", *matrix_lines(np.zeros((3, 3))), "  C_gyro_i:", *matrix_lines(np.eye(3))]
    return Export("\n".join(lines) + "\n", tuple(losses), tuple(notes))


def one_temperature(options: Mapping[str, Any], within: tuple[float, float], target: str) -> float:
    """The requested temperature (°C). Raises `ValueError` without one within the range."""
    at = options["temperature_c"]
    if at is None:
        raise ValueError(f"{target}'s file is for one temperature: say which with --temperature")
    low, high = (float(end) for end in within)
    if not low - 1e-9 <= at <= high + 1e-9:
        raise ValueError(f"the calibration covers {low:g} … {high:g} °C, and {at:g} °C is outside")
    return float(at)


def file_comment(calibration: Calibration | UnitCalibration, at: float | None = None) -> str:
    """The comment with the unit and the temperature (°C) of a file."""
    where = "" if at is None else f", {at:g} degC"
    return f"# gradcal {calibration.serial_number}{where}" + (", SIMULATED" if calibration.simulated else "")


def kalibr_noise(noise: Noise | UnitNoise | None) -> list[str]:
    """The lines of the known noise."""
    keys = (
        ("gyroscope_noise_density", "angle_random_walk", "rad/s/sqrt(Hz)"),
        ("gyroscope_random_walk", "rate_random_walk", "rad/s^2/sqrt(Hz)"),
        ("accelerometer_noise_density", "velocity_random_walk", "m/s^2/sqrt(Hz)"),
        ("update_rate", "sample_rate", "Hz"),
    )
    known = ((key, getattr(noise, name, None), unit) for key, name, unit in keys)
    return [f"{key}: {float(value):.9g}  # {unit}" for key, value, unit in known if value is not None]


def matrix_lines(values: Floats) -> list[str]:
    """The rows of a matrix in YAML."""
    return [f"  - {list_text(row)}" for row in values]


def list_text(values: Floats) -> str:
    """A list of numbers in YAML."""
    return "[" + ", ".join(repr(float(v)) for v in values) + "]"


# --- C and CSV --------------------------------------------------------------------------------------------------------


def _c_header(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    text, errors = c_header.axes_header(calibration, options["left_out"])
    losses = tuple(Loss(*error) for error in errors)
    notes = [note for axis in calibration.axis for note in _lost_terms(axis)]
    return Export(text, losses, (*notes, "float32, no allocation, sensor's own axes in the order of the header"))


def _csv(calibration: Calibration, options: Mapping[str, Any]) -> Export:
    rows: list[Sequence[str]] = [("axis", "name", "value", "std", "unit", "temperature_basis", "rate_basis")]
    for axis in calibration.axis:
        std = coefficient_deviations(axis.covariance)
        for part, unit in ((axis.bias, "rad/s"), (axis.scale_factor, "1")):
            if part is not None:
                bases = (basis_words(part.temperature), basis_words(getattr(part, "rate", None)))
                rows += [
                    (axis.name, name, repr(value), std.get(name, ""), unit, *bases)
                    for name, value in part.coefficients.items()
                ]
        if axis.bias_temperature_gradient is not None:
            name = "bias_temperature_gradient"
            value = repr(axis.bias_temperature_gradient)
            rows.append((axis.name, name, value, std.get(name, ""), "rad/K", "", ""))
    return csv_file(calibration, rows)


def coefficient_deviations(covariance: Covariance | None) -> dict[str, str]:
    """Standard deviations of coefficients, as text, by name."""
    if covariance is None:
        return {}
    return {name: repr(float(np.sqrt(covariance.matrix[k][k]))) for k, name in enumerate(covariance.names)}


def csv_file(calibration: Calibration | UnitCalibration, rows: Iterable[Sequence[str]]) -> Export:
    """A table below the calibration's name and what its numbers mean."""
    stream = io.StringIO()
    stream.write(f"{file_comment(calibration)}\n# {calibration.order}\n")
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return Export(stream.getvalue(), (), ())


def basis_words(basis: Any) -> str:
    """A basis in one line."""
    if basis is None:
        return ""
    parts = [f"{key}={value}" for key, value in basis.model_dump(mode="json").items() if key != "internal"]
    return "; ".join(parts)


FORMATS: Final[Mapping[str, Callable[[Calibration, Mapping[str, Any]], Export]]] = {
    "ardupilot": _ardupilot,
    "px4": _px4,
    "kalibr": _kalibr,
    "c-header": _c_header,
    "csv": _csv,
}
