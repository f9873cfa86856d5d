"""`gradcal noise`: a sensor's noise from a record at rest, by its Allan deviation and by the Direct Bound."""

from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gradcal_jax.cli.output import JsonNumbers, Plot, drawable, show, strong
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.recordings import (
    ColumnMapOption,
    LogFile,
    RowsOption,
    UnitOption,
    load,
    quantity,
    span,
    text_of_log,
)

if TYPE_CHECKING:
    from gradcal_jax.identify import AllanFit
    from gradcal_jax.identify.instability import Instability
    from gradcal_jax.records.log import Log

Axes = Annotated[
    tuple[str, ...], Parameter(name="--axis", negative="", help="Which axis; may be repeated; by default all.")
]


def noise(
    log: LogFile,
    /,
    *,
    axis: Axes = (),
    unit: UnitOption = None,
    without: Annotated[tuple[str, ...], Parameter(negative="")] = (),
    columns: ColumnMapOption = None,
    rows: RowsOption = None,
    sensor_rate: str | None = None,
    json: JsonNumbers = False,
    plot: Plot = None,
) -> int:
    """Print the noise of a record at rest: the coefficients of the Allan deviation, and a Gauss-Markov process that
    bounds the drift (the Direct Bound of Z. Berman), as a part of a spec.

    The bias over temperature (a cubic, with a lag if that fits better) is subtracted first, if the temperature changes
    by 5 K or more. The exit status is 1 if the record shows no drift in addition to the angle random walk, or if the
    angle random walk is larger than that of any gyro: check the units.

    Parameters
    ----------
    without
        A time span of the record to leave out, such as "123 s..130 s"; may be repeated.
    sensor_rate
        If each row is a single sample, but not every sample has a row: the sample rate of the sensor, such as "400 Hz".
        If each row is the mean of several samples: "means".
    plot
        Draw the Allan deviation, its fit and the curve of the Direct Bound into this file (.png, .svg, .pdf).
    """
    drawable(plot)
    left_out = [span(text, "--without") for text in without]
    recorded = load(log, columns, rows, unit=unit)
    if sensor_rate is not None:
        recorded = _at_rate(recorded, sensor_rate)
    use_float64()
    from gradcal_jax.identify import instability as work

    of_unit = 0 if unit is None else unit
    done = []
    for name in axis or recorded.axes:
        rest = work.at_rest(recorded, name, of_unit, without=left_out)
        rest.walk_of_sensor(0.0)  # asks before anything is printed
        done.append((rest, *work.allan_of(rest), work.instability(rest)))
    lines, channels, wished = [text_of_log(recorded, str(log))], [], True
    for rest, deviation, fit, bound in done:
        lines += ["", _text(bound, fit)]
        channels.append({**work.instability_row(bound), "allan": work.allan_row(rest, deviation, fit)})
        wished &= bound.bound.drift_shows and work.plausible(work.of_sensor(rest, fit))
    if plot is not None:
        from gradcal_jax.plots import draw_noise, save

        save(draw_noise(done), plot)
        lines.append(f"wrote {plot}")
    record = {"simulated": recorded.simulated, "channels": channels}
    return show("\n".join(lines), record, json=json, wished=wished)


def _at_rate(log: "Log", rate: str) -> "Log":
    """The log with the stated rate of the sensor."""
    from dataclasses import replace

    from gradcal_jax.records.log import SENSOR_RATE

    if rate != "means" and not quantity(rate, "frequency", "--sensor-rate") > 0.0:
        raise ValueError(f"--sensor-rate {rate!r}: must be positive")
    return replace(log, provenance={**log.provenance, SENSOR_RATE: rate})


def _text(result: "Instability", of_rows: "AllanFit") -> str:
    """The noise of one axis."""
    from gradcal_jax.identify import instability as work
    from gradcal_jax.tables.table import Column, Table
    from gradcal_jax.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H

    bound, rest = result.bound, result.rest
    fit = work.of_sensor(rest, of_rows)
    coefficients = (
        ("Q quantisation", fit.quantisation, ARCSEC, "arcsec"),
        ("N angle random walk", fit.angle_random_walk, DEG_PER_SQRT_H, "deg/sqrt(h)"),
        ("B bias instability", fit.bias_instability, DEG_PER_H, "deg/h"),
        ("K rate random walk", fit.rate_random_walk, DEG_PER_H * 60.0, "deg/h/sqrt(h)"),
    )
    rows = [
        (name, of.value * factor, of.standard_error * factor, unit, "" if of.shows else "not significant")
        for name, of, factor, unit in coefficients
    ]
    heads = ["coefficient", "value", Column("standard error", "", 2), "unit", "remark"]
    lines = [strong(f"axis {rest.axis}, IMU {rest.unit}"), Table.of(heads, rows).text()]
    if bound.drift_shows:
        lines.append(
            f"the drift is bounded by {bound.drift_std * DEG_PER_H:.4g} deg/h with a correlation time of "
            f"{bound.correlation_time_s:.4g} s, at {bound.margin:g} sigma"
        )
        first, last = result.deciding_span_s
        lines.append(
            f"the record from {first:.6g} s to {last:.6g} s determines the bound; to leave this part out: "
            f'--without "{first:.6g} s..{last:.6g} s"'
        )
    messages = (*rest.messages, *work.allan_notes(fit), *bound.messages)
    return "\n".join([*lines, *(f"note: {message}" for message in messages), "", result.drift_block()])
