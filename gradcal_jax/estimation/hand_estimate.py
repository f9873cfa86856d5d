"""The calibration of a unit from a log of many positions at rest, turned by hand between them; no table, no spec."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gradcal_jax.calibration.file import (
    FORMAT,
    ORDER,
    CalibratedChannel,
    CalibratedTerm,
    Calibration,
    Covariance,
    Noise,
    build_term,
)
from gradcal_jax.estimation.calibration_rows import fit_rows, provenance_of, rows_of_estimate
from gradcal_jax.estimation.hand import KINDS_OF_ROWS, LOWER, ByHand, HandRows, find_positions, solve_by_hand
from gradcal_jax.estimation.log_rows import Options, bridged_temperature, time_of
from gradcal_jax.model import AXIS_NAMES, KINDS
from gradcal_jax.records.log import Log, LogError
from gradcal_jax.records.signal_checks import quiet_windows, refuse_unlike_noise, without_faults
from gradcal_jax.tables.display import summary
from gradcal_jax.tables.quantity import Quantity
from gradcal_jax.units import DEG_PER_H, G

_FRAME = "the accelerometers' own: x along accelerometer x, y in the plane of accelerometers x and y"
_GYRO_RATE = {"degree": 0, "scale": "300 deg/s"}
# Rows that may be missing in a turn: their rates are between those beside them.
_BRIDGED = 2
# Least part of gravity along an axis, up and down, of some position.
_HELD = 0.5
NAMES = (
    *(f"accelerometer_{a}.a" for a in AXIS_NAMES),
    *(f"accelerometer_{AXIS_NAMES[j]}." + ("s" if j == l else f"m_{AXIS_NAMES[l]}") for j, l in LOWER),
    *(
        f"gyro_{a}.{symbol}"
        for a in AXIS_NAMES
        for symbol in (*("b00" if a == b else f"m_{b}" for b in AXIS_NAMES), "a", *(f"g_{b}" for b in AXIS_NAMES))
    ),
)
"""Names of the coefficients in a calibration file, in the order of the solution."""


class HandReport(NamedTuple):
    """The estimate of one unit, with sentences to read before it is used."""

    unit: str
    solution: ByHand
    calibration: Calibration
    messages: tuple[str, ...]

    __repr__ = summary

    @property
    def as_wished(self) -> bool:
        """Whether every parameter is observable and every test passed."""
        return not self.calibration.unobservable and all(test.passed for test in self.solution.tests.values())

    @property
    def gravity_left(self) -> float:
        """Root mean square of |f| − g over the positions, m/s²."""
        return float(np.sqrt(np.mean(self.solution.left[0] ** 2)))

    @property
    def turns_left(self) -> float:
        """Root mean square error of gravity's direction after a turn, in each of two directions across it, rad."""
        return float(np.sqrt(np.mean(self.solution.left[1] ** 2)))


def estimate_by_hand(
    log: Log,
    gravity: float,
    *,
    units: Sequence[str] = (),
    temperature_c: float | None = None,
    sources: dict[str, str] | None = None,
) -> list[HandReport]:
    """The calibration of every unit in `units` (default: all) from a log of many positions, by `gravity` (m/s²): see
    `gradcal_jax.estimation.hand`.

    `temperature_c`: of a log without a thermometer; `sources`: names of files, for the provenance. Returns reports with
    a `calibration` (SI), the tests, residuals of gravity (m/s²) and of the turns (rad), and `messages`.

    Errors: `LogError` where the log lacks what the estimate needs.
    """
    if not gravity > 0.0:
        raise ValueError(f"gravity is {gravity:g} m/s²: it must be positive")
    return [_report(log, name, gravity, temperature_c, sources or {}) for name in units or log.units]


