"""How a calibration is applied: an example for one reading, and the losses of exports to other programs."""

from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.api.posterior_of_plan import PPM
from gradcal_jax.files import correction, exports
from gradcal_jax.files.calibration import AxisCalibration, Calibration
from gradcal_jax.files.unit_calibration import UnitCalibration
from gradcal_jax.files.unit_exports import UNIT_FORMATS, export_unit

_ENDINGS: Final = {
    "ardupilot": "parm",
    "px4": "params",
    "kalibr": "yaml",
    "matrices": "yaml",
    "c-header": "h",
    "csv": "csv",
}
_AT_ONE_TEMPERATURE: Final = ("kalibr", "matrices")


class ExampleFact(NamedTuple):
    """The correction of one reading; rates in deg/s."""

    axis: str
    temperature_c: float
    measured_dps: float
    bias_dps: float
    scale_factor_ppm: float
    corrected_dps: float


class ExportFact(NamedTuple):
    """The export to another program: command and losses."""

    target: str
    command: str
    losses: tuple[str, ...]


def example_of(axis: AxisCalibration) -> ExampleFact:
    """A reading at a third of the largest rate, at room temperature where that is covered."""
    at = _room(axis)
    measured_dps = float(f"{np.degrees(max(abs(float(end)) for end in axis.valid_rate)) / 3.0:.1g}")
    temperature, measured = np.array([at]), np.array([np.radians(measured_dps)])
    true = correction.correct(axis, measured, temperature)
    return ExampleFact(
        axis.name,
        at,
        measured_dps,
        float(np.degrees(correction.bias(axis, temperature)[0])),
        float(correction.scale_factor(axis, temperature, true)[0]) * PPM,
        float(np.degrees(true[0])),
    )


def exports_of(calibration: Calibration | UnitCalibration, name: str) -> list[ExportFact]:
    """Every export with its command and losses; those of one temperature at room temperature, where it is covered."""
    of_unit = isinstance(calibration, UnitCalibration)
    at = _room(calibration if of_unit else calibration.axis[0])
    facts: list[ExportFact] = []
    for target in UNIT_FORMATS if of_unit else exports.FORMATS:
        option = f' --temperature "{at:g} degC"' if target in _AT_ONE_TEMPERATURE else ""
        command = f"gradcal export {name} --format {target}{option} -o calibration.{_ENDINGS[target]}"
        temperature = at if option else None
        try:
            if of_unit:
                done = export_unit(calibration, target, temperature_c=temperature)
            else:
                done = exports.export(calibration, target, temperature_c=temperature)
        except ValueError as error:
            facts.append(ExportFact(target, "", (f"not for this calibration: {error}",)))
            continue
        axis = "" if of_unit else "axis "
        losses = tuple(f"{axis}{x.axis}: {x.what}, up to {x.value:.4g} {x.unit}" for x in done.losses if x.value > 0.0)
        facts.append(ExportFact(target, command, losses))
    return facts


def _room(covered: AxisCalibration | UnitCalibration) -> float:
    cold, warm = (float(end) for end in covered.valid_temperature)
    return 25.0 if cold <= 25.0 <= warm else 0.5 * (cold + warm)
