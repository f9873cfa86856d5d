"""From a log and a spec to the estimate of every channel, with tests of the fit.

The spec describes the sensor's noise, the table's readings and the maps; the executed motion is read from the log.
"""

from collections.abc import Sequence

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.api.build import Assembled, assemble
from gradcal_jax.api.estimate_options import Options
from gradcal_jax.api.fitted_lag import fitted_lag
from gradcal_jax.api.log_rows import Rows, count_rows, rows_of, temperature_followed, with_options
from gradcal_jax.api.standard_estimate import standard_channel
from gradcal_jax.api.tested_maps import hidden_maps
from gradcal_jax.api.unit_channel import Recorded, UnitChannel, finished_channel, integrated_rows
from gradcal_jax.estimation import Estimate, Observations, Whitened
from gradcal_jax.files import Spec
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.information import noise_steps, since_origin
from gradcal_jax.model import Discrepancy, SensorModel

_ROUNDS = 8
# A change of the parameters, in standard deviations, that no longer matters.
_SETTLED = 1e-3
_CORRELATION_TIMES_A_PIECE = 3.0


def estimate_channels(
    spec: Spec, log: Log, *, axes: Sequence[str] = (), units: Sequence[str] = (), options: Options | None = None
) -> list[UnitChannel]:
    """The estimate of every axis in `axes` of every unit in `units` (default: all), by the spec's model.

    **Raises:** `LogError` and `ValueError` with a sentence where the log does not hold what the estimate needs.
    """
    spec, options, _ = with_options(spec, [log], options or Options())
    built = assemble(spec)
    wanted_axes = [log.axes[log.axis_index(a)] for a in axes] or common_axes(built, log)
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


def common_axes(built: Assembled, log: Log) -> list[str]:
    """The axes that spec and log have in common; the log's only one. Raises `LogError`."""
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
        groups.setdefault(
            b"".join(np.packbits(x).tobytes() for x in (one.usable, one.standing, one.reading)), []
        ).append(unit)
    result: dict[int, UnitChannel] = {}
    for members in groups.values():
        result.update(_gradient_channels(built, log, axis, members, rows, options))
    return [result[unit] for unit in units]


def _gradient_channels(
    built: Assembled, log: Log, axis: str, members: list[int], rows: dict[int, Rows], options: Options
) -> dict[int, UnitChannel]:
    """The units `members` by the gradient method, with one whitening of the rows that they share: the executed motion
    is read from the log; maps and true rates are estimated in turn."""
    first = rows[members[0]]
    model = built.model
    still = first.standing & first.usable
    rest_bias = float(np.mean(first.rate[still])) if still.any() else 0.0
    done = estimation.executed(
        first.time,
        first.temperature,
        first.rate - rest_bias,
        first.angle,
        first.standing,
        first.usable,
        first.reading,
        longest_piece=_longest_piece(model),
        readings_in_row=first.readings_in_row,
    )
    messages = list(first.messages)
    if first.angle is None:
        messages.append(
            "the log has no table angle: only rates at rest are used, and the scale factor is not observable"
        )
    line = done.line
    steps = noise_steps(line, model)
    of_unit = lambda one: estimation.integrated_error(  # noqa: E731
        one.rate, one.step, one.angle, done.rows, done.broken, line.gap, options.earth_rate or 0.0
    )
    readings = np.stack([of_unit(rows[u]) for u in members], axis=1)
    moving = line.moving
    # Mean temperature, rate and time of each piece, for reports.
    ends, mean_rate = first.temperature[done.rows], line.terms[:, 0]
    temperature = 0.5 * (ends[1:] + ends[:-1])
    time = first.time[done.rows[1:]]
    turning = estimation.within(done.rows, moving & ~done.broken, len(first.time))

    def observe(lag: float, parameters: np.ndarray | None, term: SensorModel | Discrepancy = model) -> Observations:
        columns = []
        for k, unit in enumerate(members):
            one = rows[unit]
            temperature_of_maps = temperature_followed(one, lag)
            rates = one.rate - (rest_bias if parameters is None else options.earth_rate or 0.0)
            if parameters is not None:
                rates[turning] = estimation.true_rate(
                    model, parameters[k], rates[turning], temperature_of_maps[turning]
                )
            turned = line.turned() if one.angle is None else np.diff(one.angle[done.rows])
            noise = float(model.angle_random_walk) / np.sqrt(float(np.median(one.step[1:])))
            nodes = estimation.sample_nodes(
                rates, temperature_of_maps, one.step, done.rows, moving, done.broken, turned, rate_noise=noise
            )
            columns.append(since_origin(term.columns(nodes), line.gap))
        return Observations(steps, np.stack(columns), readings, time, temperature, mean_rate)

    def settle(lag: float, parameters: np.ndarray | None = None) -> tuple[Observations, Whitened, Estimate, float]:
        """Alternate maps and regressors until they converge; also the maps' last change in standard deviations."""
        moved = np.inf
        for _ in range(_ROUNDS):
            observations = observe(lag, parameters)
            white = estimation.whitened(observations, model)
            estimate = estimation.solve(white)
            if model.scale is None or not moving.any():
                moved = 0.0
            elif parameters is not None:
                moved = _moved(estimate, parameters, model)
            if moved < _SETTLED:
                break
            parameters = estimate.parameters
        return observations, white, estimate, moved  # pyright: ignore[reportPossiblyUnboundVariable]

    last: list[np.ndarray | None] = [None]

    def chi_squared(lag: float) -> float:
        """Of all units together."""
        minimum = settle(lag, last[0])[2]
        last[0] = minimum.parameters
        return float(minimum.chi_squared.sum())

    lag, lag_std = fitted_lag(chi_squared) if options.lag == "fit" else (float(options.lag), None)
    observations, white, settled, moved = settle(lag)
    if moved >= _SETTLED:
        messages.append(
            "the maps have not converged: between iterations, each at the rates corrected by the one before, they "
            f"change by {moved:.2g} standard deviations; the maps are too flexible, or the noise figures too small"
        )
    hidden = [
        (term, level, estimation.whitened_columns(observe(lag, settled.parameters, term)))
        for term, level in hidden_maps(built.spec, model)
    ]
    used = integrated_rows(done, len(log.time_s))
    result: dict[int, UnitChannel] = {}
    for k, unit in enumerate(members):
        own = observations._replace(columns=observations.columns_of(k), readings=observations.readings[:, k : k + 1])
        single = white.of_unit(k)
        beyond = [(term, level, columns[k]) for term, level, columns in hidden]
        recorded = Recorded(axis, log.units[unit], rows[unit], done, count_rows(log, unit, used), messages)
        result[unit] = finished_channel(recorded, model, own, single, options, (lag, lag_std), beyond)
    return result


def _longest_piece(model: SensorModel) -> float:
    """A few correlation times of the noise that the rate drives, s."""
    driven = (model.processes.rate_gain != 0.0) & (model.processes.decay > 0.0)
    if not driven.any():
        return np.inf
    return _CORRELATION_TIMES_A_PIECE / float(np.max(model.processes.decay[driven]))


def _moved(estimate: Estimate, before: np.ndarray, model: SensorModel) -> float:
    """The largest change of any parameter since the last iteration, in its standard deviations."""
    largest = 0.0
    rows = model.to_reported
    for now, then, known in zip(estimate.parameters, before, estimate.known, strict=True):
        std = known.deviations(rows)
        change = np.abs(rows @ (now - then))
        seen = np.isfinite(std) & (std > 0.0)
        largest = max(largest, float(np.max(change[seen] / std[seen], initial=0.0)))
    return largest
