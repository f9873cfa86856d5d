"""`gradcal estimate`: a calibration from a log, with covariance, tests and verdicts."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.calibrated import export_text
from gradcal_jax.cli.estimated import discrepancy_lines, text_of_estimate, text_of_held
from gradcal_jax.cli.output import (
    Flag,
    ForceOutput,
    JsonNumbers,
    OptionalOutput,
    Plot,
    as_json,
    drawable,
    save_figure,
    writable,
)
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import WHOLE, LogFile, Recording, described, load, load_all, quantity
from gradcal_jax.cli.status import DONE, NOT_AS_WISHED

if TYPE_CHECKING:
    from gradcal_jax.files.calibration import Calibration
    from gradcal_jax.files.log import Log
    from gradcal_jax.files.spec_sections import Spec

_EARTH_RATE_RAD_PER_S: Final = 7.292115e-5
Axes = Annotated[tuple[str, ...], Parameter(name="--axis", negative="")]
Units = Annotated[tuple[str, ...], Parameter(name="--unit", negative="")]


def estimate(
    log: LogFile,
    more: tuple[Path, ...] = (),
    /,
    *,
    spec: Path | None = None,
    recipe: Path | None = None,
    output: OptionalOutput = None,
    axis: Axes = (),
    unit: Units = (),
    table_axis: str | None = None,
    earth_rate: str | None = None,
    latitude: str | None = None,
    lag: str = "none",
    smoothness: str = "spec",
    robust: Flag = False,
    clock: str | None = None,
    read_every: str | None = None,
    neighbours: str | None = None,
    temperature: str | None = None,
    gravity: str | None = None,
    parameters: Path | None = None,
    points: Path | None = None,
    source: Recording = WHOLE,
    force: ForceOutput = False,
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Estimate a calibration from a log with the model of a spec, and test whether the data agree with the model.

    Without a spec: the bias over temperature of a vehicle that warms up at rest, with the noise from its log; with
    --gravity, an IMU that was laid down in many positions and turned by hand between them.

    The exit status is 1 if a target is missed, a parameter cannot be observed, or the data contradict the model.

    Parameters
    ----------
    more
        For an IMU in several mountings on the table: the logs of the other mountings, in the order of the spec.
    spec
        The spec: noise, table and maps of the sensor. The motion is read from the log itself.
    recipe
        The recipe that was run, instead of its spec.
    output
        Write the calibration here; with several IMUs, one file for each, with the name of the IMU.
    axis
        The sensor's axis that the table turned, if the spec has one gyro on a table of one axis; by default that of
        the spec, or the only one of the log. Without a spec: which axes; may be repeated.
    unit
        Which IMU; may be repeated. All, without it.
    table_axis
        The name in the log of the axis of a one-axis table.
    earth_rate
        The Earth's rate along the sensor's axis, such as "10.4 deg/h"; it is taken off.
    latitude
        Instead of --earth-rate, for an axis that points straight up.
    lag
        The lag of the maps behind the measured temperature: a time, or "fit".
    smoothness
        The smoothness of bins and B-splines: "spec", or "auto": the value with the largest probability of the data.
    robust
        Give readings that the model cannot explain less weight (Huber), and list them.
    clock
        The clock over which rates are integrated: "sensor", or "host" (the computer's). By default that of the spec,
        or else the computer's clock if the log has both.
    read_every
        Spacing of the readings while the table is at rest, in a log with its angle at every row; without it the
        spec's.
    neighbours
        Also without a structure: average moves of the same rate within, for example, "5 K", and compare them with the
        map.
    temperature
        The temperature, if the log has none, such as "23 degC".
    gravity
        Local gravity, such as "9.80665 m/s^2": calibrate three accelerometers and three gyros with it alone, without
        table and spec. The IMU lay still in some twenty positions in all directions, and was turned by hand between
        them; readings may be raw counts.
    parameters
        Also write the bias over temperature here, as parameters of the flight controller (PX4, ArduPilot) that wrote
        the log.
    points
        The point map of a table of points (gradcal-points/1), instead of a log: its columns of temperature, rate of
        the table, output and standard deviation; see gradcal new point-map.
    plot
        Draw the fit into this file (.png, .svg, .pdf).
    """
    in_use: dict[str, object] = {"--spec": spec, "--recipe": recipe, "--axis": axis, "--table-axis": table_axis}
    in_use |= {"--earth-rate": earth_rate, "--latitude": latitude, "--smoothness": smoothness != "spec"}
    in_use |= {"--robust": robust, "--lag": lag != "none", "--read-every": read_every}
    in_use |= {"--neighbours": neighbours, "--parameters": parameters, "--points": points, "a second log": more}
    if gravity is not None:
        _refuse(in_use, ("--latitude",), "not for an IMU that was turned by hand (--gravity)")
    options = _options(earth_rate, latitude, lag, smoothness, clock, read_every, neighbours, temperature)
    drawable(plot)
    if gravity is not None:
        recorded = load(log, source)
        files = _files(output, unit or recorded.units, force)
        g = quantity(gravity, "acceleration", "--gravity")
        return _by_hand(log, recorded, g, unit, options, files, plot, json)
    model = None if spec is None and recipe is None else _spec(spec, recipe)
    if len(axis) > 1 and model is not None:
        raise ValueError("a table of one axis turns one axis of an IMU: give --axis once")
    table_of_points, logs = None, list["Log"]()
    if points is not None:
        from gradcal_jax.files.points import read_points

        if model is None or source != WHOLE or axis or unit or more or temperature is not None:
            raise ValueError("--points needs the spec (--spec), and does not allow options that select a part of a log")
        table_of_points = read_points(log, points)
        names = [table_of_points.unit]
    elif model is None:
        logs = load_all(log, source)
        if more or any(one.table_axes for one in logs) or temperature is not None:
            raise ValueError("give the spec with --spec, or the recipe that was run with --recipe: one of them")
        names = unit or [name for one in logs for name in one.units]
    else:
        logs = [load(path, source, unit=unit[0] if unit else None) for path in (log, *more)]
        of_all = dict.fromkeys(name for one in logs for name in one.units)
        names = unit or (tuple(of_all) if model.rig.table.place else logs[0].units)
    firmware = logs[0].provenance.get("firmware") if logs else None
    if parameters is not None:
        if firmware is None:
            raise ValueError(
                "--parameters is only for logs of PX4 (.ulg) and ArduPilot (.bin): see gradcal export for others"
            )
        writable(parameters, force)
    files = _files(output, names, force)
    use_float64()
    from gradcal_jax.api.estimate import EstimateReport, estimate_log, estimate_rows
    from gradcal_jax.api.estimate_options import Options
    from gradcal_jax.api.warm_up import estimate_points, estimate_warm_up

    sources = {"log": ", ".join(path.name for path in (log, *more)), "spec": (spec or recipe or Path()).name}
    chosen = Options(**options, table_axis=table_axis, robust=robust)
    if table_of_points is not None and model is not None:
        report = EstimateReport((estimate_points(model, table_of_points, options=chosen, sources=sources),))
    elif model is None:
        report = estimate_warm_up(logs, axes=axis, units=unit, options=chosen, sources=sources)
    else:
        only = axis[0] if axis else None
        report = estimate_log(model, logs, axis=only, units=unit, options=chosen, sources=sources)
    if json:
        print(as_json(estimate_rows(report)))
    else:
        paths = [log, *more] if len(logs) == 1 + len(more) else [log] * len(logs)
        heads = [described(one, str(path)) for one, path in zip(logs, paths, strict=True)]
        print("\n".join(heads) or f"{log}: a table of points")
        print("\n".join(map(text_of_estimate, report.sensors)))
        print("\n".join(line for row in report.discrepancies for line in discrepancy_lines(row)))
    _write(report.calibrations, files, json)
    if parameters is not None and firmware is not None:
        from gradcal_jax.files.calibration.exports import export_sensors
        from gradcal_jax.files.writing import write_whole

        done = export_sensors(report.calibrations, firmware)
        write_whole(parameters, done.text)
        if not json:
            print(f"{export_text(done)}\nwrote {parameters}")
    save_figure(lambda plots: plots.calibration.draw_estimate(report), plot, quiet=json)
    return DONE if report.as_wished else NOT_AS_WISHED


