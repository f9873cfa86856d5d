"""Physics of the simulated devices: a chamber with a load, and a rotary axis. Time never goes back."""

import math
import threading
from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.formulas import lag_filter

Floats = NDArray[np.float64]
# How an uncontrolled temperature wavers.
_WAVERS_K, _WAVES_S = 0.7, 210.0


@dataclass(frozen=True)
class ChamberTruth:
    """True properties of a chamber. Rates in K/min, as in its data sheet; first-order air, first-order load."""

    start_c: float = 23.0
    ambient_c: float = 23.0
    heating_k_per_min: float = 2.9
    cooling_k_per_min: float = 1.7
    air_time_constant_s: float = 40.0
    load_time_constant_s: float = 240.0
    idle_time_constant_s: float = 2400.0


class ChamberPlant:
    """Air temperature follows the moving set point within the rates; the load follows the air."""

    _LONGEST_STEP_S = 1.0

    def __init__(self, truth: ChamberTruth, start_s: float = 0.0) -> None:
        self.truth = truth
        self.conditioning = False
        self._air_c = self._load_c = truth.start_c
        self._target_c = self._set_point_c = truth.ambient_c
        # 0: the set point does not move by itself.
        self._gradient_k_per_s = 0.0
        self._times_s, self._loads_c = [start_s], [truth.start_c]
        self._lock = threading.RLock()

    def command(self, now_s: float, *, target_c: float, gradient_k_per_min: float | None = None) -> None:
        """New target; with a gradient the set point moves there continuously, else it jumps."""
        self.advance(now_s)
        self._target_c = target_c
        if gradient_k_per_min is None:
            self._gradient_k_per_s, self._set_point_c = 0.0, target_c
        else:
            self._gradient_k_per_s = abs(gradient_k_per_min) / 60.0

    def move_set_point(self, now_s: float, set_point_c: float) -> None:
        self.advance(now_s)
        self._set_point_c = set_point_c

    def switch(self, now_s: float, conditioning: bool) -> None:
        self.advance(now_s)
        self.conditioning = conditioning

    def air_c(self, now_s: float) -> float:
        self.advance(now_s)
        return self._air_c

    def set_point_c(self, now_s: float) -> float:
        self.advance(now_s)
        return self._set_point_c

    def load_at(self, times_s: Floats) -> Floats:
        """Temperature of the load at recent times, `(n,) -> (n,)`."""
        with self._lock:
            self.advance(float(times_s[-1]))
            first = max(bisect(self._times_s, times_s[0]) - 1, 0)
            return np.interp(times_s, self._times_s[first:], self._loads_c[first:])

    def advance(self, now_s: float) -> None:
        with self._lock:
            while (time_s := self._times_s[-1]) < now_s:
                step = min(self._LONGEST_STEP_S, now_s - time_s)
                self._step(step)
                self._times_s.append(time_s + step)
                self._loads_c.append(self._load_c)
            if len(self._times_s) > 4000:
                del self._times_s[:2000], self._loads_c[:2000]

    def _step(self, step: float) -> None:
        truth, way = self.truth, self._target_c - self._set_point_c
        self._set_point_c += math.copysign(min(abs(way), self._gradient_k_per_s * step), way)
        if self.conditioning:
            change = (self._set_point_c - self._air_c) * -math.expm1(-step / truth.air_time_constant_s)
            lowest, highest = -truth.cooling_k_per_min / 60.0 * step, truth.heating_k_per_min / 60.0 * step
            self._air_c += min(max(change, lowest), highest)
        else:
            self._air_c += (truth.ambient_c - self._air_c) * -math.expm1(-step / truth.idle_time_constant_s)
        self._load_c += (self._air_c - self._load_c) * -math.expm1(-step / truth.load_time_constant_s)


class UncontrolledRoom:
    """A temperature that nobody controls, about a course (s, °C) that somebody tries to follow: late and wavering."""

    def __init__(self, times_s: Sequence[float], course_c: Sequence[float], start_s: float, lag_s: float) -> None:
        times = np.arange(0.0, times_s[-1] + 1.0)
        aim = np.interp(times, times_s, course_c) + _WAVERS_K * np.sin(2.0 * np.pi * times / _WAVES_S)
        self._times, self._values = times + start_s, Mass(aim[0], lag_s).take(aim, 1.0)

    def load_at(self, times_s: Floats) -> Floats:
        return np.interp(times_s, self._times, self._values)


