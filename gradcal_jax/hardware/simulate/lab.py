"""A whole simulated laboratory for a recipe: chamber, table and one sensor, with hidden truth.

Where the spec's table is driven by hand, a person turns it, and types its angles where the plan does not read the axis
at rest; else an encoder is read. The sensor is a STIM300. The seed
draws the true parameters from the spec's priors and the noise from its error model; for a flat prior typical values. A
single table axis points east, where the Earth's rate has no component; with several axes the Earth's rate is zero. The
sensor's mounting is perfect and its structure is the spec's: a `discrepancy` is not drawn.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ...files.bases import RatePolynomial, RateSpline, TemperaturePolynomial, TemperatureSpline
from ...files.bench import Chamber, Table, TableAxis
from ...files.moves import AXES, Axis
from ...files.rig import RigFile, rig_of
from ...files.sensor import TemperatureError
from ...files.spec import Spec
from ...files.tracks import read_at_rest, tracks_of
from ...units import to_unit
from ..clock import Clock
from ..drivers.stim300 import Stim300Config
from ..roles import STANDARD_GRAVITY, AxisLimits
from ..setup import Bench
from .datagrams import RATES_HZ
from .devices import HandTurnedAxis, HangingOperator, SimulatedAxis, SimulatedChamber, SimulatedPerson, SimulatedStream
from .plants import AxisPlant, AxisTruth, ChamberPlant, ChamberTruth
from .sensor import Process, SampledSensor, TruthBasis
from .unit import EARTH_RATE, ErrorTerm, ScaleFactors, SimulatedUnit, TableTruth, TriadTruth, UnitTruth

Triple = tuple[float, float, float]
_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_ALONG: Final[dict[Axis, Triple]] = {"x": _X, "y": _Y, "z": _Z}
# Mountings that point this axis of the sensor east.
_MOUNTED: Final[dict[Axis, tuple[Triple, Triple, Triple]]] = {"x": (_X, _Y, _Z), "y": (_Z, _X, _Y), "z": (_Y, _Z, _X)}
_TYPICAL_BIAS: Final = np.radians(0.02)
_TYPICAL_SCALE: Final = 1000e-6
_SENSOR_NAME: Final = "unit1"
# Bits/s. 2000 datagrams/s of rates, forces and temperatures leave no margin on the usual line.
_BAUDRATE: Final = 921_600
_BAUDRATE_AT_FULL_RATE: Final = 1_843_200
_AXIS_STEP_DEG: Final = 360.0 / 1_152_000
_HAND_STEP_DEG: Final = 0.01
# A plan may use all of its allowed travel: the cable's hard end is this far beyond.
BEYOND_DEG: Final = 2.0


@dataclass(frozen=True)
class HiddenTruth:
    """The true parameters: by sensor axis the paper's names of the coefficients of the spec's bases, SI."""

    sensor: UnitTruth
    axis: AxisTruth
    coefficients: dict[Axis, dict[str, float]]

    def tables(self, axes: tuple[Axis, ...]) -> dict[str, Any]:
        """For a file."""
        return {axis: self.coefficients[axis] for axis in axes} | {"sample_clock_error": self.sensor.clock_error}


def draw_truth(spec: Spec, seed: int) -> HiddenTruth:
    """The hidden parameters of a seed. The turn-on bias is part of `a0`."""
    random = np.random.default_rng([seed, 20261])
    sensor, angle = spec.sensor, spec.rig.table.angle
    bias_basis, bias = TruthBasis(), np.zeros((3, 1))
    if sensor.bias is not None:
        bias_basis = basis_truth(sensor.bias.temperature)
        size = _TYPICAL_BIAS if sensor.bias.prior is None else float(sensor.bias.prior)
        bias = size * random.standard_normal((3, sensor.bias.temperature.size))
    bias[:, 0] += float(sensor.turn_on_bias or 0.0) * random.standard_normal(3)
    temperature_basis, rate_basis, scale = TruthBasis(), TruthBasis(), np.zeros((3, 1, 1))
    if (section := sensor.scale_factor) is not None:
        temperature_basis, rate_basis = basis_truth(section.temperature), basis_truth(section.rate, "deg/s")
        size = _TYPICAL_SCALE if section.prior is None else float(section.prior)
        scale = size * random.standard_normal((3, section.temperature.size, section.rate.size))
    gradient = np.zeros(3)
    if sensor.bias_temperature_gradient is not None:
        unknown = np.radians(1.0) / 60.0 if sensor.gradient_sensitivity is not None else 0.0
        gradient = (sensor.gradient_std or unknown) * random.standard_normal(3)
    gyros = TriadTruth(
        (ErrorTerm(bias[:, None, :], bias_basis, "one"), ScaleFactors(scale, temperature_basis, rate_basis)),
        float(sensor.angle_random_walk),
        float(sensor.rate_random_walk or 0.0),
        processes_of(sensor.drift, sensor.scale_factor_instability, sensor.temperature_error),
        (float(gradient[0]), float(gradient[1]), float(gradient[2])),
    )
    clock_error = float(sensor.sample_clock_error or 0.0) * float(random.standard_normal())
    unit = UnitTruth({"gyro": gyros, "accelerometer": TriadTruth((), 0.0)}, clock_error=clock_error)
    coefficients: dict[Axis, dict[str, float]] = {}
    for row, axis in enumerate(AXES):
        named = {f"a{k}": float(value) for k, value in enumerate(bias[row])}
        named |= {f"b{j}{i}": float(scale[row, i, j]) for i, j in np.ndindex(scale.shape[1:])}
        coefficients[axis] = named | {"gradient": float(gradient[row])}
    travel = float(spec.rig.table.travel)
    limited = None if np.isinf(travel) else float(np.degrees(travel))
    harmonics: list[tuple[int, float, float]] = []
    for harmonic in angle.harmonics:
        cosine, sine = np.degrees(float(harmonic.amplitude)) * random.standard_normal(2)
        harmonics.append((harmonic.order, float(cosine), float(sine)))
    encoder = AxisTruth(
        lowest_deg=None if limited is None else -limited - BEYOND_DEG,
        highest_deg=None if limited is None else limited + BEYOND_DEG,
        harmonics=tuple(harmonics),
        standstill_offset_deg=float(np.degrees(angle.standstill_offset)),
        reading_noise_deg=float(np.degrees(angle.reading_noise)),
        timing_error_s=float(angle.timing_error),
        rate_accuracy=float(spec.rig.table.rate_accuracy or 0.0),
        seed=seed,
    )
    return HiddenTruth(unit, encoder, coefficients)


def processes_of(
    drift: Sequence[Any], instability: Sequence[Any], error: TemperatureError | None
) -> tuple[Process, ...]:
    """The processes of a spec's drifts, scale-factor errors, and error of the measured temperature."""
    biases = (Process(float(d.standard_deviation), float(d.correlation_time), 1.0) for d in drift)
    scales = (Process(float(d.standard_deviation), float(d.correlation_time), 0.0, 1.0) for d in instability)
    if error is None:
        return (*biases, *scales)
    lasts = np.inf if error.correlation_time is None else float(error.correlation_time)
    gains = (float(error.bias_slope or 0.0), float(error.scale_factor_slope or 0.0))
    return (*biases, *scales, Process(float(error.standard_deviation), lasts, *gains))


