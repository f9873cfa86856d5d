"""A calibration in the terms of other programs, each evaluated in the target's own arithmetic.

    ardupilot, px4   parameters of flight controllers (`flight_controllers`)
    c-header         a float32 function of the whole calibration; polynomial bases only (`c_header`)
    kalibr, matrices, csv, gains, tracker, ins
                     shipped templates, `templates/export-*.j2`: matrices at one temperature, or every coefficient
    template         a Jinja template of the user's, filled with maps, matrices and noise

Each export reports in numbers what its target cannot carry (see `losses`).
"""

from functools import partial
from typing import Any, Final

import numpy as np

from gradcal_jax.calibration.c_header import c_header
from gradcal_jax.calibration.equation import SIGNALS, linear_part
from gradcal_jax.calibration.file import Calibration
from gradcal_jax.calibration.flight_controllers import ardupilot, px4
from gradcal_jax.calibration.losses import Export, losses_of
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.tables.text_template import rendered

_AT_ONE_TEMPERATURE: Final = ("kalibr", "matrices", "gains", "tracker", "ins")
FORMATS: Final = ("ardupilot", "px4", "c-header", *_AT_ONE_TEMPERATURE, "csv", "template")


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
    match target:
        case "ardupilot":
            done = ardupilot(_in_triad(calibration), instance)
        case "px4":
            done = px4(_in_triad(calibration), instance, device_id)
        case "c-header":
            done = c_header(calibration)
        case "csv":
            done = Export(rendered(presets.template("export-csv.j2"), _values(calibration)), (), ())
        case "template":
            done = _template(calibration, template, temperature_c)
        case _ if target in FORMATS:
            if temperature_c is None:
                raise ValueError(f"{target} is for one temperature: state this temperature with --temperature")
            done = _template(calibration, presets.template(f"export-{target}.j2"), temperature_c)
        case _:
            raise ValueError(f'there is no export format "{target}": known are {", ".join(FORMATS)}')
    notes = list(done.notes)
    notes += [f"{one.label}, {one.value:.3g} {one.unit}: the target has no place for it" for one in calibration.path]
    if calibration.unobservable and target != "csv":
        notes.append(f"not observed by the data: {', '.join(calibration.unobservable)}")
    if calibration.simulated:
        notes.append("this calibration was made from SIMULATED data")
    return done._replace(notes=tuple(notes))


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


def _template(calibration: Calibration, template: str | None, at: float | None) -> Export:
    """A template of Jinja filled in; with the matrices at a temperature (°C), if there is one."""
    if template is None:
        raise ValueError(
            "the template is missing: name it with --template; gradcal start export-gains -o gains.j2 writes one"
        )
    if at is None:
        text = rendered(template, _values(calibration))
        return Export(text, (), ("what the template does not use is lost, and not listed",))
    calibration = _in_triad(calibration)
    low, high = calibration.valid_temperature
    if not low - 1e-9 <= at <= high + 1e-9:
        raise ValueError(f"the calibration covers {low:g} … {high:g} °C, and {at:g} °C is outside")
    matrix, bias = linear_part(calibration.channel, at, mean_over_rates=True)
    inverse = np.linalg.inv(matrix)

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        return inverse @ (raw - bias[:, None])

    text = rendered(template, _values(calibration) | linear_at(calibration, at) | {"temperature": at})
    known = {channel.label for channel in calibration.channel}
    absent = [label for kind in ("gyro", "accelerometer") for a in "xyz" if (label := f"{kind} {a}") not in known]
    notes = [f"not calibrated, so assumed to be without errors: {', '.join(absent)}"] if absent else []
    notes.append("the losses are those of matrices and biases at this temperature")
    return Export(text, losses_of(calibration, SIGNALS, corrected), tuple(notes))


def _values(calibration: Calibration) -> dict[str, Any]:
    """What a template can use at every temperature."""
    noise = dict(calibration.noise or ())
    return {
        "serial_number": calibration.serial_number,
        "simulated": calibration.simulated,
        "frame": calibration.frame,
        "order": calibration.order,
        "temperature_range": list(map(float, calibration.valid_temperature)),
        "coefficients": calibration.values(),
        "rows": _rows(calibration),
        "noise": {name: float(value) for name, value in noise.items() if value is not None},
        "at": partial(linear_at, calibration),
    }


def _rows(calibration: Calibration) -> list[dict[str, Any]]:
    """A row for each coefficient: its term, value, standard deviation and bases."""
    std = calibration.deviations()
    rows: list[dict[str, Any]] = []
    for channel in calibration.channel:
        for term in channel.term:
            lag = 0.0 if term.temperature is None else float(channel.thermal_lag or 0.0)
            row: dict[str, Any] = {
                "channel": channel.name,
                "term": term.name,
                "signals": " * ".join(term.signals),
                "unit": term.unit,
                "lag_s": lag,
            }
            for key in ("temperature", "rate"):
                keys: dict[str, Any] = term.model_dump(mode="json")[key] or {}
                row[f"{key}_basis"] = "; ".join(f"{k}={v}" for k, v in keys.items())
            for name, value in term.coefficients.items():
                rows.append(row | {"name": name, "value": value, "std": std.get(f"{channel.name}.{name}", "")})
    return rows