class Mass:
    """A thermal mass that follows a temperature with a time constant, and has been long at a first one."""

    def __init__(self, temperature_c: float, time_s: float) -> None:
        self._time_s, self._given, self._own = time_s, temperature_c, temperature_c

    def take(self, temperature_c: Floats, period_s: float) -> Floats:
        """Its temperatures `(n,)` at consecutive ones that it follows, linear in between."""
        numerator, denominator = lag_filter(period_s, self._time_s)
        state = np.array([numerator[1] * self._given - denominator[1] * self._own])
        result = filtered(numerator, denominator, temperature_c, state)
        self._given, self._own = float(temperature_c[-1]), float(result[-1])
        return result


def filtered(numerator: Any, denominator: Any, values: Floats, state: Floats) -> Floats:
    """A recursive filter along the first axis. SciPy's signals take their time to load."""
    from scipy import signal  # pyright: ignore[reportMissingTypeStubs]

    return signal.lfilter(numerator, denominator, values, axis=0, zi=state)[0]  # pyright: ignore


@dataclass(frozen=True)
class AxisTruth:
    """True properties of a rotary axis.

    The encoder reads the true angle plus a repeatable error (`harmonics`: order, cosine and sine part in deg) plus an
    offset drawn at every standstill plus white noise; the time of each reading is off by `timing_error_s`, one sigma. A
    constant rate has a relative error of `rate_accuracy`, drawn for each command, which the encoder does not see: it
    counts at the commanded rate, and keeps the difference in angle until the axis is homed.

    Encoder and controller are at the motor: the axis itself turns by less than they count, by a relative `scale_error`,
    and after each reversal it stands until the `backlash_deg` of its gear is taken up.
    """

    harmonics: tuple[tuple[int, float, float], ...] = ()
    standstill_offset_deg: float = 0.0
    reading_noise_deg: float = 0.0
    timing_error_s: float = 0.0
    rate_accuracy: float = 0.0
    scale_error: float = 0.0
    backlash_deg: float = 0.0
    seed: int = 0


