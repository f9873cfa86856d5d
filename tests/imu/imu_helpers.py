"""Whole units for the tests: tables, plans and channels in plain numbers, and what the program predicts of them."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gradcal_jax import model
from gradcal_jax import motion as trajectory
from gradcal_jax.information import Posterior, posterior
from gradcal_jax.information.plan_information import imu_information
from gradcal_jax.model import SCALE_FACTOR, Channel, EncoderNoise, ImuModel, Polynomial, make_map
from gradcal_jax.motion import Geometry, TableMotion

DEG = np.pi / 180.0
DEG_PER_H = DEG / 3600.0
ARCSEC = DEG / 3600.0
G = 9.80665
LATITUDE = 32.7 * DEG
GYRO_WHITE = 0.15 * DEG / 60.0
FORCE_WHITE = 0.05 / 60.0
EAST, _, UP = np.eye(3)
CONSTANT = Polynomial(0, 0.0, 1.0)
EXPERIMENTS = Path(__file__).parents[2] / "experiments" / "imu"


def shipped(name: str) -> dict[str, Any]:
    """The document of a spec in experiments/imu."""
    return tomllib.loads((EXPERIMENTS / f"{name}.toml").read_text(encoding="utf-8"))


# --- plans ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """A rest (`axis` −1) of `duration`, or a turn of `axis` by `angle` with cosine ramps (rad, rad/s, rad/s²)."""

    axis: int
    duration: float = 0.0
    angle: float = 0.0
    peak: float = 300.0 * DEG
    acceleration: float = 400.0 * DEG
    mounting: int = 0

    @property
    def move(self) -> trajectory.Move:
        if self.axis < 0:
            return trajectory.rest(self.duration, read_at_end=True)
        peak, ramp, duration = cosine_ramps(self.angle, self.peak, self.acceleration)
        if self.duration:
            # A turn that lasts so long, a third of it each ramp.
            ramp, duration = self.duration / 3.0, self.duration
            peak = abs(self.angle) / (duration - ramp)
        return trajectory.turn("cosine ramps", np.copysign(peak, self.angle), duration, ramp=ramp)


def cosine_ramps(angle: float, peak: float, acceleration: float) -> tuple[float, float, float]:
    """Peak rate, ramp and duration of a turn as quick as may be: θ = A(D − r), peak acceleration πA/2r."""
    size = abs(angle)
    top = min(peak, np.sqrt(2.0 * size * acceleration / np.pi))
    ramp = 0.5 * np.pi * top / acceleration
    return top, ramp, max(size / top + ramp, 2.0 * ramp)


def rest(duration: float) -> Step:
    return Step(-1, duration)


def turn(axis: int, degrees: float, peak: float = 300.0, duration: float = 0.0) -> Step:
    return Step(axis, duration, degrees * DEG, peak * DEG)


def poses(angles: Sequence[Sequence[float]], dwell: float, *, move: float = 0.0) -> list[Step]:
    """Rests of `dwell` at poses (an angle of each axis, degrees), the first where the table begins.

    `move`: how long the way from one to the next takes, shared among its axes; else as quick as 90 deg/s allow.
    """
    steps = [rest(dwell)]
    for before, goal in pairwise(angles):
        turned = [(k, b - a) for k, (a, b) in enumerate(zip(before, goal, strict=True)) if abs(b - a) > 1e-9]
        steps += [*(turn(k, by, 90.0, move / len(turned)) for k, by in turned), rest(dwell)]
    return steps


def up_along(directions) -> list[tuple[float, float]]:
    """Poses of `two_axes` (tilt, spin in degrees) with which directions of the body point up; the spin goes on from
    pose to pose the short way.
    """
    found: list[tuple[float, float]] = []
    for direction in directions:
        x, y, z = np.asarray(direction, float) / np.linalg.norm(direction)
        tilt, spin = np.degrees(np.arccos(np.clip(z, -1.0, 1.0))), np.degrees(np.arctan2(x, y))
        if found:
            spin += 360.0 * np.round((found[-1][1] - spin) / 360.0)
        found.append((float(tilt), float(spin)))
    return found


def back_and_forth(axis: int, dwell: float, degrees: float = 1800.0) -> list[Step]:
    return [turn(axis, degrees), rest(dwell), turn(axis, -degrees), rest(dwell)]


# Points of temperature along a piece, and the highest order of an encoder's harmonic.
POINTS = 6
_HARMONICS = 6


def two_axes(kind: type[Geometry] = Geometry) -> Geometry:
    """Outer axis along East, inner one along the body's z, which points up at zero."""
    return table(EAST, UP, kind=kind)


def table(*axes, kind: type[Geometry] = Geometry) -> Geometry:
    return kind(np.array(axes, float), np.eye(3), np.eye(3)[None], np.asarray(LATITUDE), np.asarray(G))


