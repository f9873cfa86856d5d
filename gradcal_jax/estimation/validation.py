"""Validation of a calibration with an independent log: remaining errors by temperature and rate.

The rates are integrated from standstill to standstill. The drift in the rests beside a move, its closest neighbours in
time, is subtracted; the difference of the move's angle from the table's, over the angle, is the remaining scale-factor
error. The mean rate at rest is the remaining bias. Moves of one rate within a few kelvins are averaged.

Channels that depend on each other are validated together, by what no mounting changes: the norm of the integrated rate
of a turn about one table axis is the turned angle; the norms of the mean specific force and rate at rest are gravity
and the Earth's rate.

**Closest neighbours**, a calibration without a structure, as in the paper, are the same means *before* the correction:
since they use neither the map nor the correlation of the noise, they check the map of the same log, too.
"""

import itertools
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
# Least turn that shows a scale factor, rad.
_LEAST_TURN = np.radians(1.0)
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
    gravity: float = G,
) -> list[AxisValidation]:
    """The errors that a calibration leaves on an independent log (its own is refused): ppm of moves' angles and deg/h
    at rest, rms before and after, by `temperature_parts` ranges of temperature (°C) and by rate (deg/s).

    For every axis of both. `neighbours_k`: closest neighbours, averaged over ranges of this width (K), also of the
    calibration's own log. `earth_rate` rad/s along the sensor's axis is subtracted; `gravity`: m/s²,
    at the place. Errors: `LogError` where the log holds neither moves with a reference nor rests;
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
    groups: list[tuple[str, str, float, list[np.ndarray]]] = []
    if _together(calibration):
        for name, kind, truth in (("gyros", "gyro", EARTH_RATE), ("accelerometers", "accelerometer", gravity)):
            both = [of.triads(k)[kind != "gyro"] for of, k in ((log, number), (corrected.log, 0))]
            left_alone = any(label.startswith(kind) for label in corrected.left_alone)
            if np.isfinite(both[0]).any(axis=0).all() and not left_alone:
                groups.append((name, kind, truth, both))
    for name in log.axes if not groups else ():
        if f"gyro {name}" not in corrected.left_alone:
            both = [of.channel(name, k)[:, None] for of, k in ((log, number), (corrected.log, 0))]
            groups.append((name, "gyro", earth_rate, both))
    result: list[AxisValidation] = []
    for name, kind, truth, both in groups:
        tables = list(range(len(log.table_axes)))
        if both[0].shape[1] == 1:
            place = table_axis_of(log, name)
            tables = [] if place is None else [place]
        result.append(_validated(log, number, name, kind, truth, both, tables, how))
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


class _Stop(NamedTuple):
    """A rest of the table axes: its first and last row, and their angles `(L,)`, rad."""

    first: int
    last: int
    angles: np.ndarray


def _stops(log: Log, unit: int, tables: list[int], messages: list[str]) -> list[_Stop]:
    """The rests of these axes of the table that are longer than a moment."""
    number, words = _standstills(log, unit)
    messages += words
    standing = reading = number >= 0
    reads = []
    for table in tables:
        read, stands = table_readings(log, table, standing, np.inf, messages, every_kind=True)
        reads.append(read)
        if len(tables) == 1:
            # Other axes may move meanwhile; the angle is known where it is read.
            _, reading, _ = read.at_rows(len(number))
            standing = stands | reading
    found: list[_Stop] = []
    for begin, end in formulas.runs(standing).tolist():
        rows = begin + np.flatnonzero(reading[begin:end])
        if not len(rows) or log.time_s[rows[-1]] - log.time_s[rows[0]] < _BRIEF_S:
            continue
        inside = [read.angle[(read.rows >= begin) & (read.rows < end)] for read in reads]
        angles = np.array([np.mean(angle) if len(angle) else np.nan for angle in inside])
        found.append(_Stop(int(rows[0]), int(rows[-1]), angles))
    return found


def _validated(
    log: Log, unit: int, name: str, kind: str, truth: float, both: list[np.ndarray], tables: list[int], how: "_Ranges"
) -> AxisValidation:
    """The validation of a triad by norms, or of one channel: `both` `(n, 3)` or `(n, 1)`, before and after; `truth`:
    what they show at rest, rad/s or m/s²."""
    messages, alone = list[str](), both[0].shape[1] == 1
    stops = _stops(log, unit, tables, messages)
    usable = usable_rows(log, unit) & np.isfinite(both[0]).all(axis=1)
    step = np.where(usable, np.diff(log.time_s, prepend=log.time_s[0]), 0.0)
    clock, broken = np.cumsum(step), np.cumsum(~usable)
    temperature = np.full(len(step), np.nan) if log.temperature_c is None else log.temperature_c[unit]
    integrals = [np.cumsum(np.where(usable[:, None], values, 0.0) * step[:, None], axis=0) for values in both]
    spans = [(stop.first, stop.last) for stop in stops]
    turns: list[tuple[float, ...]] = []
    for one, other in itertools.pairwise(stops) if kind == "gyro" and tables else ():
        begin, end, turned = one.last, other.first, other.angles - one.angles
        k = int(np.argmax(np.abs(turned)))
        beside = np.delete(np.abs(turned), k)
        if broken[begin] != broken[end] or not abs(turned[k]) > _LEAST_TURN or np.any(beside > _OTHER_AXIS):
            continue
        lasting, errors = clock[end] - clock[begin], list[float]()
        path = np.sum(np.linalg.norm(both[0][begin + 1 : end + 1], axis=1) * step[begin + 1 : end + 1])
        for total in integrals:
            whole = total[end] - total[begin]
            # About one direction, the integrated rate of a triad is as long as its way.
            along = np.sign(turned) if alone else whole / np.linalg.norm(whole)
            if not alone and not errors and whole @ along < _STRAIGHT * path:
                break
            rests = [(total[of.last] - total[of.first]) / (clock[of.last] - clock[of.first]) for of in (one, other)]
            moved = whole - np.mean(rests, axis=0) * lasting
            errors.append(float(moved @ along / abs(turned[k]) - 1.0) * PPM)
        if errors:
            speed = float(turned[k] if alone else abs(turned[k])) / lasting * DEG_PER_S
            turns.append(
                (*errors, float(np.average(temperature[begin + 1 : end + 1], weights=step[begin + 1 : end + 1])), speed)
            )
            spans.append((begin, end))
    cells, scale, pair = list[Cell](), None, None
    if turns:
        before, after, warm, speeds = np.array(turns).T
        scale = _rms(before), _rms(after)
        cells += _cells(warm, speeds, before, after, how.edges(warm), "ppm")
    if stops:
        # A rest in which the temperature changes is divided by its ranges.
        piece = np.full(len(step), -1)
        for k, stop in enumerate(stops):
            piece[stop.first + 1 : stop.last + 1] = k
        inside = usable & (piece >= 0)
        edges = how.edges(temperature[inside])
        part = (piece * (len(edges) - 1) + _ranges(temperature, edges))[inside]
        lasting = np.bincount(part, step[inside])
        kept = lasting > _BRIEF_S

        def mean(values: np.ndarray) -> np.ndarray:
            return np.bincount(part, (values * step)[inside])[kept] / lasting[kept]

        factor, label = (DEG_PER_H, "deg/h") if kind == "gyro" else (1e6 / G, "ug")
        means = [np.stack([mean(column) for column in values.T], axis=1) for values in both]
        sizes = [of[:, 0] if alone else np.linalg.norm(of, axis=1) for of in means]
        before, after = ((size - truth) * factor for size in sizes)
        pair = _rms(before, lasting[kept]), _rms(after, lasting[kept])
        cells += _cells(mean(temperature), None, before, after, edges, label)
    used = estimation.within(np.array(spans, int).reshape(-1, 2), len(step))
    rows, rates = count_rows(log, unit, used), kind == "gyro"
    figures = scale, pair if rates else None, tuple(cells), rows, tuple(messages), None if rates else pair
    return AxisValidation(name, len(turns), len(stops), *figures)


def _together(calibration: Calibration) -> bool:
    """Whether the correction of a channel depends on other channels."""
    return any(
        name.strip("|") not in (channel.input, TEMPERATURE_RATE)
        for channel in calibration.channel
        for term in channel.term
        for name in term.signals
    )


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