class AxisPlant:
    """Piecewise constant acceleration, as by a motion controller with trapezoids.

    Motion that the sensor has sampled does not change: a command that a busy computer delayed takes effect after the
    sensor's last sample.
    """

    def __init__(self, truth: AxisTruth | None = None, start_s: float = 0.0) -> None:
        self.truth = truth or AxisTruth()
        self._random = np.random.default_rng(self.truth.seed)
        self._offset_deg, self._known_until_s = 0.0, -math.inf
        self._lock = threading.RLock()
        self.set_zero(start_s)

    def set_zero(self, now_s: float, position_deg: float = 0.0) -> None:
        """Stand still at `position_deg` from now on (the end of homing)."""
        # Phases: start (s), angle (deg), rate and acceleration of the motor, and where the axis itself stands, within
        # half of its backlash.
        self._phases = np.array([[now_s, position_deg, 0.0, 0.0, position_deg]])
        # The last spin: its start, the excess angle by then, and the fraction of excess.
        self._spun = (0.0, 0.0, 0.0)

    def position(self, times_s: Floats) -> Floats:
        """True angle of the axis itself, deg, unwrapped: `(n,) -> (n,)`."""
        with self._lock:
            self._known_until_s = max(self._known_until_s, float(times_s[-1]))
            return self._at(times_s, self._phases)[2] * (1.0 - self.truth.scale_error)

    def state(self, now_s: float) -> tuple[float, float]:
        """Angle and rate of the motor."""
        position, rate, _ = self._at(np.array([now_s]), self._phases)
        return float(position[0]), float(rate[0])

    @property
    def ends_s(self) -> float:
        return float(self._phases[-1, 0])

    def moving(self, now_s: float) -> bool:
        return now_s < self.ends_s or bool(self._phases[-1, 2])

    def reading(self, now_s: float) -> float:
        truth, random = self.truth, self._random
        late_s = truth.timing_error_s * float(random.standard_normal()) if truth.timing_error_s else 0.0
        position, _ = self.state(now_s - late_s)
        turned = math.radians(position)
        error = sum(c * math.cos(order * turned) + s * math.sin(order * turned) for order, c, s in truth.harmonics)
        if not self.moving(now_s):
            error += self._offset_deg
        return position - self._too_far(position) + error + truth.reading_noise_deg * float(random.standard_normal())

    def spin(self, now_s: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Go to a constant rate and stay there; with rate 0 a controlled stop."""
        self._command(now_s, None, rate_dps, acceleration_dps2)

    def move_to(self, now_s: float, target_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Trapezoid (or triangle) to an angle; a motion under way is stopped first."""
        self._command(now_s, target_deg, rate_dps, acceleration_dps2)

    def turn_by_hand(self, begins_s: float, target_deg: float, lasts_s: float) -> None:
        """A turn from standstill in a time, of which the ramps at both ends are a quarter each."""
        way_deg = abs(target_deg - self.state(begins_s)[0])
        rate_dps = max(way_deg, 1e-9) / (0.75 * lasts_s)
        self.move_to(begins_s, target_deg, rate_dps, rate_dps / (0.25 * lasts_s))

    def _command(self, now_s: float, target_deg: float | None, rate_dps: float, acceleration_dps2: float) -> None:
        with self._lock:
            begins_s = now_s = max(now_s, self._known_until_s)
            position, rate = self.state(now_s)
            wanted = 0.0 if target_deg is not None else self._held(position, rate_dps)
            phases: list[tuple[float, ...]] = []
            if rate != wanted:
                phases.append((now_s, position, rate, math.copysign(acceleration_dps2, wanted - rate)))
                lasts_s = abs(wanted - rate) / acceleration_dps2
                now_s, position = now_s + lasts_s, position + (rate + wanted) / 2.0 * lasts_s
            if target_deg is not None:
                self._held(position, 0.0)
                target_deg += self._too_far(position)
                way = target_deg - position
                peak = min(rate_dps, math.sqrt(abs(way) * acceleration_dps2))
                if peak > 0.0:
                    up, cruise = peak / acceleration_dps2, abs(way) / peak - peak / acceleration_dps2
                    sign = math.copysign(1.0, way)
                    ramp, slope = 0.5 * peak * up * sign, sign * acceleration_dps2
                    phases.append((now_s, position, 0.0, slope))
                    phases.append((now_s + up, position + ramp, sign * peak, 0.0))
                    phases.append((now_s + up + cruise, target_deg - ramp, sign * peak, -slope))
                    now_s, position = now_s + up + cruise + up, target_deg
            phases.append((now_s, position, wanted, 0.0))
            self._offset_deg = self.truth.standstill_offset_deg * float(self._random.standard_normal())
            table = self._phases
            rows = [table[table[:, 0] < begins_s][-100:]]
            for phase in phases:
                stands = self._at(np.array([phase[0]]), table)[2]
                rows.append(np.array([[*phase, *stands]]))
                table = np.concatenate(rows)
            self._phases = table

    def _held(self, position_deg: float, rate_dps: float) -> float:
        error = self.truth.rate_accuracy * float(self._random.standard_normal()) if rate_dps else 0.0
        self._spun = (position_deg, self._too_far(position_deg), error / (1.0 + error))
        return rate_dps * (1.0 + error)

    def _too_far(self, position_deg: float) -> float:
        """The true angle of a spinning axis less the encoder's, deg."""
        began_deg, before_deg, share = self._spun
        return before_deg + share * (position_deg - began_deg)

    def _at(self, times_s: Floats, phases: Floats) -> tuple[Floats, Floats, Floats]:
        """Angle and rate of the motor, and angle of the axis behind its backlash."""
        number = np.clip(np.searchsorted(phases[:, 0], times_s, side="right") - 1, 0, None)
        start, begun, rate, slope, axis = phases[number].T
        after = np.maximum(times_s - start, 0.0)
        motor = begun + rate * after + 0.5 * slope * after**2
        if not self.truth.backlash_deg:
            return motor, rate + slope * after, motor
        # A phase may reverse once, where its rate is zero.
        turns = np.clip(-rate / np.where(slope == 0.0, np.inf, slope), 0.0, after)
        farthest = begun + rate * turns + 0.5 * slope * turns**2
        half = 0.5 * self.truth.backlash_deg
        for reached in (farthest, motor):
            axis = np.clip(axis, reached - half, reached + half)
        return motor, rate + slope * after, axis
