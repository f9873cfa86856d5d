"""Further faults, as the lists beside it: of the computer's clock, of rows on their way into the file, of columns."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from fault_list import (
    AXIS,
    AXIS_FULL,
    BEYOND_T,
    CLOCK,
    DROPPED,
    EVENT,
    FILTER,
    FROZEN,
    INSTABILITY,
    LAG,
    NOISE,
    SIGN,
    SLIP,
    STILL,
    TABLE,
    UNIT,
    UNIT_FULL,
    Fault,
    also,
    chain,
    encoders,
    later,
    of_first,
    rows,
    values,
)
from fault_scenes import Scene
from physics_log import DEG, DEG_H, PPM, G, Recorded

_WRONG_COLUMN = r"column|unit|sign|times the input"
_KELVIN = r"in K\b|outside the (chamber|plan)"


def quartz(r: Recorded) -> Recorded:
    """The sensor's clock has a crystal cut for watches, slow by 0.035 ppm/K² away from 25 °C."""
    error = -0.035e-6 * (r.temperature - 25.0) ** 2
    return replace(r, time=r.time + np.cumsum(error * np.diff(r.time, prepend=r.time[0])))


def with_host(edit: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[Scene], None]:
    """A change of the computer's stamps, of the time and of them."""

    def change(r: Recorded) -> Recorded:
        assert r.host is not None
        return replace(r, host=edit(r.time, r.host))

    return rows(change)


def growing_force(r: Recorded) -> Recorded:
    """The scale factor of the first accelerometer grows by 500 ppm in the run."""
    growth = 500 * PPM * (r.time - r.time[0]) / (r.time[-1] - r.time[0])
    return replace(r, values=r.values * (1.0 + growth[:, None] * (np.arange(r.values.shape[1]) == 3)))


def telegraph(r: Recorded) -> Recorded:
    """The first gyro's bias jumps by 40 deg/h to and fro, once a minute on average."""
    odd = np.cumsum(np.random.default_rng(5).random(len(r.time)) < (r.time[1] - r.time[0]) / 60.0) % 2
    return replace(r, values=r.values + (40 * DEG_H * (odd - 0.5))[:, None] * (np.arange(r.values.shape[1]) == 0))


def flexing(r: Recorded) -> Recorded:
    """The body leans by 0.3 mrad for each g across its z axis."""
    rates, force = r.values[:, :3], r.values[:, 3:]
    lean = 0.3e-3 / G * np.stack([force[:, 1], -force[:, 0], 0.0 * force[:, 0]], axis=1)
    return replace(r, values=r.values - np.concatenate([np.cross(lean, rates), np.cross(lean, force)], axis=1))


def tilting(r: Recorded) -> Recorded:
    """The base tilts by 0.3 mrad about the outer axis, slowly."""
    tilt, spin = r.angles.T
    y = -0.3e-3 * G * (r.time - r.time[0]) / r.time[-1]
    more = [np.sin(spin) * np.cos(tilt) * y, np.cos(spin) * np.cos(tilt) * y, -np.sin(tilt) * y]
    return replace(r, values=r.values + np.stack([*([0.0 * y] * 3), *more], axis=1))


def stale(r: Recorded) -> Recorded:
    """Ten seconds of samples are those of the ten seconds before."""
    held = r.values.copy()
    held[60000:60500] = held[59500:60000]
    return replace(r, values=held)


def one_late(r: Recorded) -> Recorded:
    """Each standstill has the angle of the one before."""
    angles, number = r.angles.copy(), np.unique(r.stands[r.stands >= 0])
    means = [r.angles[r.stands == k].mean(axis=0) for k in number]
    for k, before in zip(number[1:], means, strict=False):
        angles[r.stands == k] = before
    return replace(r, angles=angles)


def delayed(seconds: float) -> Callable[[Recorded], Recorded]:
    """The temperature is that of so long ago."""

    def change(r: Recorded) -> Recorded:
        return replace(r, temperature=np.interp(r.time - seconds, r.time, r.temperature))

    return change


