"""A log and a spec -> increments -> the estimation room -> calibrations, with what the fit says of itself.

The spec says what the sensor's noise, the table's readings and the maps are; what was done is read from the log.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import optimize

from gradcal_jax import estimation as room
from gradcal_jax.assemble.build import Assembled, assemble
from gradcal_jax.errormodel import GyroModel
from gradcal_jax.estimation import Estimate, Observations, Smoothness, Whitened
from gradcal_jax.files import Spec
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.plan import StandardPlan as StandardPlanSection
from gradcal_jax.files.schedule import StandardSchedule
from gradcal_jax.identify import lagged
from gradcal_jax.information import to_reported, unweighted

_ROUNDS = 8
# A change of the parameters, in standard deviations, that no longer matters.
_SETTLED = 1e-3
_LONGEST_LAG_S = 1800.0
_CORRELATION_TIMES_A_PIECE = 3.0
# To which the ranges of a calibration are rounded, outwards.
_TEMPERATURE_STEP, _RATE_STEP = 0.1, float(np.radians(0.1))


@dataclass(frozen=True)
class Options:
    """How a log is estimated; see `estimate_channels`."""

    earth_rate: float = 0.0
    """Of the Earth, along the sensor's axis, rad/s; it is taken off."""
    robust: bool = False
    threshold: float = room.HUBER
    lag: float | Literal["fit"] = 0.0
    """Of the maps behind the measured temperature, s; "fit" finds it."""
    smoothness: Literal["spec", "auto"] = "spec"
    clock: Literal["sensor", "host"] = "sensor"
    read_every: float = 1.0
    table_axis: str | None = None
    neighbours_k: float | None = None
    """Beside the map: moves of one rate within so many kelvins taken together, without a structure."""


class UnitChannel(NamedTuple):
    """One axis of one unit, estimated. `observations`, `found` and `white` hold this unit alone."""

    axis: str
    unit: str
    model: GyroModel
    observations: Observations
    found: Estimate
    white: Whitened
    consistency: room.Consistency
    weights: np.ndarray
    """`(n,)`, of the readings used; 1: counted in full."""
    lag_s: float
    lag_std_s: float | None
    smoothness: Smoothness | None
    valid_temperature_c: tuple[float, float]
    valid_rate_rad_per_s: tuple[float, float]
    counts: dict[str, int]
    """Rows of the log by what became of them; they add up to the rows read."""
    messages: tuple[str, ...]
    neighbours: tuple[room.Group, ...] = ()


class _Rows(NamedTuple):
    """One unit's rows of one axis, ready for integration."""

    time: np.ndarray
    step: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray
    angle: np.ndarray | None
    table_rate: np.ndarray | None
    standing: np.ndarray
    usable: np.ndarray
    messages: tuple[str, ...]


def estimate_channels(
    spec: Spec, log: Log, *, axes: Sequence[str] = (), units: Sequence[str] = (), options: Options | None = None
) -> list[UnitChannel]:
    """Every asked axis of every asked unit (all, without them), by the spec's model.

    **Raises:** `LogError` and `ValueError` with a sentence where the log does not hold what the estimate needs.
    """
    options = options or Options()
    built = assemble(spec)
    wanted_axes = [log.axes[log.axis_index(a)] for a in axes] or _common_axes(built, log)
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
    rows = {unit: _rows(built, log, axis, unit, options) for unit in units}
    if isinstance(built.spec.schedule, StandardSchedule):
        return [_standard(built, log, axis, unit, rows[unit], options) for unit in units]
    groups: dict[bytes, list[int]] = {}
    for unit in units:
        one = rows[unit]
        groups.setdefault(np.packbits(one.usable).tobytes() + np.packbits(one.standing).tobytes(), []).append(unit)
    result: dict[int, UnitChannel] = {}
    for members in groups.values():
        result.update(_gradient(built, log, axis, members, rows, options))
    return [result[unit] for unit in units]