def basis_truth(section: Any, unit: str = "") -> TruthBasis:
    """A spec's basis of temperatures (°C), or of rates in a unit."""

    def numbers(*values: Any) -> tuple[float, ...]:
        return tuple(to_unit(float(value), unit) if unit else float(value) for value in values)

    if isinstance(section, (TemperaturePolynomial, RatePolynomial)):
        centre, scale = numbers(section.centre, section.scale)
        return TruthBasis("polynomial", section.degree, centre, scale)
    if isinstance(section, (TemperatureSpline, RateSpline)):
        return TruthBasis("b-spline", section.degree, knots=numbers(*section.knots))
    return TruthBasis("bins", knots=numbers(*section.edges))


class SimulatedDevices:
    """Chamber, table and units. `rig` is the rig file, `bench` the open devices."""

    axis_plants: list[AxisPlant]
    rig: RigFile

    def __init__(self, chamber: Chamber, thermal_lag: Any, room_c: float, clock: Clock) -> None:
        truth = ChamberTruth(
            start_c=room_c,
            ambient_c=room_c,
            # A margin beyond the spec's limits.
            heating_k_per_min=1.2 * 60.0 * float(chamber.max_heating),
            cooling_k_per_min=1.2 * 60.0 * float(chamber.max_cooling),
            load_time_constant_s=max(float(thermal_lag or 0.0), 1.0),
        )
        self._clock = clock
        self.chamber_plant = ChamberPlant(truth, clock.now())
        cold, hot = (float(end) for end in chamber.range)
        self.range_c = cold - 5.0, hot + 5.0

    def _connect(
        self,
        axes: Mapping[str, Table | TableAxis],
        sensors: Mapping[str, SampledSensor],
        *,
        by_hand: bool,
        typed: bool,
        hang: Callable[[int], None] | None = None,
        seed: int,
        sample_rate_hz: float,
        burst_s: float,
    ) -> None:
        """Make the devices. Axes may be turned `by_hand`, their angles `typed` or read from an encoder; `hang` hangs
        the units anew, as a numbered mounting."""
        clock = self._clock
        baudrate = _BAUDRATE if sample_rate_hz < RATES_HZ[-1] else _BAUDRATE_AT_FULL_RATE
        settings = {"sample_rate": f"{sample_rate_hz:g} Hz", "baudrate": baudrate}
        table = {"driver": "simulated", "port": "/simulated/table", "safe": "hold", "gravity_loaded": False}
        unit = {"driver": "stim300", "options": settings}
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "simulated", "port": "/simulated/chamber", "safe": "standby"},
            "axis": [{"name": name, **table} for name in axes],
            "imu": [{"name": name, "port": f"/simulated/{name}", **unit} for name in sensors],
        }
        self.rig = rig_of(tables)
        self.bench = Bench(self.rig, SimulatedChamber(self.chamber_plant, clock, *self.range_c), simulated=True)
        for number, (name, says) in enumerate(axes.items()):
            plant, limits = self.axis_plants[number], _limits_of(says, by_hand, typed)
            self.bench.axes[name] = (
                HandTurnedAxis(plant, clock, limits, SimulatedPerson(seed), number)
                if by_hand
                else SimulatedAxis(plant, clock, limits)
            )
        config = Stim300Config(baudrate=baudrate, sample_rate_hz=sample_rate_hz)
        for number, (name, sensor) in enumerate(sensors.items(), start=1):
            self.bench.imus[name] = SimulatedStream(sensor, clock, config, burst_s, f"SIMULATED{number}")
        if hang is not None:
            self.bench.console = HangingOperator(clock, hang)