def _report(log: Log, name: str, gravity: float, temperature_c: float | None, sources: dict[str, str]) -> HandReport:
    channels = [f"{kind} {axis}" for kind in KINDS for axis in AXIS_NAMES]
    values = log.channels(name)
    missing = [of for of in channels if of not in values or not np.isfinite(values[of]).any()]
    if missing:
        raise LogError(
            f"the log has no {', '.join(missing)}: gravity calibrates three gyros by three accelerometers, along axes "
            "named x, y, z (in a column map: [rate] and [force])"
        )
    messages: list[str] = []
    for of in channels:
        messages += refuse_unlike_noise(f"{of} of {name}", quiet_windows(values[of]).ravel())
    log, faults = without_faults(log)
    messages += faults[name].sentences
    rows, temperature, words = _rows(log, name, temperature_c)
    try:
        solution = solve_by_hand(rows, gravity)
    except ValueError as error:
        raise LogError(f"{name}: {error}") from None
    calibration = _calibration(solution, rows, temperature, log, name)
    origin = f"norm of gravity ({gravity:.9g} m/s^2) and its direction after {solution.turns} turns"
    calibration = calibration.model_copy(update={"provenance": provenance_of([log], name, sources, estimator=origin)})
    found = _findings(solution, calibration.unobservable, gravity)
    return HandReport(name, solution, calibration, (*messages, *words, *found))


def _rows(log: Log, name: str, temperature_c: float | None) -> tuple[HandRows, np.ndarray, list[str]]:
    """The usable rows of a unit with their temperatures (°C), and messages. The rates of rows after a gap of one or two
    are means with the row before. Raises `LogError` where no row has both triads."""
    time, messages = time_of(log, Options())
    both = np.concatenate(log.triads(name), axis=1)
    usable = log.usable(name) & np.isfinite(both).all(axis=1)
    if not usable.any():
        raise LogError(
            f"{name}: no row has both rates and specific forces: are gyros and accelerometers in separate rows? "
            "Write interpolate = true in the column map, or join the two streams first"
        )
    both, apart = both[usable], np.diff(time[usable], prepend=-np.inf) / log.sample_interval_s
    begins = np.zeros(len(time), bool)
    begins[log.stretch_starts] = True
    late = apart > 1.5
    broken = (apart > _BRIDGED + 1.5) | (begins[usable] & ~late)
    bridged = np.flatnonzero(late & ~broken)
    both[bridged] = 0.5 * (both[bridged] + both[bridged - 1])
    if len(bridged):
        messages.append(f"{len(bridged)} gaps of one or two rows are bridged")
    rates, force = both[:, :3], both[:, 3:]
    if log.standstill is not None:
        standing = log.standstill[usable]
    else:
        try:
            standing = find_positions(rates, force, log.sample_interval_s)
        except ValueError as error:
            raise LogError(f"{name}: {error}") from None
        count = int(standing.max()) + 1
        messages.append(f"the log marks no standstills: {count} were detected where rates and forces are steady")
    rows = HandRows(time[usable], rates, force, broken, standing)
    return rows, bridged_temperature(log, log.unit_index(name), temperature_c)[usable], messages


def _calibration(solution: ByHand, rows: HandRows, temperature: np.ndarray, log: Log, name: str) -> Calibration:
    """The calibration of a unit at the temperatures (°C) and rates between its first and its last standstill."""
    held = solution.positions
    between = slice(int(held.rows[0, 0]), int(held.rows[-1, 1]) + 1)
    warm, table = temperature[between], solution.parameters[9:30].reshape(3, 7)
    true = (rows.rates[between] - table[:, 3]) / (1.0 + np.diag(table[:, :3]))
    fastest = float(np.radians(np.ceil(np.degrees(np.max(np.abs(true))))))
    ends = np.floor(warm.min() * 10.0) / 10.0, np.ceil(warm.max() * 10.0) / 10.0
    covered: dict[str, Any] = {
        "valid_temperature": tuple(Quantity.of(float(t), "degC") for t in ends),
        "valid_rate": (Quantity.of(-fastest, "rad/s"), Quantity.of(fastest, "rad/s")),
    }
    values, matrix = _coefficients(solution)
    hidden = solution.hidden[: len(NAMES)]
    density = lambda noise, unit: Quantity.of(float(np.sqrt(np.mean(noise))), unit)  # noqa: E731
    return Calibration(
        format=FORMAT,
        title=f"calibration of {name} by hand",
        serial_number=name,
        simulated=log.simulated,
        frame=_FRAME,
        order=ORDER,
        channel=tuple(
            CalibratedChannel(kind=kind, axis=a, term=tuple(_terms(kind, a, values)), **covered)
            for kind in KINDS
            for a in AXIS_NAMES
        ),
        covariance=Covariance(
            names=tuple(np.array(NAMES)[~hidden].tolist()),
            matrix=tuple(map(tuple, matrix[np.ix_(~hidden, ~hidden)].tolist())),
        ),
        fit=fit_rows(solution.tests.items()),
        unobservable=tuple(np.array(NAMES)[hidden].tolist()),
        noise=Noise(
            angle_random_walk=density(held.rate_noise, "rad/s/sqrt(Hz)"),
            velocity_random_walk=density(held.force_noise, "m/s^2/sqrt(Hz)"),
            sample_rate=Quantity.of(1.0 / log.sample_interval_s, "Hz"),
        ),
    )


