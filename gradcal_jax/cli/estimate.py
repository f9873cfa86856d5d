"""`gradcal estimate`: a calibration from a log, with covariance, tests and verdicts."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclopts import Parameter

from gradcal_jax.cli.calibrated import export_text
from gradcal_jax.cli.console import strong
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
from gradcal_jax.pages.plain_text import columns as table

if TYPE_CHECKING:
    from gradcal_jax.api.calibration import EstimateReport
    from gradcal_jax.api.structure_tests import MeasuredDiscrepancy
    from gradcal_jax.api.unit_channel import UnitChannel
    from gradcal_jax.files import Spec
    from gradcal_jax.files.calibration import UnseenError
    from gradcal_jax.files.unit_spec import UnitSpec

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
    read_every: str = "1 s",
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
    """Estimate a calibration from a log by the model of a spec, and test whether the data agree with that model.

    Without a spec: the bias over temperature of a vehicle at rest that warms by itself, with the noise of its log;
    with --gravity, a whole unit that was laid down in many positions and turned by hand between them.

    The exit status is 1 where a target is missed, something cannot be observed, or the data contradict the model.

    Parameters
    ----------
    more
        For a whole unit in several mountings on the table: the logs of the other mountings, in the spec's order.
    spec
        The spec: noise, table and maps of the sensor. The motion is read from the log itself.
    recipe
        The recipe that was run, in the place of its spec.
    output
        Write the calibration here; with several units, one file each, with the unit's name in the file's.
    axis
        Which axis; may be repeated. Those of the spec, without it.
    unit
        Which unit; may be repeated. All, without it.
    table_axis
        The axis of the table that turns the sensor's.
    earth_rate
        The Earth rate along the sensor's axis, such as "10.4 deg/h"; it is taken off.
    latitude
        In the place of --earth-rate, for an axis that points straight up.
    lag
        The lag of the maps behind the measured temperature: a time, or "fit".
    smoothness
        The smoothness of bins and B-splines: "spec", or "auto": the one at which the data are most probable.
    robust
        Give readings that the model cannot explain less weight (Huber), and list them.
    clock
        The clock over which rates are integrated: "sensor", or "host" (the computer's). Without it that of the spec,
        or else the computer's where the log has both.
    read_every
        Spacing of the readings while the table stands.
    neighbours
        Also without a structure: moves of one rate within, say, "5 K" taken together, beside the map's values.
    temperature
        The temperature of a log without a thermometer, such as "23 degC".
    gravity
        The gravity at the place, such as "9.80665 m/s^2": calibrate three accelerometers and three gyros by it alone,
        without table and spec. The unit lay still in some twenty positions in all directions, and was turned by hand
        between them; readings may be raw counts.
    parameters
        Write the bias over temperature here too, as parameters of the flight controller (PX4, ArduPilot) whose log this
        is.
    points
        The point map of a table of points (gradcal-points/1), in the place of a log: its columns of temperature, rate
        of the table, output and standard deviation; see gradcal new point-map.
    plot
        Draw the fit into this file (.png, .svg, .pdf).
    """
    from gradcal_jax.files.unit_spec import UnitSpec

    in_use: dict[str, object] = {"--spec": spec, "--recipe": recipe, "--axis": axis, "--table-axis": table_axis}
    in_use |= {"--earth-rate": earth_rate, "--latitude": latitude, "--smoothness": smoothness != "spec"}
    in_use |= {"--robust": robust, "--lag": lag != "none", "--read-every": read_every != "1 s"}
    in_use |= {"--neighbours": neighbours, "--parameters": parameters, "--points": points, "a second log": more}
    if gravity is not None:
        _refuse(in_use, ("--latitude",), "not for a unit that was turned by hand (--gravity)")
    options = _options(earth_rate, latitude, lag, smoothness, clock, read_every, neighbours, temperature)
    if gravity is not None:
        g = quantity(gravity, "acceleration", "--gravity")
        recorded = load(log, source)
        files = _files(output, unit or recorded.units, force)
        drawable(plot)
        from gradcal_jax.api.estimate_options import Options
        from gradcal_jax.api.hand_estimate import estimate_by_hand, hand_estimate_rows
        from gradcal_jax.cli.unit_estimate import say_units, text_of_held

        reports = estimate_by_hand(recorded, g, units=unit, options=Options(**options), sources={"log": log.name})
        status = say_units(reports, [described(recorded, str(log))], text_of_held, hand_estimate_rows, files, json=json)
        save_figure(lambda plots: plots.unit_calibration.draw_by_hand(reports[0]), plot, quiet=json)
        return status
    model = None if spec is None and recipe is None else _spec(spec, recipe)
    if isinstance(model, UnitSpec):
        taken = ("--spec", "--recipe", "--robust", "--lag", "--read-every", "a second log")
        taken = (*taken, "--earth-rate", "--latitude", "--table-axis")
        _refuse(in_use, taken, "for one gyro axis alone, and the spec is of a whole unit")
        paths = (log, *more)
        logs = [load(path, source) for path in paths]
        files = _files(output, unit or logs[0].units, force)
        drawable(plot)
        use_float64()
        from gradcal_jax.api.estimate_options import Options
        from gradcal_jax.api.unit_estimate import estimate_units, unit_estimate_rows
        from gradcal_jax.cli.unit_estimate import say_units, text_of_estimate

        sources = {"log": ", ".join(path.name for path in paths), "spec": (spec or recipe or Path()).name}
        reports = estimate_units(
            model, logs, units=unit, options=Options(**options, table_axis=table_axis, robust=robust), sources=sources
        )
        descriptions = [described(one, str(path)) for one, path in zip(logs, paths, strict=True)]
        status = say_units(reports, descriptions, text_of_estimate, unit_estimate_rows, files, json=json)
        if not json:
            from gradcal_jax.api.structure_tests import discrepancies

            measured = discrepancies(model, (test for report in reports for test in report.structure))
            for row in measured:
                if row.low > 0.0:
                    print("\n".join(_discrepancy(row)))
        save_figure(lambda plots: plots.unit_calibration.draw_unit_estimate(reports[0]), plot, quiet=json)
        return status
    if more:
        raise ValueError("several logs are for a whole unit in several mountings; give one log")
    table_of_points = None
    if points is not None:
        from gradcal_jax.files.points import read_points

        if model is None or source != WHOLE or axis or unit or temperature is not None:
            raise ValueError("--points needs the spec (--spec), and no option that chooses a part of a log")
        table_of_points = read_points(log, points)
        logs, names = [], [table_of_points.unit]
    elif model is None:
        logs = load_all(log, source)
        if any(one.table_axes for one in logs) or temperature is not None:
            raise ValueError("give the spec with --spec, or the recipe that was run with --recipe: one of them")
        recorded = logs[0]
        names = unit or [name for one in logs for name in one.units]
    else:
        recorded = load(log, source, unit=unit[0] if unit else None)
        logs, names = [recorded], unit or recorded.units
    firmware = logs[0].provenance.get("firmware") if logs else None
    if parameters is not None:
        if firmware is None:
            raise ValueError(
                "--parameters is for logs of PX4 (.ulg) and ArduPilot (.bin): see gradcal export for others"
            )
        writable(parameters, force)
    files = _files(output, names, force)
    drawable(plot)
    use_float64()
    from gradcal_jax.api import calibration as work
    from gradcal_jax.api.estimate_options import Options
    from gradcal_jax.api.warm_up import estimate_warm_up
    from gradcal_jax.files.calibration import write_calibration

    sources = {"log": log.name, "spec": (spec or recipe or Path()).name}
    chosen = Options(**options, table_axis=table_axis, robust=robust)
    if table_of_points is not None:
        assert model is not None
        report = work.estimate_points(model, table_of_points, options=chosen, sources=sources)
    elif model is None:
        report = estimate_warm_up(logs, axes=axis, units=unit, options=chosen, sources=sources)
    else:
        report = work.estimate_calibration(model, logs[0], axes=axis, units=unit, options=chosen, sources=sources)
    if json:
        print(as_json(work.estimate_rows(report)))
    else:
        print("\n".join(described(one, str(log)) for one in logs) or f"{log}: a table of points")
        print(_text(report))
    for name, path in files.items():
        write_calibration(next(c for c in report.calibrations if c.serial_number == name), path)
        if not json:
            print(f"wrote {path}")
    if parameters is not None and firmware is not None:
        from gradcal_jax.files.calibration.exports import export_sensors
        from gradcal_jax.files.writing import write_whole

        done = export_sensors(report.calibrations, firmware)
        write_whole(parameters, done.text)
        if not json:
            print(f"{export_text(done)}\nwrote {parameters}")
    save_figure(lambda plots: plots.calibration.draw_estimate(report), plot, quiet=json)
    return DONE if report.as_wished else NOT_AS_WISHED


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
    read_every: str,
    neighbours: str | None,
    temperature: str | None,
) -> dict[str, Any]:
    """The options' texts as fields of `api.estimate_options.Options`, in SI. Raises `ValueError` with the option's
    name."""
    earth = None
    if earth_rate is not None and latitude is not None:
        raise ValueError("--earth-rate and --latitude both give the Earth rate: use one of them")
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
    every = quantity(read_every, "time", "--read-every")
    if every <= 0.0:
        raise ValueError(f"--read-every {read_every!r}: must be longer than 0 s")
    width = None if neighbours is None else quantity(neighbours, "temperature difference", "--neighbours")
    if width is not None and width <= 0.0:
        raise ValueError(f"--neighbours {neighbours!r}: must be more than 0 K")
    options = {"earth_rate": earth, "lag": lag_s, "smoothness": smoothness, "clock": clock}
    at = None if temperature is None else quantity(temperature, "temperature", "--temperature")
    return options | {"read_every": every, "neighbours_k": width, "temperature_c": at}


def _spec(spec: Path | None, recipe: Path | None) -> "Spec | UnitSpec":
    if (spec is None) == (recipe is None):
        raise ValueError("give the spec with --spec, or the recipe that was run with --recipe: one of them")
    from gradcal_jax.files.recipe import any_spec_in, read_recipe

    if spec is not None:
        return any_spec_in(spec)
    assert recipe is not None
    return read_recipe(recipe).spec


def _files(output: Path | None, units: Sequence[str], force: bool) -> dict[str, Path]:
    """The output file of each unit, checked to be writable; those of several units have their names added."""
    if output is None:
        return {}
    files = {units[0]: output}
    if len(units) != 1:
        safe = {name: "".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in units}
        files = {name: output.with_name(f"{output.stem}-{plain}{output.suffix}") for name, plain in safe.items()}
    for path in files.values():
        writable(path, force)
    return files


def _text(report: "EstimateReport") -> str:
    from gradcal_jax.cli.unit_estimate import requirement_lines

    lines: list[str] = []
    for one in report.calibrations:
        lines += ["", strong(f"unit {one.serial_number}" + (", SIMULATED" if one.simulated else ""))]
        for channel in report.channels:
            if channel.unit == one.serial_number:
                lines += [_channel(channel, report.unseen_of(channel))]
        rows = report.verdicts[one.serial_number]
        lines += requirement_lines(rows) if rows else []
        lines += [f"note: {message}" for message in report.messages[one.serial_number]]
    lines += [line for row in report.discrepancies for line in _discrepancy(row)]
    return "\n".join(lines)


def _discrepancy(row: "MeasuredDiscrepancy") -> list[str]:
    """The size of the measured discrepancy, and its table for a spec."""
    several = f", {row.units} units together" if row.units > 1 else ""
    high = "∞" if row.high is None else f"{row.high:.3g}"
    heading = (
        f"discrepancy of the {row.quantity.replace('_', ' ')}, axis {row.axis}{several}: {row.standard_deviation:.3g} "
        f"{row.unit} (95 % interval {row.low:.3g} … {high})"
    )
    return ["", heading, *([f"  {line}" for line in row.block.splitlines()] if row.low > 0.0 else [])]


def _channel(channel: "UnitChannel", unseen: "Sequence[UnseenError]") -> str:
    import numpy as np

    from gradcal_jax.pages.estimated_channel import estimated_coefficients, tests_of_channel

    rows, right = estimated_coefficients(channel, unseen)
    tests = channel.consistency
    low, high = channel.valid_temperature_c
    slow, fast = (float(np.degrees(r)) for r in channel.valid_rate_rad_per_s)
    used = ", ".join(f"{count} {reason}" for reason, count in channel.counts.items())
    lines = [
        f"axis {channel.axis}: {len(channel.weights)} readings; rows: {used}",
        f"covers {low:.4g} … {high:.4g} °C, {slow:.4g} … {fast:.4g} deg/s",
        table(rows, right=right),
    ]
    if channel.lag_std_s is not None:
        lines.append(f"the maps follow the temperature {channel.lag_s:.4g} s late (1σ {channel.lag_std_s:.2g} s)")
    if channel.smoothness is not None:
        parts = []
        if channel.smoothness.bias is not None:
            parts.append(f"bias {np.degrees(channel.smoothness.bias) * 3600:.3g} deg/h")
        if channel.smoothness.scale_factor is not None:
            parts.append(f"scale factor {channel.smoothness.scale_factor * 1e6:.3g} ppm")
        lines.append("smoothness (1σ of neighbours' differences): " + ", ".join(parts))
    lines += [
        table(tests_of_channel(channel), right=(1, 2, 3)),
        f"  residuals are {tests.noise_scale:.3f} times what the spec says; {tests.beyond_three:.2%} beyond 3σ, the "
        f"largest {tests.largest:.1f}σ",
    ]
    if channel.neighbours:
        shown = [("temperature", "mean rate", "moves", "without a map", "1σ", "the map", "unit")]
        for g in channel.neighbours:
            where = (f"{g.temperature_c:.1f} °C", f"{np.degrees(g.rate_rad_per_s):.4g} deg/s", str(g.moves))
            error = "" if g.standard_error is None else f"{g.standard_error * 1e6:.3g}"
            shown.append((*where, f"{g.scale_factor * 1e6:.5g}", error, f"{g.of_map * 1e6:.5g}", "ppm"))
        lines.append(table(shown, right=(1, 2, 3, 4, 5)))
    return "\n".join(lines)
