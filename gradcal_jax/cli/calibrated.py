"""`gradcal apply`, `validate` and `export`: uses of a calibration."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import ForceOutput, Json, JsonNumbers, OptionalOutput, Output, show, strong, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import ColumnMapOption, LogFile, RowsOption, UnitOption, load, quantity, text_of_log
from gradcal_jax.tables.table import Column, Table
from gradcal_jax.units import G

if TYPE_CHECKING:
    from gradcal_jax.calibration.exports import Export
    from gradcal_jax.estimation.validation import AxisValidation
    from gradcal_jax.records.log import Log

Calibrated = Annotated[Path, Parameter(help="The calibration file.")]


def apply(
    calibration: Calibrated,
    log: LogFile,
    /,
    *,
    output: Output,
    unit: UnitOption = None,
    columns: ColumnMapOption = None,
    rows: RowsOption = None,
    force: ForceOutput = False,
    json: Json = False,
) -> int:
    """Correct the rates and specific forces of a log with a calibration, and write the result as a log.

    A hysteresis stays in the data. If rows are outside the temperatures or rates of the calibration, the value of the
    calibration at the edge of the range is used for these rows, and the exit status is 1.

    Parameters
    ----------
    output
        The corrected log (.nc).
    json
        Print the name of the corrected log, and the number of rows outside the range of the calibration, as JSON.
    """
    from gradcal_jax.calibration.correction import apply as correct
    from gradcal_jax.calibration.file import read_calibration
    from gradcal_jax.records.log_file import write_log

    content = read_calibration(calibration)
    writable(output, force)
    recorded = _not_corrected(load(log, columns, rows, unit=unit), log)
    number = _unit(recorded, content.serial_number, unit)
    corrected = correct(content, recorded, number)
    write_log(corrected.log, output)
    outside = {"temperatures": corrected.outside_temperature, "rates": corrected.outside_rate}
    record = {"log": str(output), "simulated": corrected.log.simulated, "rows": corrected.log.counts(0)}
    record |= {"outside": outside, "not_calibrated": list(corrected.left_alone)}
    record["not_taken_off"] = list(corrected.left_in)
    edge = "are outside the range of the calibration: the value at the edge of the range was used"
    notes = [f"{count} {what} {edge}" for what, count in outside.items() if count]
    alone, left_in = ", ".join(corrected.left_alone), ", ".join(corrected.left_in)
    notes += [f"these channels are not in the calibration, and were left unchanged: {alone}"] if alone else []
    notes += [f"these errors are in the calibration, but were not subtracted: {left_in}"] if left_in else []
    lines = [text_of_log(corrected.log, str(log)), *(f"note: {note}" for note in notes), f"wrote {output}"]
    return show("\n".join(lines), record, json=json, wished=not any(outside.values()))


def validate(
    calibration: Calibrated,
    log: LogFile,
    /,
    *,
    unit: UnitOption = None,
    earth_rate: str | None = None,
    gravity: str | None = None,
    columns: ColumnMapOption = None,
    rows: RowsOption = None,
    json: JsonNumbers = False,
) -> int:
    """Test a calibration on a different log, and print the remaining errors by temperature and rate.

    The measured errors are compared with the targets in the calibration, each by its own decision rule. The exit status
    is 1 if a target is missed, or if the calibration makes the errors larger instead of smaller.

    Parameters
    ----------
    earth_rate
        The Earth's rate along the sensor's axis, such as "10.4 deg/h"; it is subtracted from the rates.
    gravity
        Local gravity, such as "9.8123 m/s^2", for accelerometers; by default standard gravity.
    """
    from gradcal_jax.calibration.file import read_calibration

    earth = 0.0 if earth_rate is None else quantity(earth_rate, "angular rate", "--earth-rate")
    weight = G if gravity is None else quantity(gravity, "acceleration", "--gravity")
    content = read_calibration(calibration)
    recorded = _not_corrected(load(log, columns, rows, unit=unit), log)
    use_float64()
    from gradcal_jax.estimation import validation as work

    name = _unit(recorded, content.serial_number, unit)
    axes = work.validate(content, recorded, unit=name, earth_rate=earth, gravity=weight)
    judged = work.acceptances(content, axes)
    record = {"simulated": recorded.simulated or content.simulated, "axes": work.validation_rows(axes)}
    record["requirements"] = [row._asdict() for row in judged]
    lines = [text_of_log(recorded, str(log)), *("\n" + _validation_text(row) for row in axes)]
    for row in judged:
        error = f"{row.error:.4g} ± {row.std:.2g} {row.unit} (1σ, from the scatter; errors that all moves have in"
        lines += ["", f"{row.name}, axis {row.axis}: {strong(row.verdict)}", f"  {error} common are not included)"]
    worse = any(after > before for row in axes for before, after in row.rms.values())
    return show("\n".join(lines), record, json=json, wished=not worse and all(row.verdict == "met" for row in judged))


def export(
    calibration: Calibrated,
    /,
    *,
    format: str | None = None,
    template: Path | None = None,
    output: OptionalOutput = None,
    temperature: str | None = None,
    instance: int | None = None,
    device_id: int | None = None,
    force: ForceOutput = False,
    json: Json = False,
) -> int:
    """Write a calibration in the format of another program, and list what that format cannot hold.

    Parameters
    ----------
    format
        The format: ardupilot, px4, c-header, kalibr, matrices, gains, tracker, ins or csv. Leave --format out if you
        use --template.
    template
        Your own template in the Jinja language; gradcal start export-gains writes an example.
    output
        The file to write; by default the text is printed, and the list of losses goes to stderr.
    temperature
        The temperature of the matrices and biases, such as "25 degC": for kalibr, matrices, gains, tracker and ins; for
        a template, if it uses them.
    instance
        Number of the sensor on the flight controller: 1 to 3 for ArduPilot, 0 to 3 for PX4.
    device_id
        PX4's device id of the sensor.
    json
        Print the text, the losses and the notes as JSON.
    """
    from gradcal_jax.calibration import exports
    from gradcal_jax.calibration.file import read_calibration
    from gradcal_jax.tables.document import read_text
    from gradcal_jax.tables.writing import write_whole

    at = None if temperature is None else quantity(temperature, "temperature", "--temperature")
    content = read_calibration(calibration)
    if output is not None:
        writable(output, force)
    if (format is None) == (template is None):
        formats = ", ".join(name for name in exports.FORMATS if name != "template")
        raise ValueError(f"state either a format with --format ({formats}) or a template with --template")
    text = None if template is None else read_text(template)
    number = (0 if format == "px4" else 1) if instance is None else instance
    chosen = {"temperature_c": at, "instance": number, "device_id": device_id}
    done = exports.export(content, format or "template", **chosen, template=text)
    if output is not None:
        write_whole(output, done.text)
    words = export_text(done)
    if output is None and not json:
        print(done.text, end="")
        print(words, file=sys.stderr)
        return 0
    record = {"text": done.text, "losses": [loss._asdict() for loss in done.losses], "notes": done.notes}
    return show(f"{words}\nwrote {output}", record, json=json)


def _not_corrected(log: "Log", path: Path) -> "Log":
    """The log, if no calibration was applied to it. Raises `ValueError` otherwise: it would be corrected twice."""
    if (by := log.provenance.get("corrected")) is not None:
        raise ValueError(f"{path} is already corrected, {by}: name the log as it was recorded")
    return log


def _unit(log: "Log", serial_number: str, unit: str | None) -> str | int:
    if unit is not None:
        return unit
    if serial_number in log.units:
        return serial_number
    if len(log.units) == 1:
        return 0
    raise ValueError(
        f"the calibration is for {serial_number}, but the log has {', '.join(log.units)}: choose the IMU with --unit"
    )


def _validation_text(row: "AxisValidation") -> str:
    used = ", ".join(f"{count} {reason}" for reason, count in row.rows.items())
    together = row.axis in ("gyros", "accelerometers")
    lines = [
        strong(row.axis if together else f"axis {row.axis}") + f": {row.moves} moves, {row.rests} rests; rows: {used}"
    ]
    of = "the norm of " if together else ""
    words = {
        "ppm": "error of the moves' angles",
        "deg/h": f"{of}rate at rest, less the Earth's rate",
        "ug": "error of the norm of gravity at rest",
    }
    for unit, (before, after) in row.rms.items():
        lines.append(f"{words[unit]}: {before:.5g} {unit} rms without, {after:.4g} {unit} with the calibration")
    cells: list[tuple[str | float | None, ...]] = []
    for cell in row.cells:
        warm = cell.temperature_c
        where = "not known" if warm is None else f"{warm[0]:.1f} … {warm[1]:.1f} °C"
        rate = "at rest" if cell.rate_dps is None else f"{cell.rate_dps[0]:.4g} … {cell.rate_dps[1]:.4g} deg/s"
        cells.append((where, rate, cell.how_many, cell.before, cell.after, cell.scatter, cell.unit))
    heads = ["temperature", "mean rate", "how many", "without", "with", Column("scatter", "", 3), "unit"]
    lines.append(Table.of(heads, cells).text(indent="  "))
    return "\n".join([*lines, *(f"note: {message}" for message in row.messages)])


def export_text(done: "Export") -> str:
    """The losses of an export, and its notes."""
    lines: list[str] = []
    if done.losses:
        losses = [(loss.channel, loss.what, loss.value, loss.unit) for loss in done.losses]
        lines.append(Table.of(["channel", "what is lost", "at most", "unit"], losses).text())
    else:
        lines.append("nothing is lost")
    return "\n".join([*lines, *(f"note: {note}" for note in done.notes)])
