"""Missions of a spec in the core's terms, and the part of their error that is the unit's own noise."""

from typing import NamedTuple

import numpy as np

from gradcal_jax.api.build import Assembled
from gradcal_jax.api.contract_rows import finite
from gradcal_jax.files.contracts import MissionRow
from gradcal_jax.files.requirement import HeadingRequirement, NorthRequirement, Requirement
from gradcal_jax.information import Posterior
from gradcal_jax.information.missions import Flight, mission_contrasts, mission_rows, own_variance
from gradcal_jax.trajectory import EARTH_RATE

# Number of points of a curve in a figure.
_CURVE = 61
# The sensor's clock is the same in the calibration and in the mission: the calibration's part counts it.
_NOT_OWN = ("sample clock", "turn-on bias")


def earth_gain(requirement: NorthRequirement) -> float:
    """Error of north (rad) for an error of the rate (rad/s) of a gyro that points east, at the latitude."""
    return 1.0 / (EARTH_RATE * float(np.cos(float(requirement.latitude))))


def flights_of(requirement: HeadingRequirement) -> list[tuple[Flight, float]]:
    """The missions, and the time (s) in each at which the requirement applies."""
    flights = []
    for mission in requirement.mission:
        time, rate, temperature, _ = (np.array(column) for column in mission.rows)
        flights.append((Flight(time, rate, temperature), float(requirement.after or time[-1])))
    return flights


def own_noise(built: Assembled, flight: Flight, time: float) -> dict[str, float]:
    """Standard deviation of the integrated rate (rad) at `time` (s) in a mission, by source of the unit's own noise.

    Where a calibration estimates the bias, two turn-on biases count: that of its run, which is in the map, and that
    of the mission. A rate random walk counts from the mission's beginning.
    """
    model, sensor = built.model, built.spec.sensor
    deviations = {"angle random walk": float(model.angle_random_walk) * time**0.5}
    for name, members in built.sources.items():
        if name not in _NOT_OWN:
            deviations[name] = own_variance(flight, model.processes, members, time) ** 0.5
    if sensor.turn_on_bias:
        deviations["turn-on bias"] = float(sensor.turn_on_bias) * time * (1.0 if sensor.bias is None else 2.0**0.5)
    return deviations


class OwnNoise(NamedTuple):
    """The unit's own noise in a requirement (deg): in total, by source, and of each mission."""

    total: float
    sources: dict[str, float]
    missions: tuple[float, ...]


def own_noise_of(built: Assembled, requirement: Requirement) -> OwnNoise | None:
    """The noise in a heading or north (deg) that no calibration removes; over several missions the weighted root mean
    square, or the maximum. None for a requirement on a map."""
    if isinstance(requirement, NorthRequirement):
        time = float(requirement.after)
        still = Flight(np.array([0.0, time]), np.zeros(2), np.zeros(2))
        by_source = [own_noise(built, still, time)]
        factor, share = float(np.degrees(earth_gain(requirement))) / time, np.ones(1)
    elif isinstance(requirement, HeadingRequirement):
        by_source = [own_noise(built, flight, time) for flight, time in flights_of(requirement)]
        factor, share = float(np.degrees(1.0)), np.array([mission.weight for mission in requirement.mission])
    else:
        return None
    table = factor * np.array([list(one.values()) for one in by_source])
    each = np.sqrt(np.sum(table**2, axis=1))
    share = np.eye(len(each))[np.argmax(each)] if requirement.statistic == "max" else share / share.sum()
    together = np.sqrt(share @ table**2)
    sources = dict(zip(by_source[0], map(float, together), strict=True))
    return OwnNoise(float(np.sqrt(np.sum(together**2))), sources, tuple(map(float, each)))


def mission_table(requirement: HeadingRequirement, left: np.ndarray, own: OwnNoise) -> tuple[MissionRow, ...]:
    """Every mission with the error that the calibration leaves, `left` (deg), and its own noise."""
    rows = zip(requirement.mission, flights_of(requirement), left.ravel(), own.missions, strict=True)
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


def error_curves(built: Assembled, known: Posterior, requirement: HeadingRequirement) -> list[ErrorCurve]:
    """The error of each mission over time."""
    curves = []
    for mission, (flight, end) in zip(requirement.mission, flights_of(requirement), strict=True):
        at = np.linspace(0.0, end, _CURVE)[1:]
        left = mission_contrasts(built.model, mission_rows(built.model, flight, at)).left(known)
        own = [np.linalg.norm(list(own_noise(built, flight, float(time)).values())) for time in at]
        pair = (np.degrees(np.concatenate([[0.0], values])) for values in (left, own))
        curves.append(ErrorCurve(mission.file, np.concatenate([[0.0], at]), *pair))
    return curves