def _rows(built: Assembled, log: Log, axis: str, unit: int, options: Options) -> _Rows:
    messages: list[str] = []
    time = log.time_s
    if options.clock == "host":
        time, said = _host_time(log)
        messages.append(said)
    usable = log.usable(unit).copy()
    usable[log.stretch_starts] = False  # what lay before the row was not recorded
    raw = log.rate_rad_per_s[unit, :, log.axis_index(axis)]
    rate = np.where(np.isfinite(raw), raw, 0.0)
    usable &= np.isfinite(raw)
    temperature = room.smoothed_temperature(time, _temperature(built, log, unit))
    table = _table_axis(log, axis, options.table_axis)
    angle = None if table is None or log.table_angle_rad is None else log.table_angle_rad[:, table]
    table_rate = None if table is None or log.table_rate_rad_per_s is None else log.table_rate_rad_per_s[:, table]
    if log.standstill is not None:
        standing = log.standstill >= 0
    elif isinstance(built.spec.schedule, StandardSchedule):
        standing = np.zeros(len(time), bool)
    else:
        number = room.find_standstills(log.rate_rad_per_s[unit], log.sample_interval_s, valid=log.usable(unit))
        standing = number >= 0
        messages.append(f"the log marks no standstills: {int(number.max()) + 1} were found where the rates are quiet")
    if angle is not None:
        known = np.isfinite(angle)
        if standing.any() and not known[standing].any():
            raise LogError("the table's angle is missing wherever it stands: it is the reference")
        if not known[standing].all():
            count = int(np.count_nonzero(standing & ~known))
            messages.append(f"{count} rows of rest without a table angle are no reference, and are not read")
            standing = standing & known
        angle = angle if known.all() else np.interp(time, time[known], angle[known])
    return _Rows(
        time,
        np.diff(time, prepend=time[0]),
        rate,
        temperature,
        angle,
        table_rate,
        standing,
        usable,
        tuple(messages),
    )


def _repeats(angle: np.ndarray, standing: np.ndarray) -> bool:
    """Whether most rows at rest repeat the angle of the row before, to the last digit."""
    both = standing[1:] & standing[:-1]
    return bool(np.mean(angle[1:][both] == angle[:-1][both]) > 0.5) if both.any() else False


def _host_time(log: Log) -> tuple[np.ndarray, str]:
    """The sensor's stamps in seconds of the computer: a straight line through both."""
    if log.host_time_s is None:
        raise LogError("the log has no host time, so the sensor's clock cannot be held against it")
    sensor, host = log.time_s - log.time_s[0], log.host_time_s - log.host_time_s[0]
    centred = sensor - sensor.mean()
    slope = float(centred @ (host - host.mean()) / (centred @ centred))
    spread = float(np.std(host - slope * sensor))
    std = spread / float(np.sqrt(centred @ centred))
    said = (
        f"a second of the sensor is {slope:.9f} s of the computer (1σ {std * 1e6:.2g} ppm from the stamps' scatter); "
        "rates are integrated over the computer's time"
    )
    return log.time_s[0] + slope * sensor, said


def _temperature(built: Assembled, log: Log, unit: int) -> np.ndarray:
    maps = [m for m in (built.model.bias, built.model.scale) if m is not None]
    if log.temperature_c is not None and np.isfinite(log.temperature_c[unit]).any():
        values = log.temperature_c[unit]
        known = np.isfinite(values)
        return values if known.all() else np.interp(log.time_s, log.time_s[known], values[known])
    if any(m.temperature.size > 1 for m in maps) or built.model.has_gradient:
        raise LogError(
            "the log has no temperature, and the spec's maps depend on it: give them a temperature basis of degree 0"
        )
    return np.full(len(log.time_s), 20.0)


def _table_axis(log: Log, axis: str, named: str | None) -> int | None:
    if named is not None:
        if named not in log.table_axes:
            raise LogError(f"the log has no table axis '{named}': it has {', '.join(log.table_axes) or 'none'}")
        return log.table_axes.index(named)
    if axis in log.table_axes:
        return log.table_axes.index(axis)
    if len(log.table_axes) == 1:
        return 0
    if not log.table_axes:
        return None
    raise LogError(
        f"which of the table's axes ({', '.join(log.table_axes)}) turns the sensor about {axis}? Say it with "
        "--table-axis"
    )


# --- the gradient method ------------------------------------------------------------------------------------------


