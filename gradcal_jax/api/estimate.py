"""From a log and a spec to the estimate of every channel, with tests of the fit.

The spec describes the sensor's noise, the table's readings and the maps; the executed motion is read from the log.
"""

from collections.abc import Sequence

import numpy as np

from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.gradient_estimate import gradient_channels
from gradcal_jax.api.log_rows import of_host_clock, rows_of
from gradcal_jax.api.standard_estimate import standard_channel
from gradcal_jax.api.unit_channel import UnitChannel
from gradcal_jax.files import Spec
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.schedule import StandardSchedule


def estimate_channels(
    spec: Spec, log: Log, *, axes: Sequence[str] = (), units: Sequence[str] = (), options: Options | None = None
) -> list[UnitChannel]:
    """The estimate of every axis in `axes` of every unit in `units` (default: all), by the spec's model.

    **Raises:** `LogError` and `ValueError` with a sentence where the log does not hold what the estimate needs.
    """
    options = options or Options()
    built = assemble(of_host_clock(spec, [log], options))
    wanted_axes = [log.axes[log.axis_index(a)] for a in axes] or _common_axes(built, log)
    if options.earth_rate and len(wanted_axes) > 1:
        raise ValueError(
            "the Earth's rate differs between axes, and changes while other axes turn: estimate one axis at a "
            "time with --axis, or describe the table in a whole unit's spec (gradcal new two-axis-table), which has it"
        )
    wanted_units = [log.unit_index(u) for u in units] or list(range(len(log.units)))
    result: list[UnitChannel] = []
    for axis in wanted_axes:
        result += _channel(built, log, axis, wanted_units, options)
    return result


def _common_axes(built: Assembled, log: Log) -> list[str]:
    common = [axis for axis in log.axes if axis in built.channels]
    if common:
        return common
    if len(log.axes) == 1:
        return list(log.axes)
    raise LogError(
        f"the spec calibrates axis {', '.join(built.channels)} and the log has {', '.join(log.axes)}: say which with "
        "--axis"
    )


def _channel(built: Assembled, log: Log, axis: str, units: list[int], options: Options) -> list[UnitChannel]:
    """All units of one axis. Units whose samples are integrated over the same rows share one whitening."""
    rows = {unit: rows_of(built, log, axis, unit, options) for unit in units}
    if isinstance(built.spec.schedule, StandardSchedule):
        return [standard_channel(built, log, axis, unit, rows[unit], options) for unit in units]
    groups: dict[bytes, list[int]] = {}
    for unit in units:
        one = rows[unit]
        groups.setdefault(np.packbits(one.usable).tobytes() + np.packbits(one.standing).tobytes(), []).append(unit)
    result: dict[int, UnitChannel] = {}
    for members in groups.values():
        result.update(gradient_channels(built, log, axis, members, rows, options))
    return [result[unit] for unit in units]
