"""How a calibration is applied: an example for one reading, and the losses of exports to other programs."""

from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.files.calibration import Calibration
from gradcal_jax.files.calibration.correction import correct
from gradcal_jax.files.calibration.exports import FORMATS, export
from gradcal_jax.units import DEG_PER_S

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
    """The correction of one reading of a channel, in `unit`."""

    channel: str
    temperature_c: float
    measured: float
    corrected: float
    unit: str


class ExportFact(NamedTuple):
    """The export to another program: command and losses."""

    target: str
    command: str
    losses: tuple[str, ...]


def examples_of(calibration: Calibration) -> list[ExampleFact]:
    """A reading of all channels at once: a third of the largest rate and half of gravity, at room temperature where
    that is covered."""
    at, readings = _room(calibration), dict[str, float]()
    for channel in calibration.channel:
        fastest = max(abs(float(end)) for end in channel.valid_rate) * DEG_PER_S
        readings[channel.input] = float(f"{fastest / 3.0:.1g}") / DEG_PER_S if channel.kind == "gyro" else 5.0
    done = correct(calibration.channel, {name: np.array([v]) for name, v in readings.items()}, np.array([at]))
    facts: list[ExampleFact] = []
    for channel in calibration.channel:
        unit, factor = ("deg/s", DEG_PER_S) if channel.kind == "gyro" else ("m/s²", 1.0)
        true = float(done[channel.input][0])
        facts.append(ExampleFact(channel.label, at, readings[channel.input] * factor, true * factor, unit))
    return facts


def exports_of(calibration: Calibration, name: str) -> list[ExportFact]:
    """Every export with its command and losses; those of one temperature at room temperature, where it is covered."""
    at = _room(calibration)
    facts: list[ExportFact] = []
    for target in (one for one in FORMATS if one != "template"):
        option = f' --temperature "{at:g} degC"' if target in _AT_ONE_TEMPERATURE else ""
        command = f"gradcal export {name} --format {target}{option} -o calibration.{_ENDINGS[target]}"
        try:
            done = export(calibration, target, temperature_c=at if option else None)
        except ValueError as error:
            facts.append(ExportFact(target, "", (f"not for this calibration: {error}",)))
            continue
        losses = tuple(f"{x.channel}: {x.what}, up to {x.value:.4g} {x.unit}" for x in done.losses if x.value > 0.0)
        facts.append(ExportFact(target, command, losses))
    return facts


def _room(calibration: Calibration) -> float:
    cold, warm = (float(end) for end in calibration.valid_temperature)
    return 25.0 if cold <= 25.0 <= warm else 0.5 * (cold + warm)
