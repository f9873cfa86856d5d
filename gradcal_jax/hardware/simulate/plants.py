"""Physics of the simulated devices: a chamber with a load, and a rotary axis. Time never goes back."""

import math
import threading
from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.formulas import lag_filter

Floats = NDArray[np.float64]
# How an uncontrolled temperature wavers.
_WAVERS_K, _WAVES_S = 0.7, 210.0
_KNOTS_BY_HAND = 25


def decayed(driving: Floats, keep: Floats | float, begun: Floats | float) -> Floats:
    """`x[k] = keep · x[k - 1] + driving[k]` along the last axis, after `begun`: sums of twice as many, and so on."""
    states, reach = driving.copy(), 1
    states[..., :1] += keep * begun
    while reach < states.shape[-1]:
        states[..., reach:] += keep * states[..., :-reach]
        reach, keep = 2 * reach, keep * keep
    return states


class Mass:
    """A thermal mass that follows a temperature with a time constant, and has been long at a first one."""

    def __init__(self, temperature_c: float, time_s: float) -> None:
        self._time_s, self._given, self._own = time_s, temperature_c, temperature_c

    def take(self, temperature_c: Floats, period_s: float) -> Floats:
        """Its temperatures `(n,)` at consecutive ones that it follows, linear in between."""
        (share, before), (_, lost) = lag_filter(period_s, self._time_s)
        given = np.concatenate([[self._given], temperature_c])
        own = decayed(share * given[1:] + before * given[:-1], -lost, self._own)
        self._given, self._own = float(given[-1]), float(own[-1])
        return own


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
        self.air_c = self._load_c = truth.start_c
        self.set_point_c = self._target_c = truth.ambient_c
        # 0: the set point does not move by itself.
        self._gradient_k_per_s = 0.0
        self._times_s, self._loads_c = [start_s], [truth.start_c]
        self._lock = threading.RLock()

    def command(self, now_s: float, *, target_c: float, gradient_k_per_min: float | None = None) -> None:
        """New target; with a gradient the set point moves there continuously, else it jumps."""
        self.at(now_s)._target_c = target_c
        self._gradient_k_per_s = abs(gradient_k_per_min or 0.0) / 60.0
        if gradient_k_per_min is None:
            self.set_point_c = target_c

    def load_at(self, times_s: Floats) -> Floats:
        """Temperature of the load at recent times, `(n,) -> (n,)`."""
        with self._lock:
            self.at(float(times_s[-1]))
            first = max(bisect(self._times_s, times_s[0]) - 1, 0)
            return np.interp(times_s, self._times_s[first:], self._loads_c[first:])

    def at(self, now_s: float) -> "ChamberPlant":
        """The same plant, at that time: its air, set point and state can be read and set."""
        with self._lock:
            while (time_s := self._times_s[-1]) < now_s:
                step_s = min(self._LONGEST_STEP_S, now_s - time_s)
                self._step(step_s)
                self._times_s.append(time_s + step_s)
                self._loads_c.append(self._load_c)
            if len(self._times_s) > 4000:
                del self._times_s[:2000], self._loads_c[:2000]
        return self

    def _step(self, step_s: float) -> None:
        truth, way_k = self.truth, self._target_c - self.set_point_c
        self.set_point_c += math.copysign(min(abs(way_k), self._gradient_k_per_s * step_s), way_k)
        if self.conditioning:
            change_k = (self.set_point_c - self.air_c) * _share(step_s, truth.air_time_constant_s)
            lowest_k, highest_k = -truth.cooling_k_per_min / 60.0 * step_s, truth.heating_k_per_min / 60.0 * step_s
            self.air_c += min(max(change_k, lowest_k), highest_k)
        else:
            self.air_c += (truth.ambient_c - self.air_c) * _share(step_s, truth.idle_time_constant_s)
        self._load_c += (self.air_c - self._load_c) * _share(step_s, truth.load_time_constant_s)


def _share(step_s: float, time_constant_s: float) -> float:
    """Of its distance, how much a first-order lag goes in a step."""
    return -math.expm1(-step_s / time_constant_s)


