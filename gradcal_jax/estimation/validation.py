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
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax import estimation, formulas
from gradcal_jax.calibration import correction
from gradcal_jax.calibration.file import LOG_HASH, TEMPERATURE_RATE, Calibration
from gradcal_jax.estimation.log_rows import count_rows, table_axis_of, table_readings, usable_rows
from gradcal_jax.motion import EARTH_RATE
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.tables.display import summary
from gradcal_jax.units import DEG_PER_H, DEG_PER_S, PPM, G

# A shorter rest (s) tells nothing; temperatures within this (K) are one range.
_BRIEF_S, _SAME_K = 1.0, 1.0
# A turn is of one table axis where the others turn by less, rad; least turn that shows a scale factor, rad.
_OTHER_AXIS, _LEAST_TURN = 1e-4, np.radians(1.0)
# Share of the way of a turn that is straight; rates within this share of each other are one.
_STRAIGHT, _ALIKE = 0.98, 0.2


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

    `error`, `std`: mean error of the cell with the largest, and its standard uncertainty by the scatter within the
    cell; `verdict`: "met" or "missed".
    """

    name: str
    axis: str
    unit: str
    target: float
    error: float
    std: float
    verdict: str


class AxisValidation(NamedTuple):
    """The validation of one axis, or of "gyros" or "accelerometers" together. `rms` by unit: errors before and after,
    of moves' angles (ppm), and of rates (deg/h) or forces (ug) at rest; together, of their norms."""

    axis: str
    moves: int
    rests: int
    rms: dict[str, tuple[float, float]]
    cells: tuple[Cell, ...]
    rows: dict[str, int]
    messages: tuple[str, ...]

    __repr__ = summary


class _Group(NamedTuple):
    """Channels that are validated together: their outputs `(n, 3)` or `(n, 1)` before and after, what they show at rest
    (rad/s or m/s²), and the axes of the table that are their reference."""

    name: str
    kind: str
    truth: float
    both: list[np.ndarray]
    tables: list[int]


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

    def edges(temperature: np.ndarray) -> np.ndarray:
        """The edges of the ranges (°C); one range where the temperature hardly changes or is not known."""
        known = temperature[np.isfinite(temperature)]
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
        if neighbours_k is not None:
            return low + neighbours_k * np.arange(int((high - low) / neighbours_k) + 2)
        return np.linspace(low, high, temperature_parts + 1) if high - low > _SAME_K else np.array([low, high])

    groups = _groups(calibration, log, number, earth_rate, gravity)
    result = [_validated(log, number, group, edges) for group in groups]
    if not any(one.moves or one.rests for one in result):
        raise LogError("the log has neither a move with a table angle nor a rest, so there is no reference")
    return result


def _groups(calibration: Calibration, log: Log, number: int, earth_rate: float, gravity: float) -> Iterator[_Group]:
    """Both triads, where the correction of a channel depends on others; otherwise every calibrated gyro."""
    corrected = correction.apply(calibration, log, number)
    pairs = [log.channels(number), corrected.log.channels()]
    known = {name for name in pairs[0] if name not in corrected.left_alone}

    def both(names: list[str]) -> list[np.ndarray]:
        return [np.stack([of[name] for name in names], axis=1) for of in pairs]

    found = False
    if any(
        name.strip("|") not in (channel.input, TEMPERATURE_RATE)
        for channel in calibration.channel
        for term in channel.term
        for name in term.signals
    ):
        for kind, truth in (("gyro", EARTH_RATE), ("accelerometer", gravity)):
            names = [f"{kind} {axis}" for axis in "xyz"]
            if known.issuperset(names):
                found = True
                yield _Group(f"{kind}s", kind, truth, both(names), list(range(len(log.table_axes))))
    for axis in () if found else log.axes:
        if f"gyro {axis}" in known:
            place = table_axis_of(log, axis)
            yield _Group(axis, "gyro", earth_rate, both([f"gyro {axis}"]), [] if place is None else [place])


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
        if cells:
            worst = max(cells, key=lambda cell: abs(cell.after))
            # The scatter is the population's standard deviation about its own mean.
            std = worst.scatter / float(np.sqrt(worst.how_many - 1))
            verdict = "met" if abs(worst.after) <= result.target else "missed"
            rows.append(Acceptance(result.name, result.axis, result.unit, result.target, worst.after, std, verdict))
    return rows


class _Stop(NamedTuple):
    """A rest of the table axes: its first and last row, and their angles `(L,)`, rad."""

    first: int
    last: int
    angles: np.ndarray


def _stops(log: Log, unit: int, tables: list[int], messages: list[str]) -> list[_Stop]:
    """The rests of these axes of the table that are longer than a moment."""
    number = log.standstill
    if number is None:
        number = estimation.find_standstills(log.rate_rad_per_s[unit], log.sample_interval_s, valid=log.usable(unit))
        messages.append("the log marks no standstills: they were detected where the rates are steady")
    standing = reading = number >= 0
    reads = []
    for table in tables:
        read, stands = table_readings(log, table, standing, np.inf, messages, every_kind=True)
        reads.append(read)
        if len(tables) == 1:
            # Other axes may move meanwhile; the angle is known where it is read.
            reading = np.zeros(len(number), bool)
            reading[read.rows] = True
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


