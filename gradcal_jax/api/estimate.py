"""A log and a spec -> increments -> the estimation room -> calibrations, with what the fit says of itself.

The spec says what the sensor's noise, the table's readings and the maps are; what was done is read from the log.
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
    """Every asked axis of every asked unit (all, without them), by the spec's model.

    **Raises:** `LogError` and `ValueError` with a sentence where the log does not hold what the estimate needs.
    """
    options = options or Options()
    built = assemble(of_host_clock(spec, [log], options))
    wanted_axes = [log.axes[log.axis_index(a)] for a in axes] or _common_axes(built, log)
    if options.earth_rate and len(wanted_axes) > 1:
        raise ValueError(
            "the Earth's rate along each of several axes is another, and changes as others turn: estimate one at a "
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
    """All units of one axis. Those whose samples may be integrated over the same rows share one whitening."""
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