def _by_hand(
    path: Path,
    recorded: "Log",
    gravity: float,
    units: Sequence[str],
    options: dict[str, Any],
    files: Mapping[str, Path],
    plot: Path | None,
    json: bool,
) -> int:
    """The estimate of IMUs that were laid down in many positions, without a table."""
    from gradcal_jax.api.estimate_options import Options
    from gradcal_jax.api.hand_estimate import estimate_by_hand, hand_estimate_rows

    reports = estimate_by_hand(recorded, gravity, units=units, options=Options(**options), sources={"log": path.name})
    if json:
        print(as_json({"units": list(map(hand_estimate_rows, reports))}))
    else:
        print("\n".join([described(recorded, str(path)), *map(text_of_held, reports)]))
    _write([report.calibration for report in reports], files, json)
    save_figure(lambda plots: plots.calibration.draw_by_hand(reports[0]), plot, quiet=json)
    return DONE if all(report.as_wished for report in reports) else NOT_AS_WISHED


def _write(calibrations: "Sequence[Calibration]", files: Mapping[str, Path], json: bool) -> None:
    """Write the calibrations of those sensors that have a file."""
    from gradcal_jax.files.calibration import write_calibration

    for one in calibrations:
        if (path := files.get(one.serial_number)) is not None:
            write_calibration(one, path)
            if not json:
                print(f"wrote {path}")