def _gradient(
    built: Assembled, log: Log, axis: str, members: list[int], rows: dict[int, _Rows], options: Options
) -> dict[int, UnitChannel]:
    first = rows[members[0]]
    model = built.model
    rest_bias = float(np.mean(first.rate[first.standing & first.usable])) if first.standing.any() else 0.0
    stands = first.standing
    reading_rows = None
    if first.angle is not None:
        if float(model.reference.reading_noise) > 0.0 and _repeats(first.angle, stands):
            reading_rows = room.distinct_readings(first.time, first.angle, stands, options.read_every)
        stands = stands | room.momentary_stops(first.rate - rest_bias, stands, first.angle, first.step)
    done = room.executed(
        first.time,
        first.temperature,
        first.rate - rest_bias,
        first.angle,
        stands,
        first.usable,
        axis=axis,
        read_every=options.read_every,
        longest_piece=_longest_piece(model),
        reading_rows=reading_rows,
    )
    messages = list(first.messages)
    if first.angle is None:
        messages.append(
            "the log has no table angle: only what the sensor says at rest is used, and no scale factor can be seen"
        )
    steps = room.steps_of(done.timeline, model)
    readings = np.stack([_integrated(rows[u], done, options.earth_rate) for u in members], axis=1)
    moving = np.asarray(done.timeline.moving)
    temperature, mean_rate = _means(first, done)
    time = first.time[done.rows[1:]]
    turning = _within(done.rows, moving & ~done.broken, len(first.time))

    def observe(lag: float, parameters: np.ndarray | None) -> Observations:
        columns = []
        for k, unit in enumerate(members):
            one = rows[unit]
            followed = _followed(one, lag)
            rates = one.rate - (rest_bias if parameters is None else options.earth_rate)
            if parameters is not None:
                rates[turning] = room.true_rate(model, parameters[k], rates[turning], followed[turning])
            turned = None if one.angle is None else np.diff(one.angle[done.rows])
            increments = room.increments_of_samples(
                model,
                rates,
                followed,
                one.step,
                done.rows,
                moving,
                done.broken,
                rate_noise=_rate_noise(model, one.step),
            )
            columns.append(room.columns_at_readings(done.timeline, model, increments, turned))
        return Observations(steps, np.stack(columns), readings, time, temperature, mean_rate)

    def settle(lag: float, parameters: np.ndarray | None = None) -> tuple[Observations, Whitened, Estimate, float]:
        """Map and regressors in turn, until neither changes; by how many standard deviations the maps still did."""
        moved = np.inf
        for _ in range(_ROUNDS):
            observations = observe(lag, parameters)
            white = room.whitened(observations, model)
            found = room.solve(white)
            if model.scale is None or not moving.any():
                moved = 0.0
            elif parameters is not None:
                moved = _moved(found, parameters, model)
            if moved < _SETTLED:
                break
            parameters = found.parameters
        return observations, white, found, moved  # pyright: ignore[reportPossiblyUnboundVariable]

    lag, lag_std = _fitted_lag(settle) if options.lag == "fit" else (float(options.lag), None)
    observations, white, _, moved = settle(lag)
    if moved >= _SETTLED:
        messages.append(
            "the maps have not settled: taken at the rates that they themselves make of the sensor's, they still "
            f"change by {moved:.2g} standard deviations; the maps are wild, or the noise figures far too small"
        )
    counts = _counts(log, members, done)
    result: dict[int, UnitChannel] = {}
    for k, unit in enumerate(members):
        own = observations._replace(columns=observations.columns_of(k), readings=observations.readings[:, k : k + 1])
        single = Whitened(white.rows_of(k)[None], white.data[k : k + 1], white.prior)
        result[unit] = _finished(
            built, log, axis, unit, own, single, options, lag, lag_std, counts[unit], rows[unit], messages, done
        )
    return result


