"""Physics of the simulated devices: a chamber with a load, and a rotary axis. Time never goes back."""

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
        self._time_s = start_s
        self._air_c = self._load_c = truth.start_c
        self._target_c = self._set_point_c = truth.ambient_c
        self._gradient_k_per_s: float | None = None
        self._history: list[tuple[float, float]] = [(start_s, truth.start_c)]
        self._lock = threading.RLock()

    def command(self, now_s: float, *, target_c: float, gradient_k_per_min: float | None = None) -> None:
        """New target; with a gradient the set point moves there continuously, else it jumps."""
        with self._lock:
            self.advance(now_s)
            self._target_c = target_c
            self._gradient_k_per_s = None if gradient_k_per_min is None else abs(gradient_k_per_min) / 60.0
            if gradient_k_per_min is None:
                self._set_point_c = target_c

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

    def load_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Temperature of the load at recent times, `(n,) -> (n,)`."""
        with self._lock:
            self.advance(float(times_s[-1]))
            recent = 4
            while recent < len(self._history) and self._history[-recent][0] > times_s[0]:
                recent *= 2
            history = np.array(self._history[-recent:])
            return np.interp(times_s, history[:, 0], history[:, 1])

    def advance(self, now_s: float) -> None:
        with self._lock:
            while self._time_s < now_s:
                step = min(self._LONGEST_STEP_S, now_s - self._time_s)
                self._step(step)
                self._time_s += step
                self._history.append((self._time_s, self._load_c))
            if len(self._history) > 4000:
                del self._history[:2000]

    def _step(self, step: float) -> None:
        truth = self.truth
        if self._gradient_k_per_s is not None:
            way = self._target_c - self._set_point_c
            self._set_point_c += math.copysign(min(abs(way), self._gradient_k_per_s * step), way)
        if self.conditioning:
            change = (self._set_point_c - self._air_c) * -math.expm1(-step / truth.air_time_constant_s)
            lowest, highest = -truth.cooling_k_per_min / 60.0 * step, truth.heating_k_per_min / 60.0 * step
            self._air_c += min(max(change, lowest), highest)
        else:
            self._air_c += (truth.ambient_c - self._air_c) * -math.expm1(-step / truth.idle_time_constant_s)
        self._load_c += (self._air_c - self._load_c) * -math.expm1(-step / truth.load_time_constant_s)


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


class _Phase(NamedTuple):
    start_s: float
    position_deg: float
    rate_dps: float
    acceleration_dps2: float
    axis_deg: float = math.nan
    """Where the axis itself stands at the start, within half of its backlash."""


class UncontrolledRoom:
    """A temperature that nobody controls, about a course (s, °C) that somebody tries to follow: late and wavering."""

    def __init__(self, times_s: Sequence[float], course_c: Sequence[float], start_s: float, lag_s: float) -> None:
        step = 1.0
        self._times = np.arange(0.0, times_s[-1] + 1.0, step)
        aim = np.interp(self._times, times_s, course_c) + _WAVERS_K * np.sin(2.0 * np.pi * self._times / _WAVES_S)
        self._values = np.empty_like(aim)
        value = float(aim[0])
        for k, goal in enumerate(aim):
            value += (float(goal) - value) * -math.expm1(-step / lag_s)
            self._values[k] = value
        self._times += start_s

    def load_at(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(times_s, self._times, self._values)


class AxisPlant:
    """Piecewise constant acceleration, as by a motion controller with trapezoids.

    Motion that the sensor has sampled does not change: a command that a busy computer delayed takes effect after the
    sensor's last sample.
    """

    def __init__(self, truth: AxisTruth | None = None, start_s: float = 0.0) -> None:
        self.truth = truth or AxisTruth()
        self._random = np.random.default_rng(self.truth.seed)
        self._phases = [_Phase(start_s, 0.0, 0.0, 0.0, 0.0)]
        self._table: NDArray[np.float64] | None = None
        self._offset_deg = 0.0
        # The last spin: its start, the excess angle by then, and the fraction of excess.
        self._spun = (0.0, 0.0, 0.0)
        self._known_until_s = -math.inf
        self._lock = threading.RLock()

    def position(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """True angle of the axis itself, deg, unwrapped: `(n,) -> (n,)`."""
        with self._lock:
            self._known_until_s = max(self._known_until_s, float(times_s[-1]))
            return self._at(times_s)[2] * (1.0 - self.truth.scale_error)

    def state(self, now_s: float) -> tuple[float, float]:
        position, rate, _ = self._at(np.array([now_s]))
        return float(position[0]), float(rate[0])

    def _at(self, times_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Angle and rate of the motor, and angle of the axis behind its backlash."""
        with self._lock:
            if self._table is None:
                self._table = np.array(self._phases)
            table = self._table
        row = table[np.clip(np.searchsorted(table[:, 0], times_s, side="right") - 1, 0, None)]
        after = np.maximum(times_s - row[:, 0], 0.0)
        motor = row[:, 1] + row[:, 2] * after + 0.5 * row[:, 3] * after**2
        if not self.truth.backlash_deg:
            return motor, row[:, 2] + row[:, 3] * after, motor
        # A phase may reverse once, where its rate is zero.
        until = -row[:, 2] / np.where(row[:, 3] == 0.0, np.inf, row[:, 3])
        farthest = np.where((until > 0.0) & (until < after), row[:, 1] + 0.5 * row[:, 2] * until, motor)
        axis, half = row[:, 4], 0.5 * self.truth.backlash_deg
        for reached in (farthest, motor):
            axis = np.clip(axis, reached - half, reached + half)
        return motor, row[:, 2] + row[:, 3] * after, axis

    def moving(self, now_s: float) -> bool:
        return now_s < self._phases[-1].start_s or self._phases[-1].rate_dps != 0.0

    def reading(self, now_s: float) -> float:
        truth = self.truth
        late_s = truth.timing_error_s * float(self._random.standard_normal()) if truth.timing_error_s else 0.0
        position, _ = self.state(now_s - late_s)
        turned = math.radians(position)
        error = sum(c * math.cos(order * turned) + s * math.sin(order * turned) for order, c, s in truth.harmonics)
        if not self.moving(now_s):
            error += self._offset_deg
        return (
            position - self._too_far(position) + error + truth.reading_noise_deg * float(self._random.standard_normal())
        )

    def set_zero(self, now_s: float, position_deg: float = 0.0) -> None:
        """Stand still at `position_deg` from now on (the end of homing)."""
        with self._lock:
            self._phases = [_Phase(now_s, position_deg, 0.0, 0.0, position_deg)]
            self._table = None
            self._spun = (0.0, 0.0, 0.0)

    def spin(self, now_s: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Go to a constant rate and stay there; with rate 0 a controlled stop."""
        with self._lock:
            now_s = max(now_s, self._known_until_s)
            position, rate = self.state(now_s)
            phases = self._change(now_s, position, rate, self._held(position, rate_dps), acceleration_dps2)
            self._replace(now_s, phases)

    def move_to(self, now_s: float, target_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Trapezoid (or triangle) to an angle; a motion under way is stopped first."""
        with self._lock:
            now_s = max(now_s, self._known_until_s)
            position, rate = self.state(now_s)
            phases = self._change(now_s, position, rate, 0.0, acceleration_dps2)
            start = phases[-1]
            self._held(start.position_deg, 0.0)
            target_deg += self._too_far(start.position_deg)
            way = target_deg - start.position_deg
            peak = min(rate_dps, math.sqrt(abs(way) * acceleration_dps2))
            if peak > 0.0:
                up, cruise = peak / acceleration_dps2, abs(way) / peak - peak / acceleration_dps2
                sign = math.copysign(1.0, way)
                ramp = 0.5 * peak * up * sign
                begin, down = start.start_s, start.start_s + up + cruise
                phases[-1] = _Phase(begin, start.position_deg, 0.0, sign * acceleration_dps2)
                phases.append(_Phase(begin + up, start.position_deg + ramp, sign * peak, 0.0))
                phases.append(_Phase(down, target_deg - ramp, sign * peak, -sign * acceleration_dps2))
                phases.append(_Phase(down + up, target_deg, 0.0, 0.0))
            self._replace(now_s, phases)

    @property
    def ends_s(self) -> float:
        return self._phases[-1].start_s

    def turn_by_hand(self, begins_s: float, target_deg: float, lasts_s: float) -> None:
        """A turn from standstill in a time, of which the ramps at both ends are a quarter each."""
        way_deg = abs(target_deg - self.state(begins_s)[0])
        rate_dps = max(way_deg, 1e-9) / (0.75 * lasts_s)
        self.move_to(begins_s, target_deg, rate_dps, rate_dps / (0.25 * lasts_s))

    def _held(self, position_deg: float, rate_dps: float) -> float:
        error = self.truth.rate_accuracy * float(self._random.standard_normal()) if rate_dps else 0.0
        self._spun = (position_deg, self._too_far(position_deg), error / (1.0 + error))
        return rate_dps * (1.0 + error)

    def _too_far(self, position_deg: float) -> float:
        """The true angle of a spinning axis less the encoder's, deg."""
        began_deg, before_deg, share = self._spun
        return before_deg + share * (position_deg - began_deg)

    def _change(
        self, now_s: float, position: float, rate: float, wanted: float, acceleration_dps2: float
    ) -> list[_Phase]:
        if rate == wanted:
            return [_Phase(now_s, position, wanted, 0.0)]
        duration = abs(wanted - rate) / acceleration_dps2
        slope = math.copysign(acceleration_dps2, wanted - rate)
        end = position + (rate + wanted) / 2.0 * duration
        return [_Phase(now_s, position, rate, slope), _Phase(now_s + duration, end, wanted, 0.0)]

    def _replace(self, now_s: float, phases: list[_Phase]) -> None:
        self._offset_deg = self.truth.standstill_offset_deg * float(self._random.standard_normal())
        stands = float(self._at(np.array([now_s]))[2][0])
        self._phases = [phase for phase in self._phases if phase.start_s < now_s][-100:]
        for number, phase in enumerate(phases):
            if number:
                stands = float(self._at(np.array([phase.start_s]))[2][0])
            self._phases.append(phase._replace(axis_deg=stands))
            self._table = None