def _refuse(options: dict[str, object], taken: tuple[str, ...], words: str) -> None:
    """Raise `ValueError` for any option in use that is not in `taken`."""
    if used := [name for name, value in options.items() if value and name not in taken]:
        raise ValueError(f"{', '.join(used)}: {words}")


def _options(
    earth_rate: str | None,
    latitude: str | None,
    lag: str,
    smoothness: str,
    clock: str | None,
    read_every: str | None,
    neighbours: str | None,
    temperature: str | None,
) -> dict[str, Any]:
    """The options' texts as fields of `api.estimate_options.Options`, in SI. Raises `ValueError` with the option's
    name."""
    earth = None
    if earth_rate is not None and latitude is not None:
        raise ValueError("--earth-rate and --latitude both state the Earth's rate: use one of them")
    if earth_rate is not None:
        earth = quantity(earth_rate, "angular rate", "--earth-rate")
    elif latitude is not None:
        earth = _EARTH_RATE_RAD_PER_S * math.sin(quantity(latitude, "angle", "--latitude"))
    lag_s = "fit" if lag == "fit" else 0.0 if lag == "none" else quantity(lag, "time", "--lag")
    if lag_s != "fit" and lag_s < 0.0:
        raise ValueError(f"--lag {lag!r}: a lag is not negative")
    if smoothness not in ("spec", "auto"):
        raise ValueError(f'--smoothness {smoothness!r}: expected "spec" or "auto"')
    if clock not in (None, "sensor", "host"):
        raise ValueError(f'--clock {clock!r}: expected "sensor" or "host"')
    every = None if read_every is None else quantity(read_every, "time", "--read-every")
    if every is not None and every <= 0.0:
        raise ValueError(f"--read-every {read_every!r}: must be longer than 0 s")
    width = None if neighbours is None else quantity(neighbours, "temperature difference", "--neighbours")
    if width is not None and width <= 0.0:
        raise ValueError(f"--neighbours {neighbours!r}: must be more than 0 K")
    options = {"earth_rate": earth, "lag": lag_s, "smoothness": smoothness, "clock": clock}
    at = None if temperature is None else quantity(temperature, "temperature", "--temperature")
    return options | {"read_every": every, "neighbours_k": width, "temperature_c": at}


def _spec(spec: Path | None, recipe: Path | None) -> "Spec":
    if (spec is None) == (recipe is None):
        raise ValueError("give the spec with --spec, or the recipe that was run with --recipe: one of them")
    from gradcal_jax.files.recipe import read_recipe, spec_in

    if spec is not None:
        return spec_in(spec)
    assert recipe is not None
    return read_recipe(recipe).spec


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