def _finished(
    built, log, axis, unit, observations, white, options, lag, lag_std, counts, rows, messages, done
) -> UnitChannel:
    """One unit: smoothness, robustness and the tests, on columns that have settled."""
    model, messages = built.model, list(messages)
    smoothness = None
    if options.smoothness == "auto":
        smoothness = room.choose_smoothness(white, model)
        model = room.with_smoothness(model, smoothness.bias, smoothness.scale_factor)
        white = white._replace(prior=np.asarray(model.prior_rows()))
        if smoothness.at_edge:
            messages.append("the data do not tell how smooth the maps are: the strength stands at the edge looked at")
    found = room.solve(white)
    weights = np.ones(white.data.shape[1])
    if options.robust:
        robust = room.estimate_robustly(observations, model, threshold=options.threshold)
        found, white, weights = robust.estimate, robust.white[0], robust.weights[0]
        low = int(np.count_nonzero(weights < 1.0))
        if low:
            at = observations.time_s[observations.used][np.argsort(weights)[: min(low, 5)]]
            messages.append(
                f"{low} of {len(weights)} readings count for less than in full, the least at "
                + ", ".join(f"{t:.6g} s" for t in at)
            )
    tests = room.consistency(found, white, 0, _subsets(observations, rows), to_reported(model))
    if lag_std is not None and lag > 0.99 * _LONGEST_LAG_S:
        messages.append(f"the lag stands at the longest looked at, {lag:.0f} s: the data do not tell it")
    if lag_std is not None and lag < 2.0 * lag_std:
        messages.append(f"no lag of the maps shows: the one found is {lag:.2g} s, and uncertain by {lag_std:.2g} s")
    inside = rows.temperature[_integrated_rows(done, len(rows.time))]
    groups: tuple[room.Group, ...] = ()
    if options.neighbours_k is not None:
        groups, said = _neighbours(model, observations, found, rows, done, options.neighbours_k)
        messages += said
    return UnitChannel(
        axis,
        log.units[unit],
        model,
        observations,
        found,
        white,
        tests,
        weights,
        lag,
        lag_std,
        smoothness,
        _outwards(float(inside.min()), float(inside.max()), _TEMPERATURE_STEP),
        _fastest(model, found, rows, lag),
        counts,
        tuple(dict.fromkeys(messages)),
        groups,
    )


def _neighbours(
    model: GyroModel, observations: Observations, found: Estimate, rows: _Rows, done: room.Executed, width_k: float
) -> tuple[tuple[room.Group, ...], list[str]]:
    """The moves without a structure, beside what the map says of each."""
    if done.timeline.rate_reference or rows.angle is None or model.scale is None:
        return (), ["there are no moves between two rests whose angle is known, so no neighbours to take together"]
    scale = model.columns.scale
    moves = room.moves_between_rests(
        observations.readings[:, 0],
        observations.columns_of(0)[:, scale] @ found.parameters[0][scale],
        np.diff(rows.angle[done.rows]),
        np.diff(rows.time[done.rows]),
        observations.temperature_c,
        np.asarray(done.timeline.moving),
        done.broken,
    )
    groups = room.closest_neighbours(moves, width_k)
    said = [] if groups else ["no move has a rest right before and after it, so there are no neighbours"]
    return groups, said


def _fastest(model: GyroModel, found: Estimate, rows: _Rows, lag: float) -> tuple[float, float]:
    """Slowest and fastest true rate of the rows that turn, rad/s; zero where none has a reference."""
    turning = ~rows.standing & rows.usable
    if rows.angle is None or not turning.any():
        return 0.0, 0.0
    rates = room.true_rate(model, found.parameters[0], rows.rate[turning], _followed(rows, lag)[turning])
    return _outwards(min(float(rates.min()), 0.0), max(float(rates.max()), 0.0), _RATE_STEP)


def _outwards(low: float, high: float, step: float) -> tuple[float, float]:
    """The range, rounded to whole steps so that it holds what it held."""
    return float(np.floor(low / step + 1e-6) * step), float(np.ceil(high / step - 1e-6) * step)


def _longest_piece(model: GyroModel) -> float:
    """A few correlation times of the noise that the rate drives, s."""
    driven = (np.asarray(model.processes.rate_gain) != 0.0) & (np.asarray(model.processes.decay) > 0.0)
    if not driven.any():
        return np.inf
    return _CORRELATION_TIMES_A_PIECE / float(np.max(np.asarray(model.processes.decay)[driven]))


def _rate_noise(model: GyroModel, step: np.ndarray) -> float:
    usual = float(np.median(step[1:]))
    return float(model.angle_random_walk) / np.sqrt(usual)


def _followed(rows: _Rows, lag: float) -> np.ndarray:
    """The temperature that the maps follow."""
    if lag <= 0.0:
        return rows.temperature
    return lagged(rows.temperature, float(np.mean(rows.step[1:])), lag)