def motion_of(
    geometry: Geometry, steps: Sequence[Step], *, start=None, temperature: tuple[float, float] = (20.0, 0.0)
) -> TableMotion:
    """The steps once; `temperature`: °C at the beginning, and K/s. `start` in degrees."""
    moves = tuple(step.move for step in steps)
    course = trajectory.programme(temperature[0], [(sum(m.duration for m in moves), temperature[1])])
    schedule = trajectory.gradient_plan(course, moves, read_every=None)
    number = np.asarray(schedule.pieces.move)
    begin = np.zeros(geometry.axis_count) if start is None else np.asarray(start, float) * DEG
    return trajectory.table_motion(
        schedule.trajectory(),
        np.array([step.axis for step in steps])[number],
        np.array([step.mounting for step in steps])[number],
        geometry,
        begin,
        _HARMONICS,
    )


# --- units ------------------------------------------------------------------------------------------------------------

AXES = "xyz"


def _signal(symbol: str, signals: tuple[str, ...], unit: str, std: float, basis=CONSTANT) -> model.Map:
    return make_map(basis, name=symbol, symbol=symbol, unit=unit, signals=signals, prior_std=std)


def _drifts(drift) -> model.Processes:
    processes = model.no_processes()
    for sigma, tau in drift:
        processes += model.gauss_markov(sigma, tau)
    return processes


def gyro(
    axis: int,
    terms: str = "b s m g",
    *,
    white: float = GYRO_WHITE,
    drift=(),
    instability=(),
    std: dict[str, float] | None = None,
    basis=CONSTANT,
    rate_basis=CONSTANT,
) -> Channel:
    """A gyro with the given `terms`; flat priors but for `std` by symbol (`b`, `s`, `m`, `g`)."""
    prior, others = dict.fromkeys("bsmg", np.inf) | (std or {}), [o for o in AXES if o != AXES[axis]]
    named: dict[str, Any] = {"name": SCALE_FACTOR, "symbol": "b", "unit": "1", "signals": (f"rate {AXES[axis]}",)}
    of = {
        "b": [make_map(basis, numbered=True, prior_std=prior["b"])],
        "s": [make_map(basis, rate_basis, prior_std=prior["s"], **named)],
        "m": [_signal(f"m_{o}", (f"rate {o}",), "rad", prior["m"], basis) for o in others],
        "g": [_signal(f"g_{o}", (f"force {o}",), "rad/s/(m/s^2)", prior["g"]) for o in AXES],
    }
    chosen = [term for symbol in terms.split() for term in of[symbol]]
    processes = _drifts(drift)
    for sigma, tau in instability:
        processes += model.gauss_markov(sigma, tau, bias_gain=0.0, rate_gain=1.0)
    return Channel(tuple(chosen), np.asarray(white), processes, "gyro", axis)


def accelerometer(
    axis: int,
    terms: str = "b s m",
    *,
    white: float = FORCE_WHITE,
    drift=(),
    std: dict[str, float] | None = None,
    basis=CONSTANT,
) -> Channel:
    """An accelerometer with the given `terms`: `b`, `s`, `m`, `k2`."""
    prior, others = dict.fromkeys(("b", "s", "m", "k2"), np.inf) | (std or {}), [o for o in AXES if o != AXES[axis]]
    along = f"force {AXES[axis]}"
    of = {
        "b": [_signal("b", (), "m/s^2", prior["b"], basis)],
        "s": [_signal("s", (along,), "1", prior["s"], basis)],
        "m": [_signal(f"m_{o}", (f"force {o}",), "rad", prior["m"], basis) for o in others],
        "k2": [_signal("k2", (along, along), "1/(m/s^2)", prior["k2"])],
    }
    chosen = [term for symbol in terms.split() for term in of[symbol]]
    return Channel(tuple(chosen), np.asarray(white), _drifts(drift), "accelerometer", axis)


def encoder(count: int, offset: float = 0.0, reading: float = 0.0, every: float = 1.0) -> EncoderNoise:
    return EncoderNoise(*(np.full(count, value) for value in (offset, reading, every)))


def unit(channels, installation=(), noise: EncoderNoise | None = None, axes: int = 2) -> ImuModel:
    return ImuModel(tuple(channels), tuple(installation), encoder(axes) if noise is None else noise)


def known(motion: TableMotion, of: ImuModel) -> Posterior:
    """The program's posterior."""
    return posterior(imu_information(motion, of, trajectory.body_nodes(motion, POINTS))[0])


def sigmas(motion: TableMotion, of: ImuModel) -> dict[str, float]:
    """Standard deviations of all reported parameters by name (SI)."""
    found = known(motion, of).deviations(of.to_reported)
    return dict(zip(of.names(), (float(v) for v in found), strict=True))
