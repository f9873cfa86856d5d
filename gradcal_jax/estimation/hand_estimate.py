"""The calibration of a unit from a log of many positions at rest, turned by hand between them; no table, no spec."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

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
from gradcal_jax.model import AXIS_NAMES, KINDS
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.signal_checks import quiet_windows, refuse_unlike_noise, without_faults
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_H, G

# Smallest eigenvalue of the mean of gravity's outer product below which all positions lie near one plane.
_FLAT = 0.01
_FRAME = "the accelerometers' own: x along accelerometer x, y in the plane of accelerometers x and y"
_GYRO_RATE = {"degree": 0, "scale": "300 deg/s"}


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
    earth_rate: float = 0.0,
    options: Options | None = None,
    sources: dict[str, str] | None = None,
) -> list[HandReport]:
    """The calibration of every unit in `units` (default: all) from a log of many positions, by `gravity` (m/s²).

    Accelerometers by |f| = g over the standstills, then gyros by the turns of gravity between them
    (`gradcal_jax.estimation.hand`). `options`: `estimation.log_rows.Options`, of which
    this takes `clock` and `temperature_c`; `earth_rate`: rad/s, straight up; `sources`: names of files, for the
    provenance. Returns reports with a `calibration` (SI), tests, residuals of gravity (m/s²) and of the turns (rad),
    and `messages`.

    Errors: `LogError` where the log lacks what the estimate needs.
    """
    if not gravity > 0.0:
        raise ValueError(f"gravity is {gravity:g} m/s²: it must be positive")
    names = list(units) or list(log.units)
    return [_report(log, name, gravity, earth_rate, options or Options(), sources or {}) for name in names]


def _report(
    log: Log, name: str, gravity: float, earth_rate: float, options: Options, sources: dict[str, str]
) -> HandReport:
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
            messages += refuse_unlike_noise(f"{kind} {axis} of {name}", quiet_windows(values[:, k]).ravel())
    log, faults = without_faults(log)
    messages += faults[name].sentences
    usable = log.usable(number) & np.isfinite(rates).all(axis=1) & np.isfinite(force).all(axis=1)
    if not usable.any():
        raise LogError(
            f"{name}: no row has both rates and specific forces: are gyros and accelerometers in separate rows? "
            "Write interpolate = true in the column map, or join the two streams first"
        )
    both = np.concatenate([rates, force], axis=1)
    filled = fill_short_gaps(time, both, usable, log.standstill, log.stretch_starts, log.sample_interval_s)
    temperature = np.interp(filled.time, time, bridged_temperature(log, number, options.temperature_c))
    if filled.number:
        messages.append(f"{filled.number} rows in gaps of one or two rows are filled by cubic interpolation")
    rates, force, standing = filled.values[:, :3], filled.values[:, 3:], filled.standing
    try:
        if standing is None:
            standing = find_positions(rates, force, log.sample_interval_s, filled.usable)
            messages.append(
                f"the log marks no standstills: {int(standing.max()) + 1} were detected where rates and "
                "forces are steady"
            )
        rows = HandRows(filled.time, rates, force, filled.usable, standing)
        solution = solve_by_hand(rows, gravity, earth_rate)
    except ValueError as error:
        raise LogError(f"{name}: {error}") from None
    tests = {
        "accelerometers: norm of gravity": solution.accelerometer.test,
        "accelerometers: whiteness of |f| - g over positions": estimation.whiteness(
            solution.accelerometer.left, solution.accelerometer.taken
        ),
        "gyros: turns of gravity": solution.gyro.test,
        "gyros: rates at rest": solution.at_rest,
    }
    source = provenance_of(
        [log],
        name,
        sources,
        estimator=f"norm of gravity ({gravity:.9g} m/s^2) and its direction after turns; "
        f"{len(solution.positions.duration)} positions, {solution.turns} turns",
    )
    calibration = _calibration(solution, rows, temperature, tests, log, name).model_copy(update={"provenance": source})
    left = [float(np.sqrt(np.mean(fit.left**2))) for fit in (solution.accelerometer, solution.gyro)]
    messages += _words(solution, tests, calibration.unobservable, gravity, earth_rate)
    return HandReport(name, solution, calibration, tests, left[0], left[1], tuple(messages))


def _calibration(
    solution: ByHand, rows: HandRows, temperature: np.ndarray, tests: dict[str, Test], log: Log, name: str
) -> Calibration:
    """The calibration of a unit at the temperatures (°C) and rates between its first and its last standstill."""
    held, (values, matrix) = solution.positions, _coefficients(solution)
    between = slice(int(held.rows[0, 0]), int(held.rows[-1, 1]) + 1)
    usable, warm = rows.usable[between], temperature[between]
    table = solution.gyro.parameters.reshape(3, 7)
    true = (rows.rates[between][usable] - table[:, 3]) / (1.0 + np.diag(table[:, :3]))
    fastest = float(np.radians(np.ceil(np.degrees(np.max(np.abs(true))))))
    ends = np.floor(warm.min() * 10.0) / 10.0, np.ceil(warm.max() * 10.0) / 10.0
    covered: dict[str, Any] = {
        "valid_temperature": tuple(Quantity.of(float(t), "degC") for t in ends),
        "valid_rate": (Quantity.of(-fastest, "rad/s"), Quantity.of(fastest, "rad/s")),
    }
    hidden = np.concatenate([solution.accelerometer.hidden, solution.gyro.hidden])
    density = lambda noise, unit: Quantity.of(float(np.sqrt(np.mean(noise))), unit)  # noqa: E731
    return Calibration(
        format=FORMAT,
        title=f"calibration of {name} by hand",
        serial_number=name,
        simulated=log.simulated,
        frame=_FRAME,
        order=ORDER,
        channel=tuple(
            CalibratedChannel(kind=kind, axis=a, term=tuple(_terms(f"{kind}_{a}", values)), **covered)
            for kind in KINDS
            for a in AXIS_NAMES
        ),
        covariance=Covariance(
            names=tuple(n for n, out in zip(values, hidden, strict=True) if not out),
            matrix=tuple(map(tuple, matrix[np.ix_(~hidden, ~hidden)].tolist())),
        ),
        fit=fit_rows(tests.items()),
        unobservable=tuple(n for n, out in zip(values, hidden, strict=True) if out),
        noise=Noise(
            angle_random_walk=density(held.rate_noise, "rad/s/sqrt(Hz)"),
            velocity_random_walk=density(held.force_noise, "m/s^2/sqrt(Hz)"),
            sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"),
        ),
    )


def _coefficients(solution: ByHand) -> tuple[dict[str, float], np.ndarray]:
    """All coefficients by their names in a calibration file, accelerometers first, and their covariance, in SI. A
    misalignment is an element of I + E over that on its diagonal, which multiplies it."""
    gyro, force = solution.gyro, solution.accelerometer
    names = [f"accelerometer_{a}.a" for a in "xyz"]
    names += [f"accelerometer_{'xyz'[j]}." + ("s" if j == l else f"m_{'xyz'[l]}") for j, l in LOWER]
    for j, a in enumerate("xyz"):
        names += [f"gyro_{a}." + ("b00" if j == l else f"m_{'xyz'[l]}") for l in range(3)]
        names += [f"gyro_{a}.a", *(f"gyro_{a}.g_{b}" for b in "xyz")]
    values = np.concatenate([force.parameters, gyro.parameters])
    slopes = np.eye(len(values))
    for row, name in enumerate(names):
        channel, _, symbol = name.partition(".")
        if symbol.startswith("m_"):
            diagonal = names.index(f"{channel}.b00" if channel.startswith("gyro") else f"{channel}.s")
            values[row] /= 1.0 + values[diagonal]
            slopes[row, diagonal] = -values[row]
            slopes[row] /= 1.0 + values[diagonal]
    whole = np.block([[force.covariance, solution.cross], [solution.cross.T, gyro.covariance]])
    return dict(zip(names, values.tolist(), strict=True)), slopes @ whole @ slopes.T


def _terms(channel: str, values: dict[str, float]) -> Iterator[CalibratedTerm]:
    """The terms of a channel, such as "gyro_x"."""
    kind, axis = channel.split("_")
    signal, unit = ("rate", "rad/s") if kind == "gyro" else ("force", "m/s^2")
    own = {name.partition(".")[2]: value for name, value in values.items() if name.startswith(f"{channel}.")}
    yield build_term("bias", unit, (), {"a": own["a"]})
    if kind == "gyro":
        yield build_term("scale_factor", "1", (f"rate {axis}",), {"b00": own["b00"]}, rate=_GYRO_RATE)
    else:
        yield build_term("scale_factor", "1", (f"force {axis}",), {"s": own["s"]})
    for b in "xyz":
        if f"m_{b}" in own:
            yield build_term(f"misalignment_{b}", "rad", (f"{signal} {b}",), {f"m_{b}": own[f"m_{b}"]})
    for b in "xyz":
        if f"g_{b}" in own:
            yield build_term(f"g_sensitivity_{b}", "rad/s/(m/s^2)", (f"force {b}",), {f"g_{b}": own[f"g_{b}"]})


def _words(
    solution: ByHand, tests: dict[str, Test], unseen: Sequence[str], gravity: float, earth_up: float
) -> Iterator[str]:
    """Findings of the estimate, in sentences."""
    force, gyro, held = solution.accelerometer, solution.gyro, solution.positions
    up = held.force - force.parameters[:3]
    up = up / np.linalg.norm(up, axis=1, keepdims=True)
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
        yield "the acceleration sensitivities include the Earth's rate along the vertical, up to 15 deg/h at 1 g"
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