class UncontrolledRoom:
    """A temperature that nobody controls, about a course (s, °C) that somebody tries to follow: late and wavering."""

    def __init__(self, times_s: Sequence[float], course_c: Sequence[float], start_s: float, lag_s: float) -> None:
        times = np.arange(0.0, times_s[-1] + 1.0)
        aim = np.interp(times, times_s, course_c) + _WAVERS_K * np.sin(2.0 * np.pi * times / _WAVES_S)
        self._times, self._values = times + start_s, Mass(aim[0], lag_s).take(aim, 1.0)

    def load_at(self, times_s: Floats) -> Floats:
        return np.interp(times_s, self._times, self._values)


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
        self._phases: list[tuple[float, ...]] = [(now_s, position_deg, 0.0, 0.0, position_deg)]
        # The last spin: its start, the excess angle by then, and the fraction of excess.
        self._spun = (0.0, 0.0, 0.0)

    def position(self, times_s: Floats) -> Floats:
        """True angle of the axis itself, deg, unwrapped: `(n,) -> (n,)`."""
        with self._lock:
            self._known_until_s = max(self._known_until_s, float(times_s[-1]))
            return self._axis(times_s) * (1.0 - self.truth.scale_error)

    def state(self, now_s: float) -> tuple[float, float]:
        """Angle and rate of the motor."""
        with self._lock:
            start_s, begun, rate, slope, _ = self._since(now_s)[0]
        after_s = max(now_s - start_s, 0.0)
        return begun + rate * after_s + 0.5 * slope * after_s**2, rate + slope * after_s

    @property
    def ends_s(self) -> float:
        return self._phases[-1][0]

    def moving(self, now_s: float) -> bool:
        return now_s < self.ends_s or bool(self._phases[-1][2])

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
        with self._lock:
            now_s = max(now_s, self._known_until_s)
            position, rate = self.state(now_s)
            wanted = self._held(position, rate_dps)
            # A phase does not reverse.
            changes = [-rate, wanted] if rate * wanted < 0.0 else [wanted - rate]
            parts = [(abs(change) / acceleration_dps2, math.copysign(acceleration_dps2, change)) for change in changes]
            self._follow(now_s, parts, wanted)

    def move_to(self, now_s: float, target_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        """Trapezoid (or triangle) to an angle; a motion under way is stopped first."""
        with self._lock:
            now_s = max(now_s, self._known_until_s)
            position, rate = self.state(now_s)
            stop_s = abs(rate) / acceleration_dps2
            parts = [(stop_s, math.copysign(acceleration_dps2, -rate))]
            position += 0.5 * rate * stop_s
            self._held(position, 0.0)
            way = target_deg + self._too_far(position) - position
            peak = min(rate_dps, math.sqrt(abs(way) * acceleration_dps2))
            if peak > 0.0:
                ramp_s, slope = peak / acceleration_dps2, math.copysign(acceleration_dps2, way)
                parts += [(ramp_s, slope), (abs(way) / peak - ramp_s, 0.0), (ramp_s, -slope)]
            self._follow(now_s, parts, 0.0, position + way)

    def turn_by_hand(self, now_s: float, target_deg: float, lasts_s: float) -> None:
        """From standstill to an angle: the plans' shape "hand", uneven by 30 %, in pieces of constant acceleration."""
        with self._lock:
            now_s = max(now_s, self._known_until_s)
            knots = np.linspace(0.0, 1.0, _KNOTS_BY_HAND)
            rates = (1.0 - np.cos(2.0 * np.pi * knots)) * (1.0 + 0.3 * np.sin(6.0 * np.pi * knots))
            piece_s = lasts_s / (_KNOTS_BY_HAND - 1)
            # The integral of the rates, linear between the knots, is the turn.
            rates *= (target_deg - self.state(now_s)[0]) / (piece_s * float(np.sum(rates)))
            self._follow(now_s, [(piece_s, slope) for slope in (np.diff(rates) / piece_s).tolist()], 0.0, target_deg)

    def _follow(
        self, now_s: float, parts: list[tuple[float, float]], final_dps: float, ends_deg: float | None = None
    ) -> None:
        """Accelerate from now on: for a time (s) and by so much, one after the other; then keep a rate."""
        self._offset_deg = self.truth.standstill_offset_deg * float(self._random.standard_normal())
        begun = *self.state(now_s), float(self._axis(np.array([now_s]))[0])
        self._phases = [phase for phase in self._phases[-100:] if phase[0] < now_s]
        for lasts_s, slope in parts:
            if lasts_s > 0.0:
                position, rate, axis = begun
                self._phases.append((now_s, position, rate, slope, axis))
                now_s += lasts_s
                begun = *self.state(now_s), float(self._axis(np.array([now_s]))[0])
        position, _, axis = begun
        self._phases.append((now_s, position if ends_deg is None else ends_deg, final_dps, 0.0, axis))

    def _held(self, position_deg: float, rate_dps: float) -> float:
        error = self.truth.rate_accuracy * float(self._random.standard_normal()) if rate_dps else 0.0
        self._spun = (position_deg, self._too_far(position_deg), error / (1.0 + error))
        return rate_dps * (1.0 + error)

    def _too_far(self, position_deg: float) -> float:
        """The true angle of a spinning axis less the encoder's, deg."""
        began_deg, before_deg, share = self._spun
        return before_deg + share * (position_deg - began_deg)

    def _since(self, time_s: float) -> list[tuple[float, ...]]:
        """The phase of a time, and those after it."""
        return self._phases[max(bisect(self._phases, (time_s, math.inf)) - 1, 0) :]

    def _axis(self, times_s: Floats) -> Floats:
        """Angles of the axis behind its backlash."""
        first, *later = self._since(float(times_s[0]))
        angles = self._axis_in(first, times_s)
        for phase in later:
            if phase[0] <= times_s[-1]:
                angles = np.where(times_s < phase[0], angles, self._axis_in(phase, times_s))
        return angles

    def _axis_in(self, phase: tuple[float, ...], times_s: Floats) -> Floats:
        start_s, begun, rate, slope, axis = phase
        after_s = np.maximum(times_s - start_s, 0.0)
        motor = begun + rate * after_s + 0.5 * slope * after_s**2
        half = 0.5 * self.truth.backlash_deg
        return np.clip(axis, motor - half, motor + half) if half else motor
