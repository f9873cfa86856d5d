"""Validation of a calibration with an independent log: remaining errors by temperature and rate.

The corrected rates are integrated from standstill to standstill. The difference of a move's angle from the table's,
over the angle, is the remaining scale-factor error; the integrated rate at rest, over the time, the remaining bias.

Channels that depend on each other are validated together, by what no mounting changes: the norm of the integrated rate
of a turn about one table axis, less the rate at rest along it, is the turned angle; the norms of the mean specific
force and rate at rest are gravity and the Earth's rate.
"""

import itertools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation, formulas
from gradcal_jax.calibration import LOG_HASH, TEMPERATURE_RATE, Calibration, Result, correction
from gradcal_jax.estimation.log_rows import count_rows, table_axis_of, table_readings, usable_rows
from gradcal_jax.information.verdicts import specific_risk
from gradcal_jax.motion import EARTH_RATE
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.tables.display import summary
from gradcal_jax.units import DEG_PER_H, DEG_PER_S, PPM, G

# A shorter rest (s) tells nothing; temperatures within this (K) are one range.
_BRIEF_S, _SAME_K = 1.0, 1.0
# A turn is of one table axis where the others turn by less, rad.
_OTHER_AXIS = 1e-4
# Least turn that shows a scale factor, rad; parts of a move over whose temperatures is averaged.
_LEAST_TURN, _PARTS = np.radians(1.0), 8
_STRAIGHT = 0.98
# Rates within this share of each other are one.
_ALIKE = 0.2


class Cell(NamedTuple):
    """Moves (or rests) of one range of temperature (None: not known) and rate: mean error before and after, and the
    scatter of the error after."""

    temperature_c: tuple[float, float] | None
    rate_dps: tuple[float, float] | None
    how_many: int
    before: float
    after: float
    scatter: float
    unit: str


class Acceptance(NamedTuple):
    """The acceptance of a requirement of the calibration by measured errors (simple acceptance, JCGM 106, 8.2), in
    `unit`.

    `error`, `std`: mean error of the cell with the largest risk, and its standard uncertainty by the scatter within the
    cell; `specific_risk`: the chance that the error there is beyond the target; `verdict`: "met" or "missed".
    """

    name: str
    axis: str
    unit: str
    target: float
    error: float
    std: float
    specific_risk: float
    verdict: str
    rule: str


class AxisValidation(NamedTuple):
    """The validation of one axis, or of "gyros" or "accelerometers" together. `scale_factor_ppm`, `bias_deg_per_h`,
    `gravity_ug`: rms before and after, of moves, and of rates and forces at rest (together: their norms' errors)."""

    axis: str
    moves: int
    rests: int
    scale_factor_ppm: tuple[float, float] | None
    bias_deg_per_h: tuple[float, float] | None
    cells: tuple[Cell, ...]
    rows: dict[str, int]
    messages: tuple[str, ...]
    gravity_ug: tuple[float, float] | None = None

    __repr__ = summary


def validate(
    calibration: Calibration,
    log: Log,
    *,
    unit: str | int = 0,
    temperature_parts: int = 3,
    neighbours_k: float | None = None,
    earth_rate: float = 0.0,
    table_axis: str | None = None,
    gravity: float = G,
) -> list[AxisValidation]:
    """The errors that a calibration leaves on an independent log (its own is refused): ppm of moves' angles and deg/h
    at rest, rms before and after, by `temperature_parts` ranges of temperature (°C) and by rate (deg/s).

    For every axis of both. `neighbours_k`: closest neighbours, averaged over ranges of this width (K), also of the
    calibration's own log. `earth_rate` rad/s along the sensor's axis is subtracted; `table_axis`: the one that turns
    it; `gravity`: m/s², at the place. Errors: `LogError` where the log holds neither moves with a reference nor rests;
    `ValueError` for a width that is not positive.
    """
    if neighbours_k is not None and not neighbours_k > 0.0:
        raise ValueError(f"the temperature difference of neighbours must be positive, not {neighbours_k}")
    number = log.unit_index(unit)
    if neighbours_k is None and calibration.provenance.get(LOG_HASH) == log.fingerprint(number):
        raise LogError(
            "the calibration was estimated from this log, so these residuals are those of the fit. Validate with "
            "another log"
        )
    corrected = correction.apply(calibration, log, unit)
    how = _Ranges(temperature_parts, neighbours_k)
    result: list[AxisValidation] = []
    if _together(calibration):
        result += _triads(log, corrected.log, number, how, gravity, corrected.left_alone)
    for name in log.axes if not result else ():
        if f"gyro {name}" not in corrected.left_alone:
            result.append(_axis(log, corrected.log, number, name, how, earth_rate, table_axis))
    if not any(one.moves or one.rests for one in result):
        raise LogError("the log has neither a move with a table angle nor a rest, so there is no reference")
    return result