def _validated(log: Log, unit: int, group: _Group, edges: Callable[[np.ndarray], np.ndarray]) -> AxisValidation:
    messages: list[str] = []
    stops = _stops(log, unit, group.tables, messages)
    usable = usable_rows(log, unit) & np.isfinite(group.both[0]).all(axis=1)
    step = np.where(usable, np.diff(log.time_s, prepend=log.time_s[0]), 0.0)
    group = group._replace(both=[np.where(usable[:, None], values, 0.0) for values in group.both])
    temperature = np.full(len(step), np.nan) if log.temperature_c is None else log.temperature_c[unit]
    spans = [(stop.first, stop.last) for stop in stops]
    cells: list[Cell] = []
    rms: dict[str, tuple[float, float]] = {}
    turns = []
    for one, other in itertools.pairwise(stops) if group.kind == "gyro" and group.tables else ():
        if usable[one.last + 1 : other.first + 1].all() and (turn := _turn(group, one, other, step, temperature)):
            turns.append(turn)
            spans.append((one.last, other.first))
    if turns:
        before, after, warm, speeds = np.array(turns).T
        rms["ppm"] = _rms(before), _rms(after)
        cells += _cells(warm, speeds, before, after, edges(warm), "ppm")
    if stops:
        # A rest in which the temperature changes is divided by its ranges.
        piece = np.full(len(step), -1)
        for k, stop in enumerate(stops):
            piece[stop.first + 1 : stop.last + 1] = k
        inside = usable & (piece >= 0)
        ends = edges(temperature[inside])
        part = (piece * (len(ends) - 1) + _ranges(temperature, ends))[inside]
        lasting = np.bincount(part, step[inside])
        kept = lasting > _BRIEF_S

        def mean(values: np.ndarray) -> np.ndarray:
            return np.bincount(part, (values * step)[inside])[kept] / lasting[kept]

        factor, label = (DEG_PER_H, "deg/h") if group.kind == "gyro" else (1e6 / G, "ug")
        sizes = []
        for values in group.both:
            means = np.stack([mean(column) for column in values.T])
            sizes.append(means[0] if len(means) == 1 else np.linalg.norm(means, axis=0))
        before, after = ((size - group.truth) * factor for size in sizes)
        rms[label] = _rms(before, lasting[kept]), _rms(after, lasting[kept])
        cells += _cells(mean(temperature), None, before, after, ends, label)
    used = estimation.within(np.array(spans, int).reshape(-1, 2), len(step))
    rows = count_rows(log, unit, used)
    return AxisValidation(group.name, len(turns), len(stops), rms, tuple(cells), rows, tuple(messages))


def _turn(
    group: _Group, one: _Stop, other: _Stop, step: np.ndarray, temperature: np.ndarray
) -> tuple[float, ...] | None:
    """Of a turn about one axis: errors of its angle before and after (ppm), mean temperature and rate (deg/s); None
    where several axes turn, or where it is no turn about one direction."""
    turned = other.angles - one.angles
    k = int(np.argmax(np.abs(turned)))
    if not abs(turned[k]) > _LEAST_TURN or np.any(np.delete(np.abs(turned), k) > _OTHER_AXIS):
        return None
    move, alone = slice(one.last + 1, other.first + 1), group.both[0].shape[1] == 1
    lasting, errors = np.sum(step[move]), list[float]()
    for values in group.both:
        whole = values[move].T @ step[move]
        way = np.sum(np.linalg.norm(values[move], axis=1) * step[move])
        if not alone and not errors and np.linalg.norm(whole) < _STRAIGHT * way:
            return None
        # About one direction, the integrated rate of a triad is as long as its way.
        along = np.sign(turned) if alone else whole / np.linalg.norm(whole)
        rests = [slice(stop.first + 1, stop.last + 1) for stop in (one, other)]
        drift = np.mean([values[rest].T @ step[rest] / np.sum(step[rest]) for rest in rests], axis=0)
        errors.append(float((whole - drift * lasting) @ along / abs(turned[k]) - 1.0) * PPM)
    speed = float(turned[k] if alone else abs(turned[k])) / lasting * DEG_PER_S
    return (*errors, float(np.average(temperature[move], weights=step[move])), speed)


def _rms(values: np.ndarray, weights: np.ndarray | None = None) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))


def _ranges(temperature: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The range of each temperature; the middle one where it is not known."""
    values = np.where(np.isfinite(temperature), temperature, 0.5 * (edges[0] + edges[-1]))
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _cells(temperature, speed, before, after, edges: np.ndarray, unit: str) -> list[Cell]:
    """Cells of ranges of temperature, and of like rates."""
    known = np.isfinite(temperature).any()
    warm, fast = _ranges(temperature, edges), np.zeros(len(before), int)
    if speed is not None:
        order = np.argsort(speed)
        size = np.abs(speed[order])
        apart = np.diff(speed[order]) > _ALIKE * np.maximum(size[1:], size[:-1])
        fast[order] = np.concatenate([[0], np.cumsum(apart)])
    rows: list[Cell] = []
    for i, j in itertools.product(range(len(edges) - 1), np.unique(fast)):
        inside = (warm == i) & (fast == j)
        if not inside.any():
            continue
        rates = None if speed is None else (float(speed[inside].min()), float(speed[inside].max()))
        warmth = (float(edges[i]), float(edges[i + 1])) if known else None
        was, left = float(np.mean(before[inside])), float(np.mean(after[inside]))
        rows.append(Cell(warmth, rates, int(inside.sum()), was, left, float(np.std(after[inside])), unit))
    return rows


def validation_rows(validations: list[AxisValidation]) -> list[dict[str, Any]]:
    """Plain numbers for `--json`."""
    return [{**one._asdict(), "cells": [cell._asdict() for cell in one.cells]} for one in validations]
