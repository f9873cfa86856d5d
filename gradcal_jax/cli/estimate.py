"""`gradcal estimate`: a calibration from a log, with covariance, tests and verdicts."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.calibrated import export_text
from gradcal_jax.cli.output import (
    DONE,
    NOT_AS_WISHED,
    Flag,
    ForceOutput,
    JsonNumbers,
    OptionalOutput,
    Plot,
    as_json,
    drawable,
    save_figure,
    strong,
    writable,
)
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import WHOLE, LogFile, Recording, described, load, load_all, quantity
from gradcal_jax.tables.display import columns as table
from gradcal_jax.units import PPM, G

if TYPE_CHECKING:
    from gradcal_jax.calibration import Calibration
    from gradcal_jax.estimation import Group
    from gradcal_jax.estimation.contradictions import MeasuredDiscrepancy
    from gradcal_jax.estimation.estimate import SensorEstimate
    from gradcal_jax.estimation.hand_estimate import HandReport
    from gradcal_jax.records.log import Log
    from gradcal_jax.spec.spec_sections import Spec
    from gradcal_jax.tables.contracts import RequirementRow

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
    lag: str = "auto",
    smoothness: str = "spec",
    robust: Flag = False,
    clock: str | None = None,
    read_every: str | None = None,
    neighbours: str | None = None,
    temperature: str | None = None,
    gravity: str | None = None,
    parameters: Path | None = None,
    source: Recording = WHOLE,
    force: ForceOutput = False,
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Estimate a calibration from a log with the model of a spec, and test whether the data agree with the model.

    Without a spec, estimate the bias over temperature of a vehicle that warms up at rest; the noise is estimated from
    the same log. With --gravity, calibrate an IMU that lay still in many positions and was turned by hand between them.

    The exit status is 1 if a target is missed, if a parameter cannot be observed, or if the data contradict the model.

    Parameters
    ----------
    more
        For an IMU that was mounted on the table in several ways: the logs of the other mountings, in the order of the
        spec.
    spec
        The spec; it states the noise, the table and the maps to be estimated. The motion is taken from the
        log.
    recipe
        The recipe that was run; it contains its spec, so --spec is not needed.
    output
        The calibration file to write. If there are several IMUs, one file is written for each, and the name of the IMU
        is added to the name of the file.
    axis
        If the spec has one gyro on a table of one axis: the sensor axis about which the table turned; by default the
        axis in the spec, or the only axis in the log. Without a spec: the axes to calibrate; may be repeated.
    unit
        Which IMU of the log; may be repeated; by default all.
    table_axis
        For a table with one axis: the name of this axis in the log.
    earth_rate
        The Earth's rate along the sensor's axis, such as "10.4 deg/h"; it is subtracted from the rates.
    latitude
        If the sensor's axis points straight up: the latitude of the site, from which the Earth's rate is computed
        (instead of --earth-rate).
    lag
        The lag of the maps behind the measured temperature: a time, "none", "fit" to estimate it, or "auto" to estimate
        it and to use it if the data show a lag.
    smoothness
        The smoothness of bins and B-splines: "spec" for that in the spec, or "auto" for the smoothness with which the
        data are most probable.
    robust
        Give less weight (Huber) to readings that the model cannot explain, and list these readings.
    clock
        The clock whose time is used to integrate rates: "sensor", or "host" (the computer's). By default the clock that
        the spec states; if the spec states none and the log has both clocks, the computer's.
    read_every
        For a log that has the table's angle in every row: the time between the readings that are used while the table
        is at rest; by default that of the spec.
    neighbours
        Also estimate the scale factor without a map: average the moves of the same rate within this temperature
        difference, such as "5 K", and compare the means with the map.
    temperature
        The temperature, if the log has none, such as "23 degC".
    gravity
        Local gravity, such as "9.80665 m/s^2". Gravity is then the only reference for three accelerometers and three
        gyros; no table and no spec are needed. The IMU must have been at rest in about twenty positions in all
        directions, and turned by hand between them. The readings may be raw counts.
    parameters
        Also write the bias over temperature to this file, as parameters of the flight controller (PX4, ArduPilot) that
        wrote the log.
    plot
        Draw the fit into this file (.png, .svg, .pdf).
    """
    in_use: dict[str, object] = {"--spec": spec, "--recipe": recipe, "--axis": axis, "--table-axis": table_axis}
    in_use |= {"--earth-rate": earth_rate, "--latitude": latitude, "--smoothness": smoothness != "spec"}
    in_use |= {"--robust": robust, "--lag": lag != "auto", "--read-every": read_every}
    in_use |= {"--neighbours": neighbours, "--parameters": parameters, "a second log": more}
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
        raise ValueError("a table with one axis turns only one axis of an IMU: give --axis only once")
    if model is None:
        logs = load_all(log, source)
        if more or any(one.table_axes for one in logs) or temperature is not None:
            raise ValueError("give either the spec (--spec) or the recipe that was run (--recipe)")
        names = unit or [name for one in logs for name in one.units]
    else:
        logs = [load(path, source, unit=unit[0] if unit else None) for path in (log, *more)]
        of_all = dict.fromkeys(name for one in logs for name in one.units)
        names = unit or (tuple(of_all) if model.rig.table.place else logs[0].units)
    firmware = logs[0].provenance.get("firmware")
    if parameters is not None:
        if firmware is None:
            raise ValueError(
                "--parameters is only for logs of PX4 (.ulg) and ArduPilot (.bin); for other formats use gradcal export"
            )
        writable(parameters, force)
    files = _files(output, names, force)
    use_float64()
    from gradcal_jax.estimation.estimate import estimate_log, estimate_rows
    from gradcal_jax.estimation.log_flow import estimate_warm_up
    from gradcal_jax.estimation.log_rows import Options

    sources = {"log": ", ".join(path.name for path in (log, *more)), "spec": (spec or recipe or Path()).name}
    chosen = Options(**options, table_axis=table_axis, robust=robust)
    if model is None:
        report = estimate_warm_up(logs, axes=axis, units=unit, options=chosen, sources=sources)
    else:
        only = axis[0] if axis else None
        report = estimate_log(model, logs, axis=only, units=unit, options=chosen, sources=sources)
    if json:
        print(as_json(estimate_rows(report)))
    else:
        paths = [log, *more] if len(logs) == 1 + len(more) else [log] * len(logs)
        heads = [described(one, str(path)) for one, path in zip(logs, paths, strict=True)]
        print("\n".join(heads))
        print("\n".join(map(text_of_estimate, report.sensors)))
        print("\n".join(line for row in report.discrepancies for line in discrepancy_lines(row)))
    _write(report.calibrations, files, json)
    if parameters is not None and firmware is not None:
        from gradcal_jax.calibration.exports import export_sensors
        from gradcal_jax.tables.writing import write_whole

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
    from gradcal_jax.estimation.hand_estimate import estimate_by_hand, hand_estimate_rows
    from gradcal_jax.estimation.log_rows import Options

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
    from gradcal_jax.calibration import write_calibration

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
    """The options' texts as fields of `api.log_rows.Options`, in SI. Raises `ValueError` with the option's
    name."""
    earth = None
    if earth_rate is not None and latitude is not None:
        raise ValueError("--earth-rate and --latitude both state the Earth's rate: use one of them")
    if earth_rate is not None:
        earth = quantity(earth_rate, "angular rate", "--earth-rate")
    elif latitude is not None:
        earth = _EARTH_RATE_RAD_PER_S * math.sin(quantity(latitude, "angle", "--latitude"))
    lag_s = lag if lag in ("auto", "fit") else 0.0 if lag == "none" else quantity(lag, "time", "--lag")
    if not isinstance(lag_s, str) and lag_s < 0.0:
        raise ValueError(f"--lag {lag!r}: must not be negative")
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
        raise ValueError("give either the spec (--spec) or the recipe that was run (--recipe)")
    from gradcal_jax.recipe.recipe import read_recipe, spec_in

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