def acceptances(calibration: Calibration, validations: list[AxisValidation]) -> list[Acceptance]:
    """Verdicts on the targets in the calibration: every cell's mean error must be within the target. Cells of a single
    move or rest have no scatter, and are left out."""
    rows: list[Acceptance] = []
    by_axis = {one.axis: one for one in validations}
    for result in calibration.result:
        together = "gyros" if result.quantity == "gyro_scale_factor" else result.axis
        axis = result.axis if result.axis in by_axis else together
        if result.target is None or axis not in by_axis:
            continue
        cells = [c for c in by_axis[axis].cells if c.unit == result.unit and c.how_many > 1]
        judged = [_judged(result, cell) for cell in cells]
        if judged:
            rows.append(max(judged, key=lambda row: (row.verdict == "missed", row.specific_risk, abs(row.error))))
    return rows


def _judged(result: Result, cell: Cell) -> Acceptance:
    target, error = float(result.target or 0.0), cell.after
    # The scatter is the population's standard deviation about its own mean.
    std = cell.scatter / float(np.sqrt(cell.how_many - 1))
    rule = f"simple acceptance: the mean error within {target:g} {result.unit}"
    verdict = "met" if abs(error) <= target else "missed"
    risk = specific_risk(error, std, target)
    return Acceptance(result.name, result.axis, result.unit, target, error, std, risk, verdict, rule)


def _standstills(log: Log, unit: int) -> tuple[np.ndarray, list[str]]:
    """The number of the standstill of every row (−1: none), and messages on how they were found."""
    if log.standstill is not None:
        return log.standstill, []
    found = estimation.find_standstills(log.rate_rad_per_s[unit], log.sample_interval_s, valid=log.usable(unit))
    return found, ["the log marks no standstills: they were detected where the rates are steady"]


def _axis(
    log: Log, corrected: Log, unit: int, axis: str, how: "_Ranges", earth_rate: float, table_axis: str | None
) -> AxisValidation:
    (number, messages), column, time = _standstills(log, unit), log.axis_index(axis), log.time_s
    both = log.rate_rad_per_s[unit, :, column], corrected.rate_rad_per_s[0, :, column]
    usable = usable_rows(log, unit) & np.isfinite(both[0])
    step = np.diff(time, prepend=time[0])
    turned = [np.cumsum(np.where(usable, rates - earth_rate, 0.0) * step) for rates in both]
    table = table_axis_of(log, axis, table_axis)
    read, standing = table_readings(log, table, number >= 0, np.inf, messages, every_kind=True)
    angle, reading, _ = read.at_rows(len(time))
    temperature = log.temperature_c[unit] if log.temperature_c is not None else np.full(len(time), np.nan)
    stops = [np.flatnonzero(reading[a:b]) + a for a, b in formulas.runs(standing | reading)]
    stops = [rows for rows in stops if len(rows)]
    if sum(map(len, stops)) < 2:
        raise LogError("nothing can be estimated: the log has fewer than two readings while the table is at rest")
    unusable = np.cumsum(~usable)

    def whole(spans: Iterable[tuple[int, int]]) -> np.ndarray:
        """Spans from one reading to another, first and last row, in which every row may be integrated."""
        return np.array([(a, b) for a, b in spans if unusable[a] == unusable[b]], int).reshape(-1, 2)

    still = whole(span for rows in stops for span in itertools.pairwise(rows))
    if how.neighbours_k is not None:
        # The drift is that of both rests.
        stops = [rows for rows in stops if time[rows[-1]] - time[rows[0]] > _BRIEF_S]
    turns = whole((a[-1], b[0]) for a, b in itertools.pairwise(stops) if angle is not None)
    used = estimation.within(np.concatenate([turns, still]), len(time))
    # Turns with a stop of a single reading between them are one.
    apart = turns[1:, 0] != turns[:-1, 1]
    ends = np.append(True, apart)[: len(turns)], np.append(apart, True)[: len(turns)]
    turns = np.stack([turns[end, k] for k, end in enumerate(ends)], axis=1)
    if angle is not None:
        turns = turns[np.abs(angle[turns[:, 1]] - angle[turns[:, 0]]) > _LEAST_TURN]
    cells, scale, bias = list[Cell](), None, None
    if angle is not None and len(turns):
        first, last = turns.T
        truth, lasting = angle[last] - angle[first], time[last] - time[first]
        drifts = [np.zeros(len(turns))] * 2
        if how.neighbours_k is not None:
            place = {int(row): (int(rows[0]), int(rows[-1])) for rows in stops for row in (rows[0], rows[-1])}
            rests = np.array([[place[int(row)] for row in turn] for turn in turns])
            spans = time[rests[..., 1]] - time[rests[..., 0]]
            drifts = [np.mean((of[rests[..., 1]] - of[rests[..., 0]]) / spans, axis=1) for of in turned]
        before, after = (
            ((of[last] - of[first] - drift * lasting) / truth - 1.0) * PPM
            for of, drift in zip(turned, drifts, strict=True)
        )
        warm = np.array([_mean_of_parts(temperature, time, *turn) for turn in turns.tolist()])
        scale = (_rms(before), _rms(after))
        cells += _cells(warm, truth / lasting * DEG_PER_S, before, after, how.edges(warm), "ppm")
    still = still[time[still[:, 1]] - time[still[:, 0]] > _BRIEF_S]
    if len(still):
        # A rest in which the temperature changes is divided by its ranges.
        piece = np.full(len(time), -1)
        for k, (begin, end) in enumerate(still.tolist()):
            piece[begin + 1 : end + 1] = k
        inside = usable & (piece >= 0)
        edges = how.edges(temperature[inside])
        part = (piece * (len(edges) - 1) + _ranges(temperature, edges))[inside]
        lasting = np.bincount(part, step[inside])
        kept = lasting > _BRIEF_S
        values = (both[0] - earth_rate, both[1] - earth_rate, temperature)
        before, after, warm = (np.bincount(part, (of * step)[inside])[kept] / lasting[kept] for of in values)
        before, after = before * DEG_PER_H, after * DEG_PER_H
        bias = (_rms(before, lasting[kept]), _rms(after, lasting[kept]))
        cells += _cells(warm, None, before, after, edges, "deg/h")
    rows = count_rows(log, unit, used)
    return AxisValidation(axis, len(turns), len(still), scale, bias, tuple(cells), rows, tuple(messages))