def _coefficients(solution: ByHand) -> tuple[dict[str, float], np.ndarray]:
    """All coefficients by their names in a calibration file, and their covariance, in SI. A misalignment is an element
    of I + E over that on its diagonal, which multiplies it."""
    values, slopes = solution.parameters[: len(NAMES)].copy(), np.eye(len(NAMES), len(solution.parameters))
    for row, name in enumerate(NAMES):
        channel, _, symbol = name.partition(".")
        if symbol.startswith("m_"):
            diagonal = NAMES.index(f"{channel}.b00" if channel.startswith("gyro") else f"{channel}.s")
            values[row] /= 1.0 + solution.parameters[diagonal]
            slopes[row, diagonal] = -values[row]
            slopes[row] /= 1.0 + solution.parameters[diagonal]
    return dict(zip(NAMES, values.tolist(), strict=True)), slopes @ solution.covariance @ slopes.T


def _terms(kind: str, axis: str, values: dict[str, float]) -> Iterator[CalibratedTerm]:
    """The terms of a channel."""
    signal, unit = ("rate", "rad/s") if kind == "gyro" else ("force", "m/s^2")
    kinds = {
        "a": ("bias", unit, ()),
        "s": ("scale_factor", "1", (f"force {axis}",)),
        "b00": ("scale_factor", "1", (f"rate {axis}",)),
    }
    kinds |= {f"m_{b}": (f"misalignment_{b}", "rad", (f"{signal} {b}",)) for b in AXIS_NAMES}
    kinds |= {f"g_{b}": (f"g_sensitivity_{b}", "rad/s/(m/s^2)", (f"force {b}",)) for b in AXIS_NAMES}
    for symbol, (called, si, signals) in kinds.items():
        if (value := values.get(f"{kind}_{axis}.{symbol}")) is not None:
            bases = {"rate": _GYRO_RATE} if symbol == "b00" else {}
            yield build_term(called, si, signals, {symbol: value}, **bases)


def _findings(solution: ByHand, unseen: Sequence[str], gravity: float) -> Iterator[str]:
    """Findings of the estimate, in sentences."""
    held = solution.positions
    up = (held.force - solution.parameters[:3]) / gravity
    for k, a in enumerate(AXIS_NAMES):
        for words, most in (("up", up[:, k].max()), ("down", -up[:, k].min())):
            if most < _HELD:
                yield f"axis {a} was never held within 60° of {words}"
    if unseen:
        yield f"not observable: {', '.join(unseen)}; for these, the file has the values of an ideal IMU"
    advice = (
        f"|f| - g differs between positions by {np.std(solution.left[0]) / G * 1e6:.3g} µg: was the IMU at rest, and "
        "are its errors proportional to the force?",
        f"gravity's direction after a turn errs by {np.std(solution.left[1]) * 1e6:.3g} µrad: the gyros have errors "
        "other than scale factor, misalignment and acceleration sensitivity, or the IMU moved during a standstill",
        f"the gyros' rates at rest differ by {np.std(solution.left[2]) * DEG_PER_H:.3g} deg/h, probably by drift",
    )
    for kind, factor, words in zip(KINDS_OF_ROWS, solution.factors, advice, strict=True):
        if not solution.tests[kind].passed:
            yield f"{words}. This is {factor:.3g} times the noise, and the covariance includes it"
    yield "the acceleration sensitivities include the Earth's rate along the vertical, up to 15 deg/h at 1 g"
    yield f"the accelerometers' scale factors are no more accurate than the stated gravity, {gravity:.6g} m/s²"


def hand_estimate_rows(report: HandReport) -> dict[str, Any]:
    """All numbers of an estimate for another program."""
    return rows_of_estimate(
        report.calibration,
        report.messages,
        positions=len(report.solution.positions.duration),
        turns=report.solution.turns,
        gravity_rms_m_per_s2=report.gravity_left,
        turns_rms_rad=report.turns_left,
    )