def dead(r: Recorded) -> Recorded:
    """The thermometer shows 25 °C and its noise."""
    return replace(r, temperature=25.0 + 0.01 * np.random.default_rng(1).standard_normal(len(r.time)))


def by_attitude(r: Recorded) -> Recorded:
    """A g-sensitivity that changes by 10 deg/h/g over 40 K, of the first gyro."""
    more = 10 * DEG_H * (r.temperature - 20.0) / 40.0 * r.values[:, 5] / G
    return replace(r, values=r.values + more[:, None] * (np.arange(6) == 0))


def _kept(r: Recorded, kept: np.ndarray, time: np.ndarray) -> Recorded:
    return Recorded(time, r.values[kept], r.temperature[kept], r.angles[kept], r.stands[kept])


def minute_lost(r: Recorded) -> Recorded:
    kept = (r.time <= 1190.0) | (r.time >= 1260.0)
    return _kept(r, kept, r.time[kept])


def counted(r: Recorded) -> Recorded:
    """Two hundred rows are lost, and the stamps count those that are left."""
    kept = np.ones(len(r.time), bool)
    kept[np.random.default_rng(3).integers(0, len(kept), 200)] = False
    return _kept(r, kept, r.time[: int(kept.sum())])


def trending(r: Recorded) -> Recorded:
    """A scale factor that grows by 200 ppm in the run."""
    more = 200e-6 * (r.time - r.time[0]) / r.time[-1]
    return replace(r, values=r.values * (1.0 + more[:, None] * (np.arange(r.values.shape[1]) == 0)))


def unpowered(r: Recorded) -> Recorded:
    """Gyro y says nothing any more from half an hour on."""
    return replace(r, values=np.where((r.time > 1800.0)[:, None] & (np.arange(6) == 1), 0.0, r.values))


def dead_band(v: np.ndarray) -> np.ndarray:
    return np.where((np.arange(v.shape[1]) == 0) & (np.abs(v) < 0.02 * DEG), 0.0, v)


