"""The calibration of a unit from a log of many positions at rest, turned by hand between them; no table, no spec."""

from collections.abc import Iterator, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from gradcal_jax import estimation, formulas
from gradcal_jax.calibration import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    build_term,
)
from gradcal_jax.estimation import Test
from gradcal_jax.estimation.calibration_rows import coefficient_rows, fit_rows, provenance_of
from gradcal_jax.estimation.hand import LOWER, ByHand, HandRows, find_positions, solve_by_hand
from gradcal_jax.estimation.log_rows import Options, bridged_temperature, time_of
from gradcal_jax.model import AXIS_NAMES
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.signal_faults import quiet_windows, refuse_repeated, without_faults
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_H, G

# Smallest eigenvalue of the mean of gravity's outer product below which all positions lie near one plane.
_FLAT = 0.01
_FRAME = "the accelerometers' own: x along accelerometer x, y in the plane of accelerometers x and y"
_GYRO_RATE = {"basis": "polynomial", "degree": 0, "scale": "300 deg/s"}


class HandReport(NamedTuple):
    """The estimate of one unit. `tests` by name; `gravity_left` (m/s²): rms of |f| − g over the positions; `turns_left`
    (rad): rms error of gravity's direction after a turn, in each of two directions across it."""

    unit: str
    solution: ByHand
    calibration: Calibration
    tests: dict[str, Test]
    gravity_left: float
    turns_left: float
    messages: tuple[str, ...]

    __repr__ = summary

    @property
    def as_wished(self) -> bool:
        """Whether every parameter is observable and every test passed."""
        return not self.calibration.unobservable and all(test.passed for test in self.tests.values())


