"""A calibration in the terms of other programs, each evaluated in the target's own arithmetic.

    ardupilot, px4   parameters of flight controllers (`flight_controllers`)
    c-header         a float32 function of the whole calibration; polynomial bases only (`c_header`)
    kalibr, matrices, csv, gains, tracker, ins
                     shipped templates, `templates/export-*.j2`: matrices at one temperature, or every coefficient
    template         a Jinja template of the user's, filled with maps, matrices and noise

Each export reports in numbers what its target cannot carry (see `losses`).
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from gradcal_jax.calibration.c_header import c_header
from gradcal_jax.calibration.correction import linear_part
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.calibration.flight_controllers import ardupilot, px4
from gradcal_jax.calibration.losses import ExportOptions, Loss, Target, losses_of
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.tables.display import summary


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
    template: str | None = None,
) -> Export:
    """The calibration for a target of `FORMATS`.

    `temperature_c`: for targets of one temperature; `instance`: number of the sensor on the controller (from 1 for
    ArduPilot, from 0 for PX4); `device_id`: PX4's; `template`: the text of one. Returns the text, and every loss with
    its largest value and unit. Errors: `ValueError` with a sentence for what cannot be exported.
    """
    if target not in FORMATS:
        raise ValueError(f'there is no export format "{target}": known are {", ".join(FORMATS)}')
    whole = target in ("c-header", "csv") or (target == "template" and temperature_c is None)
    named = calibration if whole else _in_triad(calibration)
    done = FORMATS[target](named, ExportOptions(temperature_c, instance, device_id, template))
    losses = [] if done.corrected is None else losses_of(named, done.inputs, done.corrected)
    path = [f"{one.label}, {one.value:.3g} {one.unit}: the target has no place for it" for one in calibration.path]
    notes = [*done.notes, *path]
    if calibration.unobservable and target != "csv":
        notes.append(f"not observed by the data: {', '.join(calibration.unobservable)}")
    if calibration.simulated:
        notes.append("this calibration was made from SIMULATED data")
    return Export(done.text, tuple(losses), tuple(notes))


def _in_triad(calibration: Calibration) -> Calibration:
    """The channels along x, y, z. Raises `ValueError` where there is none."""
    channels = tuple(channel for channel in calibration.channel if channel.axis in "xyz")
    if not channels:
        names = ", ".join(channel.axis for channel in calibration.channel)
        raise ValueError(f"the target has axes x, y, z, and the calibration has {names}: none of them fits")
    return calibration.model_copy(update={"channel": channels})


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
    named = {
        "gyro": {"matrix": gyro, "inverse": np.linalg.inv(gyro), "bias": bias[:3]},
        "accelerometer": {"matrix": force, "inverse": np.linalg.inv(force), "bias": bias[3:]},
        "sensitivity": {"matrix": felt},
        "kalibr": kalibr | {"frame": frame},
    }
    return {key: {name: value.tolist() for name, value in of.items()} for key, of in named.items()}


def _triangular(matrix: Floats) -> tuple[Floats, Floats]:
    """`L Q = matrix`, L lower triangular with a positive diagonal, Q a rotation."""
    q, r = np.linalg.qr(matrix.T)
    signs = np.sign(np.diag(r))
    return (r * signs[:, None]).T, (q * signs).T


def _template(calibration: Calibration, options: ExportOptions) -> Target:
    template, at = options.template, options.temperature_c
    if template is None:
        raise ValueError(
            "the template is missing: name it with --template; gradcal start export-gains -o gains.j2 writes one"
        )
    noise = dict(calibration.noise or ())
    low, high = map(float, calibration.valid_temperature)
    values: dict[str, Any] = {
        "serial_number": calibration.serial_number,
        "simulated": calibration.simulated,
        "frame": calibration.frame,
        "order": calibration.order,
        "temperature_range": [low, high],
        "coefficients": calibration.values(),
        "rows": _rows(calibration),
        "noise": {name: float(value) for name, value in noise.items() if value is not None},
        "at": partial(linear_at, calibration),
    }
    if at is None:
        return Target(rendered(template, values), None, ("what the template does not use is lost, and not listed",))
    if not low - 1e-9 <= at <= high + 1e-9:
        raise ValueError(f"the calibration covers {low:g} … {high:g} °C, and {at:g} °C is outside")
    known = {channel.label for channel in calibration.channel}
    absent = [label for kind in ("gyro", "accelerometer") for a in "xyz" if (label := f"{kind} {a}") not in known]
    notes = [f"not calibrated, so assumed to be without errors: {', '.join(absent)}"] if absent else []
    matrix, bias = linear_part(calibration.channel, at, mean_over_rates=True)
    inverse = np.linalg.inv(matrix)

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        return (raw - bias) @ inverse.T

    text = rendered(template, values | linear_at(calibration, at) | {"temperature": at})
    return Target(text, corrected, (*notes, "the losses are those of matrices and biases at this temperature"))


def _rows(calibration: Calibration) -> list[dict[str, str]]:
    """A row for each coefficient, all in text: its term, value, standard deviation and bases."""
    std = {name: repr(value) for name, value in calibration.deviations().items()}
    rows: list[dict[str, str]] = []
    for channel in calibration.channel:
        for term in channel.term:
            lag = 0.0 if term.temperature is None else float(channel.thermal_lag or 0.0)
            row = {"channel": channel.name, "term": term.name, "signals": " * ".join(term.signals), "unit": term.unit}
            for key in ("temperature", "rate"):
                keys: dict[str, Any] = term.model_dump(mode="json")[key] or {}
                row[f"{key}_basis"] = "; ".join(f"{k}={v}" for k, v in keys.items())
            for name, value in term.coefficients.items():
                own = {"name": name, "value": repr(value), "std": std.get(f"{channel.name}.{name}", "")}
                rows.append(row | own | {"lag_s": repr(lag)})
    return rows


def _shipped(name: str, calibration: Calibration, options: ExportOptions) -> Target:
    """The target of a template that comes with the program: all but csv are of one temperature."""
    options = options._replace(template=presets.template(f"export-{name}.j2"))
    if name == "csv":
        return _template(calibration, options._replace(temperature_c=None))._replace(notes=())
    if options.temperature_c is None:
        raise ValueError(f"{name} is for one temperature: state this temperature with --temperature")
    return _template(calibration, options)


FORMATS: Final[Mapping[str, Callable[[Calibration, ExportOptions], Target]]] = {
    "ardupilot": ardupilot,
    "px4": px4,
    "c-header": c_header,
    **{name: partial(_shipped, name) for name in ("kalibr", "matrices", "gains", "tracker", "ins", "csv")},
    "template": _template,
}