_OF_BOTH = (
    ("the computer's clock is set by 0.5 s", CLOCK,
     also(chain(host=2e-4), with_host(lambda t, h: h + 0.5 * (t > 1200.0))), True),
    ("the computer's clock 200 ppm off", CLOCK, also(chain(host=2e-4), with_host(lambda t, h: 1.0002 * h)), True),
    ("a watch's crystal, host time in the log", CLOCK, also(chain(host=2e-4), rows(quartz)), True),
    ("time in milliseconds", _WRONG_COLUMN, rows(lambda r: replace(r, time=1000.0 * r.time)), False),
    ("ten seconds of an old buffer", rf"{EVENT}|{FROZEN}|{_WRONG_COLUMN}", rows(stale), False),
    ("angles late by one standstill", rf"{SLIP}|{_WRONG_COLUMN}", rows(one_late), False),
    ("a whole turn slips", rf"{SLIP}|do not agree|readings of the table", encoders(slip=(1214.0, 360.0)), False),
    ("low-pass of 8 Hz", FILTER, chain(low_pass=8.0), False),
    ("a minute is lost", DROPPED, rows(minute_lost), True),
    ("200 rows lost, stamps counted", rf"{DROPPED}|{NOISE}", rows(counted), False),
    ("a scale factor grows by 200 ppm", INSTABILITY, rows(trending), False),
    ("dead band of 0.02 deg/s", rf"{NOISE}|repeat", values(dead_band), False),
    ("another sensor from the middle on", EVENT, later(1200.0, of_first(1.002, 100 * DEG_H)), False),
)  # fmt: skip
FURTHER: tuple[Fault, ...] = (
    *(Fault(name, scene, words, change, always=always)
      for name, words, change, always in _OF_BOTH for scene in (AXIS_FULL, UNIT_FULL)),
    Fault("the computer's clock is set by 0.5 s", AXIS, CLOCK, _OF_BOTH[0][2], always=True),
    Fault("the computer's clock 200 ppm off", AXIS, CLOCK, _OF_BOTH[1][2], always=True),
    Fault("a watch's crystal", AXIS, CLOCK, rows(quartz)),
    Fault("a watch's crystal, host time in the log", UNIT, CLOCK, _OF_BOTH[2][2], always=True),
    Fault("a random telegraph of 40 deg/h", AXIS_FULL, NOISE, rows(telegraph)),
    Fault("a random telegraph of 40 deg/h", UNIT, NOISE, rows(telegraph)),
    Fault("a random telegraph of 40 deg/h", UNIT_FULL, NOISE, rows(telegraph)),
    Fault("a body that leans by 0.3 mrad/g", UNIT, NOISE, rows(flexing)),
    Fault("a body that leans by 0.3 mrad/g", UNIT_FULL, NOISE, rows(flexing)),
    Fault("the base tilts by 0.3 mrad in the run", UNIT, rf"{TABLE}|{NOISE}", rows(tilting)),
    Fault("the base tilts by 0.3 mrad in the run", UNIT_FULL, rf"{TABLE}|{NOISE}", rows(tilting)),
    Fault("temperatures 120 s late", AXIS_FULL, rf"{LAG}|{NOISE}", rows(delayed(120.0))),
    Fault("temperatures 120 s late", UNIT_FULL, rf"{LAG}|{NOISE}", rows(delayed(120.0))),
    Fault("the thermometer is dead", AXIS, rf"{BEYOND_T}|thermometer|{NOISE}", rows(dead)),
    Fault("the thermometer is dead", UNIT, rf"{BEYOND_T}|thermometer|{NOISE}", rows(dead)),
    Fault("temperatures in K", AXIS, _KELVIN, rows(lambda r: replace(r, temperature=r.temperature + 273.15))),
    Fault("temperatures in tenths", AXIS, _KELVIN, rows(lambda r: replace(r, temperature=10.0 * r.temperature))),
    Fault("angles in turns", AXIS, _WRONG_COLUMN, rows(lambda r: replace(r, angles=r.angles / (2.0 * np.pi)))),
    Fault("angles of a gear of two", AXIS, _WRONG_COLUMN, rows(lambda r: replace(r, angles=2.0 * r.angles))),
    Fault("all accelerometers with the wrong sign", UNIT_FULL, SIGN, values(lambda v: v * [1, 1, 1, -1, -1, -1])),
    Fault("all gyros with the wrong sign", UNIT_FULL, SIGN, values(lambda v: v * [-1, -1, -1, 1, 1, 1])),
    Fault("g-sensitivity over temperature, 10 deg/h/g", UNIT_FULL, NOISE, rows(by_attitude)),
    Fault("gyro y dies", UNIT, rf"{FROZEN}|{BEYOND_T}", rows(unpowered)),
    Fault("gyro y dies", UNIT_FULL, rf"{FROZEN}|{BEYOND_T}", rows(unpowered)),
    Fault("every other standstill is not marked", AXIS, rf"{STILL}|{NOISE}|{BEYOND_T}|of the plan",
          rows(lambda r: replace(r, stands=np.where(r.stands % 2 == 1, -1, r.stands)))),
)  # fmt: skip

# What no log can show: it must be said all the same.
UNSEEN: tuple[Fault, ...] = (
    # 70 ppm at -20 degC, where the spec says 5 and no other clock is in the log.
    Fault("a watch's crystal", AXIS_FULL, r"does not compare the sensor's clock", rows(quartz)),
    # Neither is a change over time on a ramp in one direction other than one over temperature.
    Fault(
        "an accelerometer's scale factor grows by 500 ppm",
        UNIT_FULL,
        r"one-way ramp.*drift",
        rows(growing_force),
        False,
    ),
)