def estimate_by_hand(
    log: Log,
    gravity: float,
    *,
    units: Sequence[str] = (),
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> list[HandReport]:
    """The calibration of every unit in `units` (default: all) from a log of many positions, by `gravity` (m/s²).

    Accelerometers by |f| = g over the standstills, then gyros by the turns of gravity between them
    (`gradcal_jax.estimation.hand`). Readings may be raw counts. `options`: `estimation.log_rows.Options`, of which
    this takes `earth_rate` (rad/s, straight up), `clock` and `temperature_c`; `sources`: names of files, for the
    provenance. Returns reports with a `calibration` (SI), tests, residuals of gravity (m/s²) and of the turns (rad),
    and `messages`.

    Errors: `LogError` where the log lacks what the estimate needs.
    """
    if not gravity > 0.0:
        raise ValueError(f"gravity is {gravity:g} m/s²: it must be positive")
    names = list(units) or list(log.units)
    return [_report(log, name, gravity, options or Options(), sources or {}) for name in names]


def _report(log: Log, name: str, gravity: float, options: Options, sources: dict[str, str]) -> HandReport:
    number, (time, messages) = log.unit_index(name), time_of(log, options)
    rates, force = log.triads(number)
    missing = [f"gyro {a}" for k, a in enumerate("xyz") if not np.isfinite(rates[:, k]).any()]
    missing += [f"accelerometer {a}" for k, a in enumerate("xyz") if not np.isfinite(force[:, k]).any()]
    if missing:
        raise LogError(
            f"the log has no {', '.join(missing)}: gravity calibrates three gyros by three accelerometers, along axes "
            "named x, y, z (in a column map: [rate] and [force])"
        )
    for kind, values in (("gyro", rates), ("accelerometer", force)):
        for k, axis in enumerate("xyz"):
            if said := refuse_repeated(f"{kind} {axis} of {name}", quiet_windows(values[:, k]).ravel()):
                messages.append(said)
    log, faults = without_faults(log, by_hand=True)
    messages += faults[name].sentences
    usable = log.usable(number) & np.isfinite(rates).all(axis=1) & np.isfinite(force).all(axis=1)
    if not usable.any():
        raise LogError(
            f"{name}: no row has both rates and specific forces: are gyros and accelerometers in separate rows? "
            "Write interpolate = true in the column map, or join the two streams first"
        )
    temperature = bridged_temperature(log, number, options.temperature_c)
    filled = fill_short_gaps(
        time,
        np.concatenate([rates, force], axis=1),
        usable,
        log.standstill,
        log.stretch_starts,
        log.sample_interval_s,
    )
    temperature = np.interp(filled.time, time, temperature)
    time, usable, rates, force = filled.time, filled.usable, filled.values[:, :3], filled.values[:, 3:]
    if filled.number:
        messages.append(f"{filled.number} rows in gaps of one or two rows are filled by cubic interpolation")
    try:
        standing = filled.standing
        if standing is None:
            standing = find_positions(rates, force, log.sample_interval_s, usable)
            messages.append(
                f"the log marks no standstills: {int(standing.max()) + 1} were detected where rates and "
                "forces are steady"
            )
        solution = solve_by_hand(HandRows(time, rates, force, usable, standing), gravity, options.earth_rate or 0.0)
    except ValueError as error:
        raise LogError(f"{name}: {error}") from None
    held, force_fit, rate_fit = solution.positions, solution.accelerometer, solution.gyro
    density = lambda noise, gain, unit: Quantity.of(float(np.sqrt(np.mean(noise))) / gain, unit)  # noqa: E731
    between = slice(int(held.rows[0, 0]), int(held.rows[-1, 1]) + 1)
    fastest = np.degrees(np.nanmax(np.abs((rates[between][usable[between]] - rate_fit.centre) / rate_fit.gain)))
    fastest = float(np.radians(np.ceil(fastest)))
    tests = {
        "accelerometers: norm of gravity": force_fit.test,
        "accelerometers: whiteness of |f| - g over positions": estimation.whiteness(force_fit.left, force_fit.taken),
        "gyros: turns of gravity": rate_fit.test,
        "gyros: rates at rest": solution.at_rest,
    }
    names, matrix = _covariance(solution)
    hidden = np.concatenate([force_fit.hidden, rate_fit.hidden])
    low, high = float(temperature[between].min()), float(temperature[between].max())
    ends = float(np.floor(low * 10.0) / 10.0), float(np.ceil(high * 10.0) / 10.0)
    covered: dict[str, Any] = {
        "valid_temperature": (Quantity.of(ends[0], "degC"), Quantity.of(ends[1], "degC")),
        "valid_rate": (Quantity.of(-fastest, "rad/s"), Quantity.of(fastest, "rad/s")),
    }
    calibration = Calibration(
        format=FORMAT,
        title=f"calibration of {name} by hand",
        serial_number=name,
        simulated=log.simulated,
        frame=_FRAME,
        order=ORDER,
        channel=tuple(
            CalibratedChannel(kind=kind, axis=a, term=terms, **covered) for kind, a, terms in _terms(solution)
        ),
        covariance=Covariance(
            names=tuple(n for n, out in zip(names, hidden, strict=True) if not out),
            matrix=tuple(map(tuple, matrix[np.ix_(~hidden, ~hidden)].tolist())),
        ),
        fit=fit_rows(tests.items()),
        unobservable=tuple(n for n, out in zip(names, hidden, strict=True) if out),
        noise=Noise(
            angle_random_walk=density(held.rate_noise, rate_fit.gain, "rad/s/sqrt(Hz)"),
            velocity_random_walk=density(held.force_noise, force_fit.gain, "m/s^2/sqrt(Hz)"),
            sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"),
        ),
        provenance=provenance_of(
            [log],
            name,
            sources,
            estimator=f"norm of gravity ({gravity:.9g} m/s^2) and its direction after turns; "
            f"{len(held.duration)} positions, {solution.turns} turns",
        ),
    )
    left = [float(np.sqrt(np.mean(fit.left**2))) for fit in (force_fit, rate_fit)]
    messages += _words(solution, tests, calibration.unobservable, gravity, options.earth_rate or 0.0)
    return HandReport(name, solution, calibration, tests, left[0], left[1], tuple(messages))


def _terms(solution: ByHand) -> Iterator[tuple[Literal["gyro", "accelerometer"], str, tuple[CalibratedTerm, ...]]]:
    """The coefficients of reading = centre + gain · (…) as terms of a calibration file, by kind and axis."""
    gyro, force = solution.gyro, solution.accelerometer
    for j, a in enumerate(AXIS_NAMES):
        row = gyro.gain * gyro.parameters.reshape(3, 7)[j]
        own = gyro.gain + row[j]
        terms = [
            build_term("bias", "rad/s", (), {"a": float(gyro.centre[j] + row[3])}),
            build_term("scale_factor", "1", (f"rate {a}",), {"b00": float(own - 1.0)}, rate=_GYRO_RATE),
        ]
        terms += [
            build_term(f"misalignment_{b}", "rad", (f"rate {b}",), {f"m_{b}": float(row[l] / own)})
            for l, b in enumerate("xyz")
            if l != j
        ]
        terms += [
            build_term(f"g_sensitivity_{b}", "rad/s/(m/s^2)", (f"force {b}",), {f"g_{b}": float(row[4 + l])})
            for l, b in enumerate("xyz")
        ]
        yield "gyro", a, tuple(terms)
    matrix = np.zeros((3, 3))
    for value, place in zip(force.parameters[3:], LOWER, strict=True):
        matrix[place] = force.gain * value
    for j, a in enumerate(AXIS_NAMES):
        terms: list[CalibratedTerm] = [
            build_term("bias", "m/s^2", (), {"a": float(force.centre[j] + force.gain * force.parameters[j])}),
            build_term("scale_factor", "1", (f"force {a}",), {"s": float(force.gain + matrix[j, j] - 1.0)}),
        ]
        own = force.gain + matrix[j, j]
        terms += [
            build_term(f"misalignment_{b}", "rad", (f"force {b}",), {f"m_{b}": float(matrix[j, l] / own)})
            for l, b in enumerate("xyz"[:j])
        ]
        yield "accelerometer", a, tuple(terms)


def _covariance(solution: ByHand) -> tuple[list[str], np.ndarray]:
    """Names of all coefficients, accelerometers first, and their covariance in SI."""
    names = [f"accelerometer_{a}.a" for a in "xyz"]
    names += [f"accelerometer_{'xyz'[j]}." + ("s" if j == l else f"m_{'xyz'[l]}") for j, l in LOWER]
    for j, a in enumerate(AXIS_NAMES):
        names += [f"gyro_{a}." + ("b00" if j == l else f"m_{'xyz'[l]}") for l in range(3)]
        names += [f"gyro_{a}.a", *(f"gyro_{a}.g_{b}" for b in "xyz")]
    gains = np.repeat([solution.accelerometer.gain, solution.gyro.gain], [9, 21])
    whole = np.block(
        [[solution.accelerometer.covariance, solution.cross], [solution.cross.T, solution.gyro.covariance]]
    )
    # The scale factor multiplies misalignments: of an element of the matrix, over that on its diagonal.
    values = {f"{kind}_{a}": terms for kind, a, terms in _terms(solution)}
    slopes = np.diag(gains)
    for row, name in enumerate(names):
        channel, _, symbol = name.partition(".")
        if symbol.startswith("m_"):
            found = {n: v for term in values[channel] for n, v in term.coefficients.items()}
            own = "b00" if channel.startswith("gyro") else "s"
            slopes[row, names.index(f"{channel}.{own}")] = -found[symbol] * gains[row]
            slopes[row] /= 1.0 + found[own]
    return names, slopes @ whole @ slopes.T


def _words(
    solution: ByHand, tests: dict[str, Test], unseen: Sequence[str], gravity: float, earth_up: float
) -> Iterator[str]:
    """Findings of the estimate, in sentences."""
    force, gyro, held = solution.accelerometer, solution.gyro, solution.positions
    for fit, what, unit in ((force, "forces", "m/s²"), (gyro, "rates", "rad/s")):
        if fit.gain != 1.0:
            yield (
                f"the {what} are {fit.gain:.4g} times those in {unit}: counts, or another full-scale range than "
                "that of the column map's scale; the scale factors include this factor"
            )
    up = (held.force - force.centre) / np.linalg.norm(held.force - force.centre, axis=1, keepdims=True)
    spread, axes = np.linalg.eigh(up.T @ up / len(up))
    if spread[0] < _FLAT:
        normal = ", ".join(f"{v:+.2f}" for v in axes[:, 0])
        yield (
            f"all positions are close to one plane: gravity was never along ({normal}) in the IMU's x, y, z; hold "
            "the IMU once with this direction up and once with it down"
        )
    for k, a in enumerate("xyz"):
        for words, most in (("up", up[:, k].max()), ("down", -up[:, k].min())):
            if most < 0.5:
                yield f"axis {a} was never held within 60° of {words}"
    if unseen:
        yield f"not observable: {', '.join(unseen)}; for these, the file has the values of an ideal IMU"
    if force.beyond > 0.0:
        yield (
            f"|f| - g differs between positions by {force.beyond / G * 1e6:.3g} µg more than noise explains: was "
            "the IMU at rest, and are its errors proportional to the force? The covariance includes this difference"
        )
    if gyro.beyond > 0.0:
        yield (
            f"gravity's direction after a turn has {gyro.beyond * 1e6:.3g} µrad more error than noise explains: "
            "the gyros have errors other than scale factor, misalignment and acceleration sensitivity, or the "
            "IMU moved during a standstill. The covariance includes this error"
        )
    if solution.unsteady > 0.0:
        yield (
            f"the gyros' rates at rest differ by {solution.unsteady * DEG_PER_H:.3g} deg/h more than noise and "
            "acceleration sensitivity explain, probably because of drift. The covariance includes this difference"
        )
    if not (white := tests["accelerometers: whiteness of |f| - g over positions"]).passed:
        yield (
            f"|f| - g is correlated from position to position (p-value {white.probability:.1g}): the IMU warms up "
            "or ages"
        )
    if earth_up == 0.0:
        yield ("the acceleration sensitivities include the Earth's rate along the vertical, up to 15 deg/h at 1 g")
    yield f"the accelerometers' scale factors are no more accurate than the stated gravity, {gravity:.6g} m/s²"


def hand_estimate_rows(report: HandReport) -> dict[str, Any]:
    """All numbers of an estimate for another program, SI."""
    calibration = report.calibration
    return {
        "unit": report.unit,
        "simulated": calibration.simulated,
        "parameters": coefficient_rows(calibration),
        "positions": len(report.solution.positions.duration),
        "turns": report.solution.turns,
        "gravity_rms_m_per_s2": report.gravity_left,
        "turns_rms_rad": report.turns_left,
        "tests": [row.model_dump(mode="json") for row in calibration.fit],
        "unobservable": list(calibration.unobservable),
        "messages": list(report.messages),
    }


LONGEST = 2
"""Largest number of rows of a gap that is filled."""


class FilledRows(NamedTuple):
    """Rows on whole intervals: `time` `(n,)` s, `values` `(n, channels)`, `usable` `(n,)`, `standing` `(n,)` or None;
    `number` of filled rows."""

    time: np.ndarray
    values: np.ndarray
    usable: np.ndarray
    standing: np.ndarray | None
    number: int


def fill_short_gaps(
    time: np.ndarray,
    values: np.ndarray,
    usable: np.ndarray,
    standing: np.ndarray | None,
    starts: np.ndarray,
    interval_s: float,
) -> FilledRows:
    """The rows with gaps of up to two of them filled by a cubic spline, whether they are missing or not `usable`;
    `starts`: rows after gaps. Those after longer ones, and the first, are not usable: what lay before was not recorded.
    """
    after_gap = np.isin(np.arange(1, len(time)), starts)
    missing = np.where(after_gap, np.rint(np.diff(time) / interval_s) - 1.0, 0.0).astype(np.int64)
    broken = after_gap & ((missing <= 0) | (missing > LONGEST))
    place = np.concatenate([[0], np.cumsum(np.where(broken, 0, missing) + 1)])
    rows = np.arange(place[-1] + 1)
    new_time = np.interp(rows, place, time)
    whole, good, begins = np.zeros((len(rows), values.shape[1])), np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    whole[place], good[place], begins[place[1:][broken]] = np.nan_to_num(values), usable, True
    begins[0] = True
    numbers = None
    if standing is not None:
        before = np.searchsorted(place, rows, side="right") - 1
        after = np.minimum(before + 1, len(standing) - 1)
        inserted = place[before] != rows
        numbers = np.where(inserted & (standing[before] != standing[after]), -1, standing[before])
    filled = np.zeros(len(rows), bool)
    for start, stop in formulas.runs(~good).tolist():
        filled[start:stop] = stop - start <= LONGEST and stop < len(rows) and not begins[start : stop + 1].any()
    if filled.any():
        whole[filled] = CubicSpline(new_time[good], whole[good])(new_time[filled])
    return FilledRows(new_time, whole, (good | filled) & ~begins, numbers, int(np.count_nonzero(filled)))
