"""Missions of a spec in the core's terms, and the part of their error that is the unit's own noise."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.contract_rows import finite
from gradcal_jax.api.imu_build import BuiltImu
from gradcal_jax.files.contracts import MissionRow
from gradcal_jax.files.requirement import MissionHeadingRequirement, NorthRequirement, Requirement
from gradcal_jax.information import Posterior
from gradcal_jax.information.missions import Flight, mission_contrasts, mission_rows, own_variance
from gradcal_jax.model import AXIS_NAMES, Channel
from gradcal_jax.trajectory import EARTH_RATE

# Number of points of a curve in a figure.
_CURVE = 61
# The sensor's clock is the same in the calibration and in the mission: the calibration's part counts it.
_NOT_OWN = ("sample clock", "turn-on bias")


def earth_gain(requirement: NorthRequirement) -> float:
    """Error of north (rad) for an error of the rate (rad/s) of a gyro that points east, at the latitude."""
    return 1.0 / (EARTH_RATE * float(np.cos(float(requirement.latitude))))


def flights_of(requirement: MissionHeadingRequirement) -> list[tuple[Flight, float]]:
    """The missions, and the time (s) in each at which the requirement applies."""
    flights = []
    for mission in requirement.mission:
        time, rate, temperature, _ = (np.array(column) for column in mission.rows)
        flights.append((Flight(time, rate, temperature), float(requirement.after or time[-1])))
    return flights


def own_noise(built: BuiltImu, channel: Channel, flight: Flight, time: float) -> dict[str, float]:
    """Standard deviation of a gyro's integrated rate (rad) at `time` (s) in a mission, by source of its own noise.

    Where a calibration estimates the bias, two turn-on biases count: that of its run, which is in the map, and that
    of the mission. A rate random walk counts from the mission's beginning.
    """
    model, gyro = channel.model, built.spec.sensor.gyro
    assert gyro is not None
    deviations = {"angle random walk": float(model.angle_random_walk) * time**0.5}
    for name, members in built.sources["gyro"].items():
        if name not in _NOT_OWN:
            deviations[name] = own_variance(flight, model.processes, members, time) ** 0.5
    if gyro.turn_on_bias:
        deviations["turn-on bias"] = float(gyro.turn_on_bias) * time * (1.0 if gyro.bias is None else 2.0**0.5)
    return deviations


class OwnNoise(NamedTuple):
    """A gyro's own noise in a requirement (deg): in total, by source, and of each mission."""

    total: float
    sources: dict[str, float]
    missions: tuple[float, ...]


def own_noise_of(built: BuiltImu, requirement: Requirement) -> OwnNoise | None:
    """The noise in a heading or north (deg) that no calibration removes, the same for every gyro; over several missions
    the weighted root mean square, or the maximum. None for a requirement on anything else."""
    gyro = next((c for c in built.model.channels if c.kind == "gyro"), None)
    if gyro is None:
        return None
    if isinstance(requirement, NorthRequirement):
        time = float(requirement.after)
        still = Flight(np.array([0.0, time]), np.zeros(2), np.zeros(2))
        by_source = [own_noise(built, gyro, still, time)]
        factor, share = float(np.degrees(earth_gain(requirement))) / time, np.ones(1)
    elif isinstance(requirement, MissionHeadingRequirement):
        by_source = [own_noise(built, gyro, flight, time) for flight, time in flights_of(requirement)]
        factor, share = float(np.degrees(1.0)), np.array([mission.weight for mission in requirement.mission])
    else:
        return None
    table = factor * np.array([list(one.values()) for one in by_source])
    each = np.sqrt(np.sum(table**2, axis=1))
    share = np.eye(len(each))[np.argmax(each)] if requirement.statistic == "max" else share / share.sum()
    together = np.sqrt(share @ table**2)
    sources = dict(zip(by_source[0], map(float, together), strict=True))
    return OwnNoise(float(np.sqrt(np.sum(together**2))), sources, tuple(map(float, each)))


def mission_table(requirement: MissionHeadingRequirement, left: np.ndarray, own: OwnNoise) -> tuple[MissionRow, ...]:
    """Every mission with the error that the calibration leaves, `left` `(n,)` (deg), and its own noise."""
    rows = zip(requirement.mission, flights_of(requirement), left, own.missions, strict=True)
    return tuple(
        MissionRow(file=mission.file, weight=mission.weight, after_s=time, left=finite(value), own=noise)
        for mission, (_, time), value, noise in rows
    )


class ErrorCurve(NamedTuple):
    """The error of the integrated rate (deg, 1σ) at times (s) of a mission, `(n,)` each: `left` by the calibration, and
    the unit's own noise."""

    file: str
    time: np.ndarray
    left: np.ndarray
    own: np.ndarray


def error_curves(
    built: BuiltImu, known: Posterior, requirement: MissionHeadingRequirement
) -> list[tuple[str, ErrorCurve]]:
    """The error of each mission over time for each required gyro, by the name of its axis."""
    curves: list[tuple[str, ErrorCurve]] = []
    for channel in built.model.channels:
        axis = AXIS_NAMES[channel.axis]
        if channel.kind != "gyro" or requirement.axis not in ("all", "worst", axis):
            continue
        where = built.model.where(channel.kind, channel.axis)
        part = Posterior(known.spread[where], known.hidden[where])
        for mission, (flight, end) in zip(requirement.mission, flights_of(requirement), strict=True):
            at = np.linspace(0.0, end, _CURVE)[1:]
            left = mission_contrasts(channel.model, mission_rows(channel.model, flight, at)).left(part)
            own = [np.linalg.norm(list(own_noise(built, channel, flight, float(time)).values())) for time in at]
            pair = (np.degrees(np.concatenate([[0.0], values])) for values in (left, own))
            curves.append((axis, ErrorCurve(mission.file, np.concatenate([[0.0], at]), *pair)))
    return curves