def _integrated(rows: _Rows, done: room.Executed, earth_rate: float) -> np.ndarray:
    return room.integrated_error(
        rows.rate, rows.step, rows.angle, done.rows, done.broken, done.timeline.gap_pieces.values, earth_rate
    )


def _means(rows: _Rows, done: room.Executed) -> tuple[np.ndarray, np.ndarray]:
    """Temperature and rate of each piece, for reports."""
    ends = rows.temperature[done.rows]
    terms = np.asarray(done.timeline.terms)[:, 0]
    return 0.5 * (ends[1:] + ends[:-1]), terms


def _moved(found: Estimate, before: np.ndarray, model: GyroModel) -> float:
    """The largest change of any parameter since the round before, in its standard deviations."""
    largest = 0.0
    rows = to_reported(model)
    for now, then, known in zip(found.parameters, before, found.known, strict=True):
        std = known.deviations(rows)
        change = np.abs(rows @ (now - then))
        seen = np.isfinite(std) & (std > 0.0)
        largest = max(largest, float(np.max(change[seen] / std[seen], initial=0.0)))
    return largest


def _fitted_lag(settle) -> tuple[float, float]:
    """The lag at which the smallest χ² of all units together lies, and what it is uncertain by (curvature of χ²)."""
    known: dict[float, float] = {}
    last: list[np.ndarray | None] = [None]

    def chi_squared(lag: float) -> float:
        if lag not in known:
            _, _, found, _ = settle(lag, last[0])
            last[0] = found.parameters
            known[lag] = float(found.chi_squared.sum())
        return known[lag]

    grid = [0.0, *np.geomspace(5.0, _LONGEST_LAG_S, 12)]
    values = [chi_squared(lag) for lag in grid]
    best = int(np.argmin(values))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found: Any = optimize.minimize_scalar(chi_squared, bounds=(low, high), method="bounded", options={"xatol": 0.05})
    lag = float(found.x) if found.fun < values[best] else grid[best]
    width = max(0.05 * lag, 1.0)
    around = [max(lag - width, 0.0), lag, lag + width]
    bend = np.polyfit(around, [chi_squared(x) for x in around], 2)[0]
    return lag, float(1.0 / np.sqrt(bend)) if bend > 0.0 else float("inf")


def _within(rows: np.ndarray, pieces: np.ndarray, count: int) -> np.ndarray:
    """`(count,)`: whether a row lies in one of the chosen pieces."""
    change = np.zeros(count + 1, np.int64)
    np.add.at(change, rows[:-1][pieces] + 1, 1)
    np.add.at(change, rows[1:][pieces] + 1, -1)
    return np.cumsum(change[:-1]) > 0


def _integrated_rows(done: room.Executed, count: int) -> np.ndarray:
    """`(count,)`: the rows whose samples were integrated."""
    return _within(done.rows, ~done.broken, count)


def _counts(log: Log, members: list[int], done: room.Executed) -> dict[int, dict[str, int]]:
    """Every row read: used, or why not."""
    used = _integrated_rows(done, len(log.time_s))
    return {unit: count_rows(log, unit, used) for unit in members}


def count_rows(log: Log, unit: int, used: np.ndarray) -> dict[str, int]:
    """Rows read by what became of them: ``used``, removed or masked by reason, or without a reference."""
    masked = log.counts(unit)
    usable = masked.pop("used")
    count = int(np.count_nonzero(used & log.usable(unit)))
    return {"used": count, "without a reference": usable - count, **masked}


def _subsets(observations: Observations, rows: _Rows) -> dict[str, np.ndarray]:
    """Halves of the readings that ought to agree."""
    used = observations.used
    time = observations.time_s[used]
    result: dict[str, np.ndarray] = {}
    minute = np.interp(time + 30.0, rows.time, rows.temperature) - np.interp(time - 30.0, rows.time, rows.temperature)
    heating, cooling = minute > 0.05, minute < -0.05
    if heating.sum() > 0.1 * len(time) and cooling.sum() > 0.1 * len(time):
        result["heating against cooling"] = minute > 0.0
    turning = observations.rate_rad_per_s[used] != 0.0
    moves = np.cumsum(np.diff(turning, prepend=False) & turning)
    if moves.max(initial=0) >= 4:
        result["odd moves against even ones"] = moves % 2 == 1
    if len(time) >= 4:
        result["first half against second"] = time < 0.5 * (time[0] + time[-1])
    return result