def _mean_of_parts(temperature: np.ndarray, time: np.ndarray, first: int, last: int) -> float:
    """The mean temperature (°C) over equal parts of the time from one row to another."""
    parts = min(_PARTS, last - first)
    rows = np.searchsorted(time[: last + 1], np.linspace(time[first], time[last], parts + 1) - 1e-9)
    rows[0] = first
    at = temperature[np.minimum(rows, last)]
    return float(np.mean(0.5 * (at[1:] + at[:-1])))


def _together(calibration: Calibration) -> bool:
    """Whether the correction of a channel depends on other channels."""
    return any(
        name.strip("|") not in (channel.input, TEMPERATURE_RATE)
        for channel in calibration.channel
        for term in channel.term
        for name in term.signals
    )


def _triads(
    log: Log, corrected: Log, unit: int, how: "_Ranges", gravity: float, left_alone: tuple[str, ...]
) -> list[AxisValidation]:
    """The triads of gyros and of accelerometers that are calibrated and in the log."""
    number, messages = _standstills(log, unit)
    usable = usable_rows(log, unit)
    step = np.where(usable, np.diff(log.time_s, prepend=log.time_s[0]), 0.0)
    rows, still = count_rows(log, unit, usable), number >= 0
    lasts = np.bincount(number[still], step[still])
    rests = np.flatnonzero(lasts > _BRIEF_S)
    if not len(rests):
        return []
    temperature = np.full(len(number), np.nan) if log.temperature_c is None else log.temperature_c[unit]

    def mean(values: np.ndarray) -> np.ndarray:
        """Over each rest, `(rests, columns)`."""
        known = (np.nan_to_num(values) * step[:, None])[still]
        sums = np.stack([np.bincount(number[still], column, len(lasts)) for column in known.T], axis=1)
        return sums[rests] / lasts[rests, None]

    warm = mean(temperature[:, None])[:, 0] if np.isfinite(temperature).all() else np.full(len(rests), np.nan)
    edges, result = how.edges(warm), list[AxisValidation]()
    for kind, truth, factor, label in (
        ("gyro", EARTH_RATE, DEG_PER_H, "deg/h"),
        ("accelerometer", gravity, 1e6 / G, "ug"),
    ):
        before_and_after = [of.triads(k)[kind == "accelerometer"] for of, k in ((log, unit), (corrected, 0))]
        if not np.isfinite(before_and_after[0]).any(axis=0).all() or any(name.startswith(kind) for name in left_alone):
            continue
        at_rest = [mean(values) for values in before_and_after]
        before, after = ((np.linalg.norm(values, axis=1) - truth) * factor for values in at_rest)
        cells, pair = _cells(warm, None, before, after, edges, label), (_rms(before), _rms(after))
        if kind == "accelerometer":
            result.append(AxisValidation("accelerometers", 0, len(rests), None, None, tuple(cells), rows, (), pair))
            continue
        turns = _turns(log, number, rests, temperature, before_and_after, at_rest, step)
        scale = None
        if len(turns):
            uncorrected, left, heat, speed = turns.T
            scale = _rms(uncorrected), _rms(left)
            cells += _cells(heat, speed, uncorrected, left, how.edges(heat), "ppm")
        result.append(AxisValidation("gyros", len(turns), len(rests), scale, pair, tuple(cells), rows, tuple(messages)))
    return result


