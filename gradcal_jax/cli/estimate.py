"""`gradcal estimate`: a calibration from a log, with covariance, tests and verdicts."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import ForceOutput, JsonNumbers, OptionalOutput, show, strong, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.progress import MovingLine
from gradcal_jax.cli.recordings import ColumnMapOption, LogFile, load, load_all, quantity, text_of_log

if TYPE_CHECKING:
    from gradcal_jax.calibration.file import Calibration
    from gradcal_jax.estimation.estimate import SensorEstimate
    from gradcal_jax.estimation.hand_estimate import HandReport
    from gradcal_jax.records.log import Log
    from gradcal_jax.spec.spec_sections import Spec
    from gradcal_jax.tables.table import Table

SpecFile = Annotated[Path | None, Parameter(name=["--spec", "--recipe"])]
# More coefficients than these are read in the file.
_MOST_COEFFICIENTS: Final = 30


def estimate(
    log: LogFile,
    more: tuple[Path, ...] = (),
    /,
    *,
    spec: SpecFile = None,
    output: OptionalOutput = None,
    gravity: str | None = None,
    temperature: str | None = None,
    columns: ColumnMapOption = None,
    force: ForceOutput = False,
    json: JsonNumbers = False,
) -> int:
    """Estimate a calibration from a log with the model of a spec, and test whether the data agree with the model.

    Without a spec, estimate the bias over temperature of a vehicle that warms up at rest; of accelerometers, its change
    with temperature. With --gravity, calibrate an IMU that lay still in many positions and was turned by hand between
    them.

    The exit status is 1 if a target is missed, if a parameter cannot be observed, or if the data contradict the model.

    Parameters
    ----------
    more
        For an IMU that was mounted on the table in several ways: the logs of the other mountings, in the order of the
        spec.
    spec
        The spec, or the recipe that was run; it states the noise, the table and the maps to be estimated. The motion is
        taken from the log.
    output
        The calibration file to write. If there are several IMUs, one file is written for each, and the name of the IMU
        is added to the name of the file.
    gravity
        Local gravity, such as "9.80665 m/s^2". Gravity is then the only reference for three accelerometers and three
        gyros; no table and no spec are needed.
    temperature
        The temperature, if the log has none, such as "23 degC".
    """
    from gradcal_jax.calibration.file import write_calibration
    from gradcal_jax.recipe.recipe import spec_in

    at = None if temperature is None else quantity(temperature, "temperature", "--temperature")
    model = None if spec is None else spec_in(spec)
    if gravity is not None and (model is not None or more):
        raise ValueError("--gravity: an IMU that was turned by hand needs no --spec and no second log")
    g = None if gravity is None else quantity(gravity, "acceleration", "--gravity")
    if model is None and g is None:
        logs = load_all(log, columns)
        if more or any(one.table_axes for one in logs):
            raise ValueError("name the spec, or the recipe that was run, with --spec")
    else:
        logs = [load(path, columns) for path in (log, *more)]
    several = model is None or model.rig.table.place
    of_all = dict.fromkeys(name for one in logs for name in one.units)
    files = _files(output, tuple(of_all) if several else logs[0].units, force)
    sources = {"log": ", ".join(path.name for path in (log, *more)), "spec": "" if spec is None else spec.name}
    if model is not None:
        rows, texts, calibrations, wished = _with_model(model, logs, at, sources)
    elif g is not None:
        rows, texts, calibrations, wished = _by_hand(logs[0], g, at, sources)
    else:
        rows, texts, calibrations, wished = _warm_up(logs, sources)
    lines = [text_of_log(one, str(path)) for one, path in zip(logs, (log, *more), strict=False)]
    lines += texts
    for one in calibrations:
        if (path := files.get(one.serial_number)) is not None:
            write_calibration(one, path)
            lines.append(f"wrote {path}; its page: gradcal report {path} -o page.html")
    return show("\n".join(lines), rows, json=json, wished=wished)


# Of an estimate of any kind: its numbers, words, calibrations, and whether all is as wished.
_Done = tuple[Any, list[str], "Sequence[Calibration]", bool]


def _with_model(model: "Spec", logs: "Sequence[Log]", at_c: float | None, sources: dict[str, str]) -> _Done:
    use_float64()
    from gradcal_jax.estimation.estimate import estimate_log, estimate_rows
    from gradcal_jax.estimation.log_rows import Options

    with MovingLine(sys.stderr) as line:
        shown: dict[str, Any] = {} if line.plain else {"progress": line.show}
        report = estimate_log(model, logs, options=Options(temperature_c=at_c, **shown), sources=sources)
    return estimate_rows(report), list(map(text_of_estimate, report.sensors)), report.calibrations, report.as_wished


def _warm_up(logs: "Sequence[Log]", sources: dict[str, str]) -> _Done:
    """The biases over temperature of IMUs that warm up at rest, without a spec."""
    from gradcal_jax.estimation.warm_up import estimate_warm_up, warm_up_rows
    from gradcal_jax.pages.tables import coefficients

    report = estimate_warm_up(logs, sources={"log": sources["log"]})
    texts: list[str] = []
    for one in report.calibrations:
        texts.append(_text(one, "", [coefficients(None, one)], [], report.messages[one.serial_number]))
    return warm_up_rows(report), texts, report.calibrations, report.as_wished


def _by_hand(log: "Log", gravity: float, temperature_c: float | None, sources: dict[str, str]) -> _Done:
    """The estimate of IMUs that were laid down in many positions, without a table."""
    from gradcal_jax.estimation.hand_estimate import estimate_by_hand, hand_estimate_rows

    names = {"log": sources["log"]}
    reports = estimate_by_hand(log, gravity, units=log.units, temperature_c=temperature_c, sources=names)
    rows = {"units": list(map(hand_estimate_rows, reports))}
    wished = all(report.as_wished for report in reports)
    return rows, list(map(text_of_held, reports)), [report.calibration for report in reports], wished


def _files(output: Path | None, units: Sequence[str], force: bool) -> dict[str, Path]:
    """The output file of each IMU, checked to be writable; for several IMUs, with the name of the IMU added."""
    if output is None:
        return {}
    files = {units[0]: output}
    if len(units) != 1:
        safe = {name: "".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in units}
        files = {name: output.with_name(f"{output.stem}-{plain}{output.suffix}") for name, plain in safe.items()}
    for path in files.values():
        writable(path, force)
    return files


def text_of_estimate(report: "SensorEstimate") -> str:
    """An estimate in words: requirements, coefficients, errors of the table, tests."""
    from gradcal_jax.pages.tables import coefficients, errors_of_table, of_path
    from gradcal_jax.spec.contracts import outcomes

    calibration, solution, left = report.calibration, report.solution, abs(report.solution.residuals)
    counts = ", ".join(f"{count} {reason}" for reason, count in report.counts.items())
    few = len(calibration.values()) <= _MOST_COEFFICIENTS
    tables = [outcomes(report.requirements), *([coefficients(None, calibration)] if few else [])]
    tables += [of_path(calibration), errors_of_table(calibration)]
    fits = (
        f"the residuals are {solution.noise_scale:.3f} times the noise of the spec; {(left > 3.0).mean():.2%} of them "
        f"exceed 3σ, and the largest is {left.max():.1f}σ"
    )
    return _text(calibration, f"{solution.used.sum()} readings; rows: {counts}", tables, [fits], report.messages)


def text_of_held(report: "HandReport") -> str:
    """The estimate of an IMU that was turned by hand, in words."""
    from gradcal_jax.pages.tables import coefficients
    from gradcal_jax.units import G

    left = [
        f"residual of |f| - g over the positions: {report.gravity_left / G * 1e6:.4g} µg rms",
        f"residual of gravity's direction after the turns: {report.turns_left * 1e6:.4g} µrad rms",
    ]
    counted = f"{len(report.solution.positions.duration)} positions, {report.solution.turns} turns"
    return _text(report.calibration, counted, [coefficients(None, report.calibration)], left, report.messages)


def _text(
    calibration: "Calibration", counted: str, tables: "Sequence[Table]", left: Sequence[str], messages: Sequence[str]
) -> str:
    """A calibration in words: what was counted, tables, tests of the fit, sentences on what is left, and notes."""
    from gradcal_jax.pages.tables import tests

    lines = ["", strong(f"IMU {calibration.serial_number}" + (", SIMULATED" if calibration.simulated else ""))]
    lines += [*filter(None, (counted, calibration.valid_range)), f"frame: {calibration.frame}"]
    for table in (*tables, tests(calibration)):
        lines += ["", table.text()] if table.rows else []
    return "\n".join([*lines, *left, *(f"note: {message}" for message in messages)])