def _limits_of(says: Table | TableAxis, by_hand: bool, typed: bool) -> AxisLimits:
    """The limits of a table's axis in the spec."""
    rate, acceleration = to_unit(float(says.max_rate), "deg/s"), to_unit(float(says.max_acceleration), "deg/s^2")
    travel = float(np.degrees(float(says.travel)))
    lowest, highest = (None, None) if np.isinf(travel) else (-travel, travel)
    step = _HAND_STEP_DEG if by_hand else _AXIS_STEP_DEG
    hand: dict[str, bool] = {"by_hand": by_hand, "typed": by_hand and typed}
    return AxisLimits(rate, acceleration, lowest, highest, step, hardware_watchdog=False, **hand)


class SimulatedLab(SimulatedDevices):
    """The laboratory for one recipe's spec.

    `burst_s` is how often the sensor's bytes reach the computer; a longer one costs less time. `room_c` is where the
    chamber starts.
    """

    def __init__(
        self,
        spec: Spec,
        clock: Clock,
        *,
        seed: int = 0,
        sample_rate_hz: float = 125.0,
        burst_s: float = 1.0,
        room_c: float = 23.0,
    ) -> None:
        super().__init__(spec.rig.chamber, spec.sensor.thermal_lag, room_c, clock)
        self.truth = draw_truth(spec, seed)
        now, table = clock.now(), spec.rig.table
        self.axes = _axes(spec)
        axis = self.truth.axis
        self.axis_plants = [
            AxisPlant(replace(axis, seed=16 * axis.seed + number), now) for number in range(1, len(self.axes) + 1)
        ]
        several = len(self.axes) > 1
        # On the equator, the table turned about the vertical so far that its axis sees the rate that the spec states.
        along = float(spec.rig.earth_rate or 0.0) / EARTH_RATE
        turned = 0.0 if several or not np.isfinite(along) else float(np.arcsin(np.clip(along, -1.0, 1.0)))
        axis_x = _MOUNTED["x"] if several else _MOUNTED[self.axes[0]]
        bench = TableTruth(
            axes=tuple(_ALONG[axis] for axis in self.axes) if several else (_ALONG["x"],),
            latitude=0.0 if turned else np.radians(45.0),
            gravity=STANDARD_GRAVITY,
            base=(0.0, 0.0, turned),
            mountings=(np.array(axis_x).T,),
            earth_rate=0.0 if several else EARTH_RATE,
        )
        self.sensor = SimulatedUnit(
            self.truth.sensor,
            bench,
            self.chamber_plant,
            self.axis_plants,
            sample_rate_hz=sample_rate_hz,
            seed=seed + 1,
            start_s=now,
        )
        self._connect(
            dict.fromkeys(self.axes, table),
            {_SENSOR_NAME: self.sensor},
            by_hand=table.drive == "hand",
            typed=not read_at_rest(tracks_of(spec)[1]),
            seed=seed,
            sample_rate_hz=sample_rate_hz,
            burst_s=burst_s,
        )

    def truths(self) -> dict[str, Any]:
        """The true parameters, for a file."""
        return self.truth.tables(self.axes)


def _axes(spec: Spec) -> tuple[Axis, ...]:
    turned = {move.axis for block in tracks_of(spec)[1] for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(axis for axis in AXES if axis in turned) or ("x",)