# More coefficients than these are read in the file.
_MOST_COEFFICIENTS = 30


def _head(report: "SensorEstimate | HandReport", counted: str) -> list[str]:
    calibration = report.calibration
    low, high = calibration.valid_temperature
    fastest = math.degrees(float(calibration.valid_rate[1]))
    return [
        "",
        strong(f"IMU {report.unit}" + (", SIMULATED" if calibration.simulated else "")),
        f"{counted}; covers {low} … {high}, up to {fastest:.4g} deg/s",
        f"frame: {calibration.frame}",
    ]


def _tests(report: "SensorEstimate | HandReport") -> str:
    rows = [("test", "statistic", "degrees", "p-value")]
    for test in report.calibration.fit:
        name = test.name.replace("_", " ")
        rows.append((name, f"{test.statistic:.1f}", str(test.degrees), f"{test.chance:.2g}"))
    return table(rows, right=(1, 2, 3))


def requirement_lines(rows: "Sequence[RequirementRow]") -> list[str]:
    """The requirements as an estimate meets them, and the rules of their verdicts."""
    names = [f"{row.name}, {row.limited_by or f'axis {row.axis}'}" for row in rows]
    from gradcal_jax.tables.contracts import requirement_table

    shown = requirement_table(rows, names)
    return ["", table(shown, indent=""), *(f"{n}: {row.rule}" for n, row in zip(names, rows, strict=True) if row.rule)]