def _turns(
    log: Log,
    number: np.ndarray,
    rests: np.ndarray,
    temperature: np.ndarray,
    rates: list[np.ndarray],
    at_rest: list[np.ndarray],
    step: np.ndarray,
) -> np.ndarray:
    """Turns between rests about one table axis, `(turns, 4)`: errors before and after the correction (ppm), temperature
    (°C), mean rate (deg/s)."""
    angles: list[np.ndarray] = []
    for axis in range(len(log.table_axes)):
        read, _ = table_readings(log, axis, number >= 0, np.inf, [], every_kind=True)
        of_rest = [read.angle[number[read.rows] == rest] for rest in rests]
        angles.append(np.array([np.mean(own) if len(own) else np.nan for own in of_rest]))
    found: list[tuple[float, ...]] = []
    for k in range(len(rests) - 1) if angles else ():
        first = int(np.flatnonzero(number == rests[k])[-1])
        last = int(np.flatnonzero(number == rests[k + 1])[0])
        turned = np.sort(np.abs([angle[k + 1] - angle[k] for angle in angles]))
        between = slice(first + 1, last + 1)
        if not turned[-1] > _LEAST_TURN or np.any(turned[:-1] > _OTHER_AXIS) or not step[between].all():
            continue
        lasting, row = float(step[between].sum()), list[float]()
        wholes = [values[between].T @ step[between] for values in rates]
        # About one direction, the integrated rate is as long as its way.
        if np.linalg.norm(wholes[0]) < _STRAIGHT * (np.linalg.norm(rates[0][between], axis=1) @ step[between]):
            continue
        for whole, rest in zip(wholes, at_rest, strict=True):
            length = float(np.linalg.norm(whole))
            still = 0.5 * (rest[k] + rest[k + 1]) @ whole / length
            row.append(PPM * ((length - still * lasting) / turned[-1] - 1.0))
        found.append((*row, float(np.mean(temperature[between])), turned[-1] / lasting * DEG_PER_S))
    return np.array(found).reshape(-1, 4)


def _rms(values: np.ndarray, weights: np.ndarray | None = None) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))


class _Ranges(NamedTuple):
    """How cells are made: equal `parts` of the temperatures or, of closest neighbours, ranges of their width (K)."""

    parts: int
    neighbours_k: float | None

    def edges(self, temperature: np.ndarray) -> np.ndarray:
        """The edges (°C); one range where the temperature hardly changes or is not known."""
        known = temperature[np.isfinite(temperature)]
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
        if self.neighbours_k is not None:
            return low + self.neighbours_k * np.arange(int((high - low) / self.neighbours_k) + 2)
        return np.linspace(low, high, self.parts + 1) if high - low > _SAME_K else np.array([low, high])


def _ranges(temperature: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The range of each temperature; the middle one where it is not known."""
    values = np.where(np.isfinite(temperature), temperature, 0.5 * (edges[0] + edges[-1]))
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _like_rates(rates: np.ndarray) -> np.ndarray:
    """`(n,)`: numbers of the groups of `rates` `(n,)` whose neighbours are alike."""
    order = np.argsort(rates)
    ordered = rates[order]
    apart = np.diff(ordered) > _ALIKE * np.maximum(np.abs(ordered[1:]), np.abs(ordered[:-1]))
    like = np.empty(len(order), int)
    like[order] = np.concatenate([[0], np.cumsum(apart)])
    return like


def _cells(temperature, speed, before, after, edges: np.ndarray, unit: str) -> list[Cell]:
    """Cells of ranges of temperature, and of like rates."""
    known = np.isfinite(temperature)
    warm = _ranges(temperature, edges)
    fast = np.zeros(len(before), int) if speed is None else _like_rates(speed)
    rows: list[Cell] = []
    for i, j in itertools.product(range(len(edges) - 1), np.unique(fast)):
        inside = (warm == i) & (fast == j)
        if not inside.any():
            continue
        rates = None if speed is None else (float(speed[inside].min()), float(speed[inside].max()))
        warmth = (float(edges[i]), float(edges[i + 1])) if known.any() else None
        was, left = float(np.mean(before[inside])), float(np.mean(after[inside]))
        rows.append(Cell(warmth, rates, int(inside.sum()), was, left, float(np.std(after[inside])), unit))
    return rows


def validation_rows(validations: list[AxisValidation]) -> list[dict[str, Any]]:
    """Plain numbers for `--json`."""
    return [{**one._asdict(), "cells": [cell._asdict() for cell in one.cells]} for one in validations]