# --- the standard method ------------------------------------------------------------------------------------------


def _standard(built: Assembled, log: Log, axis: str, unit: int, rows: _Rows, options: Options) -> UnitChannel:
    schedule = built.spec.schedule
    assert isinstance(schedule, StandardSchedule)
    planned = np.asarray(schedule.rates, float)
    table_rate = rows.table_rate
    if table_rate is None:
        if rows.angle is not None:
            table_rate = np.gradient(rows.angle, rows.time)
        elif np.all(planned == 0.0):
            table_rate = np.zeros(len(rows.time))
        else:
            raise LogError("the log has no table rate, which is the reference of the standard method")
    found_points = room.plateaus(
        rows.time,
        rows.temperature,
        table_rate,
        rows.usable,
        np.asarray(schedule.temperatures, float),
        planned,
        float(schedule.integration),
        axis=axis,
    )
    messages = list(rows.messages)
    if found_points.missing:
        t, w = found_points.missing[0]
        messages.append(
            f"{len(found_points.missing)} of the plan's points are not in the log, the first at {t:g} degC and "
            f"{np.degrees(w):.4g} deg/s"
        )
    model, line = built.model, found_points.timeline
    edges, broken = _point_edges(found_points)
    followed = _followed(rows, 0.0 if options.lag == "fit" else float(options.lag))
    if options.lag == "fit":
        messages.append("at stable temperatures there is no lag to be found: it is taken as zero")
    moving = np.ones(len(broken), bool)
    increments = room.increments_of_samples(model, table_rate, followed, rows.step, edges, moving, broken)
    columns = increments[~broken]
    error = np.where(rows.usable, rows.rate - table_rate - options.earth_rate, 0.0) * rows.step
    sums = np.concatenate([[0.0], np.cumsum(error)])
    readings = (sums[found_points.last + 1] - sums[found_points.first + 1])[:, None]
    mean_rate = np.asarray(line.terms)[:, 0]
    time = rows.time[found_points.last]
    observations = Observations(room.steps_of(line, model), columns, readings, time, np.asarray(line.trail), mean_rate)
    white = room.whitened(observations, model)
    used = np.zeros(len(log.time_s), bool)
    for a, b in zip(found_points.first, found_points.last, strict=True):
        used[a + 1 : b + 1] = True
    done = room.Executed(line, edges, broken, 0)
    channel = _finished(
        built,
        log,
        axis,
        unit,
        observations,
        white,
        options,
        float(options.lag) if options.lag != "fit" else 0.0,
        None,
        count_rows(log, unit, used),
        rows,
        messages,
        done,
    )
    section = built.spec.plan
    if isinstance(section, StandardPlanSection) and section.estimator == "least squares":
        channel = channel._replace(found=_unweighted(channel, line))
    return channel._replace(
        valid_temperature_c=_outwards(float(np.min(line.trail)), float(np.max(line.trail)), _TEMPERATURE_STEP),
        valid_rate_rad_per_s=_outwards(min(float(mean_rate.min()), 0.0), max(float(mean_rate.max()), 0.0), _RATE_STEP),
    )


def _point_edges(points: room.Plateaus) -> tuple[np.ndarray, np.ndarray]:
    """Rows that divide the log into the points and what lies between them, and which of the parts are such."""
    edges, broken = [int(points.first[0])], []
    for a, b in zip(points.first, points.last, strict=True):
        if int(a) != edges[-1]:
            edges.append(int(a))
            broken.append(True)
        edges.append(int(b))
        broken.append(False)
    return np.array(edges), np.array(broken)


def _unweighted(channel: UnitChannel, line) -> Estimate:
    """Ordinary least squares on the points' mean rate errors, as the paper's figure; priors are not used."""
    observations = channel.observations
    duration = np.asarray(line.duration)
    design = observations.columns_of(0) / duration[:, None]
    scale = np.where((norm := np.linalg.norm(design, axis=0)) > 0, norm, 1.0)
    data = observations.readings[:, 0] / duration
    beta = np.linalg.lstsq(design / scale, data, rcond=1e-11)[0] / scale
    residuals = channel.white.data[0] - channel.white.rows[0] @ beta
    return channel.found._replace(
        parameters=beta[None], known=(unweighted(line, channel.model),), residuals=residuals[None]
    )