def text_of_estimate(report: "SensorEstimate") -> str:
    from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
    from gradcal_jax.model import SCALE_FACTOR
    from gradcal_jax.pages.coefficients import estimated_coefficients

    calibration, model = report.calibration, report.built.model
    readings, channels = len(report.solution.weights), len(model.channels)
    counted = f"{readings} readings" + (f" of {channels} channels" if channels > 1 else "")
    lines = _head(report, counted)
    lines.append("rows: " + ", ".join(f"{count} {reason}" for reason, count in report.counts.items()))
    lines += requirement_lines(report.requirements)
    if len(calibration.values()) <= _MOST_COEFFICIENTS:
        rows, right = estimated_coefficients(calibration)
        lines += ["", table(rows, right=right)]
    if report.smoothness is not None:
        stds = (
            (f"{channel} {name}".replace("_", " "), std, *UNITS_OF_TERMS["1" if name == SCALE_FACTOR else "rad/s"])
            for (channel, name), std in report.smoothness.stds.items()
        )
        words = ", ".join(f"{name} {std * factor:.3g} {unit}" for name, std, unit, factor in stds)
        lines.append(f"smoothness (1σ of the difference between neighbouring values): {words}")
    spread = _sizes(report)
    lines += ["", "the largest value of each term over temperature and rate:", table(spread, right=(1, 2))]
    if calibration.path:
        of_path: list[tuple[str, ...]] = [("in addition to the maps", "value", "1σ", "")]
        for one in calibration.path:
            unit, factor = UNITS_OF_TERMS.get(one.unit, (one.unit, 1.0))
            numbers = f"{one.value * factor:.4g}", f"{one.standard_deviation * factor:.2g}"
            of_path.append((f"{one.channel} {one.name}".replace("_", " "), *numbers, unit))
        lines += [table(of_path, right=(1, 2))]
    if report.internal:
        inside = [("between the axes", "value", "1σ", "")]
        inside += [(m.name, f"{m.value * 1e6:.2f}", f"{m.std * 1e6:.2g}", "µrad") for m in report.internal]
        lines += [table(inside, right=(1, 2))]
    if calibration.table:
        of_table: list[tuple[str, ...]] = [("error of the table", "value", "1σ", "known to", "")]
        for error in calibration.table:
            unit, factor = UNITS_OF_TERMS.get(error.unit, (error.unit, 1.0))
            sizes = (v * factor for v in (error.value, error.standard_deviation, error.prior))
            # Four digits, without a power of ten.
            numbers = (f"{float(f'{size:.4g}'):.9g}" for size in sizes)
            of_table.append((error.name.replace("_", " "), *numbers, unit))
        lines += [table(of_table, right=(1, 2, 3))]
    tests = report.consistency
    lines += [
        _tests(report),
        f"  the residuals are {tests.noise_scale:.3f} times the noise of the spec; {tests.beyond_three:.2%} of them "
        f"exceed 3σ, and the largest is {tests.largest:.1f}σ",
    ]
    lines += [_neighbours(name, groups) for name, groups in report.neighbours.items()]
    if report.gravity is not None:
        before, after = (1e6 * v / G for v in report.gravity)
        lines.append(
            f"|f| - g over all rests: {before:.4g} µg rms as measured, {after:.4g} µg rms after the correction"
        )
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])


def _neighbours(channel: str, groups: "Sequence[Group]") -> str:
    shown = [(channel.replace("_", " "), "mean rate", "moves", "without a map", "1σ", "the map", "unit")]
    for g in groups:
        where = (f"{g.temperature_c:.1f} °C", f"{math.degrees(g.rate_rad_per_s):.4g} deg/s", str(g.moves))
        error = "" if g.standard_error is None else f"{g.standard_error * PPM:.3g}"
        shown.append((*where, f"{g.scale_factor * PPM:.5g}", error, f"{g.of_map * PPM:.5g}", "ppm"))
    return table(shown, right=(1, 2, 3, 4, 5))


def discrepancy_lines(row: "MeasuredDiscrepancy") -> list[str]:
    """The size of a measured discrepancy, and its table for a spec."""
    several = f", {row.units} IMUs together" if row.units > 1 else ""
    high = "∞" if row.high is None else f"{row.high:.3g}"
    heading = (
        f"discrepancy of the {row.quantity.replace('_', ' ')}, axis {row.axis}{several}: {row.standard_deviation:.3g} "
        f"{row.unit} (95 % interval {row.low:.3g} … {high})"
    )
    return ["", heading, *([f"  {line}" for line in row.block.splitlines()] if row.low > 0.0 else [])]


def _sizes(report: "SensorEstimate") -> list[tuple[str, ...]]:
    """The largest value of every channel's terms over temperature (and rate)."""
    # Imported where they are used: the help of all commands imports this.
    import numpy as np

    from gradcal_jax.calibration.correction import term_values
    from gradcal_jax.information.imu_residual import UNITS_OF_TERMS

    calibration = report.calibration
    low, high = (float(t) for t in calibration.valid_temperature)
    slow, fast = (float(r) for r in calibration.valid_rate)
    temperature, rate = (x.ravel() for x in np.meshgrid(np.linspace(low, high, 41), np.linspace(slow, fast, 21)))
    rows = [("term", "largest", "at 20 °C", "")]
    for channel in calibration.channel:
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS.get(term.unit, (term.unit, 1.0))
            values = term_values(term, temperature, rate) * factor
            middle = term_values(term, np.array([np.clip(20.0, low, high)]), np.zeros(1))[0] * factor
            name = f"{channel.name} {term.name}".replace("_", " ")
            rows.append((name, f"{np.max(np.abs(values)):.5g}", f"{middle:.5g}", unit))
    return rows


def text_of_held(report: "HandReport") -> str:
    from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
    from gradcal_jax.information.verdicts import deviations_of

    calibration = report.calibration
    lines = _head(report, f"{len(report.solution.positions.duration)} positions, {report.solution.turns} turns")
    std = deviations_of(calibration.covariance)
    rows = [("parameter", "value", "1σ", "")]
    for channel in calibration.channel:
        gain = (report.solution.gyro if channel.kind == "gyro" else report.solution.accelerometer).gain
        for term in channel.term:
            unit, factor = UNITS_OF_TERMS[term.unit]
            add = 0.0
            if gain != 1.0 and term.name == "bias":
                unit, factor = "counts", 1.0
            elif gain != 1.0 and term.name == "scale_factor":
                unit, factor, add = "counts per " + ("rad/s" if channel.kind == "gyro" else "m/s^2"), 1.0, 1.0
            elif gain != 1.0:  # proportional to the gain
                factor /= gain
            for name, value in term.coefficients.items():
                known = std.get(f"{channel.name}.{name}")
                error = "not observable" if known is None else f"{known * factor:.3g}"
                what = f"{channel.name} {term.name}".replace("_", " ")
                rows.append((what, f"{value * factor + add:.6g}", error, unit))
    lines += ["", table(rows, right=(1, 2))]
    lines += ["", _tests(report)]
    lines.append(f"residual of |f| - g over the positions: {report.gravity_left / G * 1e6:.4g} µg rms")
    lines.append(f"residual of gravity's direction after the turns: {report.turns_left * 1e6:.4g} µrad rms")
    return "\n".join([*lines, *(f"note: {message}" for message in report.messages)])
