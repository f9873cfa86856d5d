"""A whole simulated laboratory for a recipe: chamber, table and one sensor, on ports of their own, with hidden truth.

The chamber is an ESPEC, the table a chain of Zaber stages (or, where the spec's table is driven by hand, a gimbal with
an operator who turns it and types its angles), the sensor a STIM300. The seed draws the true parameters from the spec's
priors and the noise from its error model; for a flat prior typical values. A single table axis points east, where the
Earth's rate has no component; with several axes the Earth's rate is zero. The sensor's mounting is perfect and its
structure is the spec's: a `discrepancy` is not drawn.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np

from ...files.bases import RatePolynomial, RateSpline, TemperaturePolynomial, TemperatureSpline
from ...files.bench import Chamber, Table, TableAxis
from ...files.moves import AXES, Axis
from ...files.rig import RigFile, rig_of
from ...files.sensor import Sensor
from ...files.spec import Spec
from ...files.tracks import tracks_of
from ...units import to_unit
from ..clock import Clock
from .espec import EspecOptions, SimulatedEspec
from .operator import OperatorOptions, SimulatedOperator
from .plants import AxisPlant, AxisTruth, ChamberPlant, ChamberTruth
from .port import SimulatedPort
from .sensor import EARTH_RATE_DPS, Mounting, Process, SampledSensor, SensorTruth, SimulatedSensor, Triple, TruthBasis
from .stim300 import RATES_HZ, SimulatedStim300, Stim300Options
from .zaber import SimulatedZaber

_X, _Y, _Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
_ALONG: Final[dict[Axis, Triple]] = {"x": _X, "y": _Y, "z": _Z}
# Mountings that point this axis of the sensor east.
_MOUNTED: Final[dict[Axis, tuple[Triple, Triple, Triple]]] = {"x": (_X, _Y, _Z), "y": (_Z, _X, _Y), "z": (_Y, _Z, _X)}
_TYPICAL_BIAS_DPS: Final = 0.02
_TYPICAL_SCALE: Final = 1000e-6
_SLIPS: Final = 0.02
_SENSOR_NAME: Final = "unit1"
# Bits/s. 2000 datagrams/s of rates, forces and temperatures leave no margin on the usual line.
_BAUDRATE: Final = 921_600
_BAUDRATE_AT_FULL_RATE: Final = 1_843_200
# A plan may use all of its allowed travel: the cable's hard end is this far beyond.
_BEYOND_DEG: Final = 2.0


@dataclass(frozen=True)
class HiddenTruth:
    """The true parameters: coefficients of the spec's bases (monomials for polynomials), in deg/s and as ratios,
    `(3, nT)` and `(3, nT, nω)` by sensor axis."""

    sensor: SensorTruth
    axis: AxisTruth

    def tables(self, axes: tuple[Axis, ...]) -> dict[str, Any]:
        """For a file: the paper's names of coefficients, SI, by sensor axis."""
        tables: dict[str, Any] = {}
        for axis in axes:
            row = AXES.index(axis)
            bias = {f"a{k}": float(np.radians(v)) for k, v in enumerate(self.sensor.bias_dps[row])}
            scale = {
                f"b{rate}{cold}": value
                for cold, values in enumerate(self.sensor.scale_factor[row])
                for rate, value in enumerate(values)
            }
            tables[axis] = bias | scale | {"gradient": float(np.radians(self.sensor.gradient_deg_per_k[row]))}
        return tables | {"sample_clock_error": self.sensor.clock_error}


def draw_truth(spec: Spec, seed: int) -> HiddenTruth:
    """The hidden parameters of a seed. The turn-on bias is part of `a0`."""
    random = np.random.default_rng([seed, 20261])
    sensor, angle = spec.sensor, spec.rig.table.angle
    deg = 180.0 / np.pi
    bias_basis, bias = TruthBasis(), np.zeros((3, 1))
    if sensor.bias is not None:
        bias_basis = basis_truth(sensor.bias.temperature)
        size = _TYPICAL_BIAS_DPS if sensor.bias.prior is None else float(sensor.bias.prior) * deg
        bias = size * random.standard_normal((3, sensor.bias.temperature.size))
    bias[:, 0] += float(sensor.turn_on_bias or 0.0) * deg * random.standard_normal(3)
    temperature_basis, rate_basis, scale = TruthBasis(), TruthBasis(), np.zeros((3, 1, 1))
    if (section := sensor.scale_factor) is not None:
        temperature_basis, rate_basis = basis_truth(section.temperature), basis_truth(section.rate, "deg/s")
        size = _TYPICAL_SCALE if section.prior is None else float(section.prior)
        scale = size * random.standard_normal((3, section.temperature.size, section.rate.size))
    gradient = np.zeros(3)
    if sensor.bias_temperature_gradient is not None:
        unknown = np.radians(1.0) / 60.0 if sensor.gradient_sensitivity is not None else 0.0
        gradient = (sensor.gradient_std or unknown) * deg * random.standard_normal(3)
    truth = SensorTruth(
        bias_dps=tuple(tuple(float(v) for v in row) for row in bias),
        scale_factor=tuple(tuple(tuple(float(v) for v in line) for line in row) for row in scale),
        angle_random_walk_deg_sqrt_s=float(sensor.angle_random_walk) * deg,
        clock_error=float(sensor.sample_clock_error or 0.0) * float(random.standard_normal()),
        processes=_processes(sensor),
        rate_random_walk_dps_sqrt_s=float(sensor.rate_random_walk or 0.0) * deg,
        gradient_deg_per_k=(float(gradient[0]), float(gradient[1]), float(gradient[2])),
        bias_basis=bias_basis,
        temperature_basis=temperature_basis,
        rate_basis=rate_basis,
    )
    travel = float(spec.rig.table.travel)
    limited = None if np.isinf(travel) else float(np.degrees(travel))
    harmonics: list[tuple[int, float, float]] = []
    for harmonic in angle.harmonics:
        cosine, sine = np.degrees(float(harmonic.amplitude)) * random.standard_normal(2)
        harmonics.append((harmonic.order, float(cosine), float(sine)))
    axis = AxisTruth(
        lowest_deg=None if limited is None else -limited - _BEYOND_DEG,
        highest_deg=None if limited is None else limited + _BEYOND_DEG,
        harmonics=tuple(harmonics),
        standstill_offset_deg=float(np.degrees(angle.standstill_offset)),
        reading_noise_deg=float(np.degrees(angle.reading_noise)),
        timing_error_s=float(angle.timing_error),
        rate_accuracy=float(spec.rig.table.rate_accuracy or 0.0),
        seed=seed,
    )
    return HiddenTruth(truth, axis)


def _processes(sensor: Sensor) -> tuple[Process, ...]:
    deg = 180.0 / np.pi
    processes = processes_of(sensor.drift, sensor.scale_factor_instability, deg)
    if (error := sensor.temperature_error) is not None:
        lasts = np.inf if error.correlation_time is None else float(error.correlation_time)
        gains = (float(error.bias_slope or 0.0) * deg, float(error.scale_factor_slope or 0.0))
        processes += (Process(float(error.standard_deviation), float(lasts), *gains),)
    return processes


def processes_of(drift: Sequence[Any], instability: Sequence[Any] = (), unit: float = 1.0) -> tuple[Process, ...]:
    """The processes of a spec's drifts (`unit`: how many of their unit are one SI unit) and scale-factor errors."""
    biases = (Process(float(d.standard_deviation) * unit, float(d.correlation_time), 1.0) for d in drift)
    scales = (Process(float(d.standard_deviation), float(d.correlation_time), 0.0, 1.0) for d in instability)
    return (*biases, *scales)


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
    """Chamber, table and units, each on a port of its own. A context manager; `rig` is the rig file."""

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
        self.chamber = SimulatedEspec(self.chamber_plant, clock, EspecOptions(high_c=hot + 5.0, low_c=cold - 5.0))

    def _connect(
        self,
        axes: Mapping[str, Table | TableAxis],
        operator: SimulatedOperator,
        sensors: Mapping[str, SampledSensor],
        *,
        by_hand: bool,
        hangs: bool = False,
        sample_rate_hz: float,
        burst_s: float,
    ) -> None:
        """Make the ports and the rig file. The operator has a port where axes are turned `by_hand`, by the limits of
        the spec's `axes`, or where the operator `hangs` the units anew."""
        baudrate = _BAUDRATE if sample_rate_hz < RATES_HZ[-1] else _BAUDRATE_AT_FULL_RATE
        options = Stim300Options(baudrate=baudrate, rate_code=RATES_HZ.index(sample_rate_hz), burst_s=burst_s)
        self.imus = {name: SimulatedStim300(sensor, self._clock, options) for name, sensor in sensors.items()}
        self.table: SimulatedZaber | SimulatedOperator
        self.table = operator if by_hand else _chain_of(self.axis_plants, self._clock, axes.values())
        devices = [self.chamber, self.table, *self.imus.values(), *([operator] if hangs and not by_hand else [])]
        self.ports = [SimulatedPort(device, self._clock) for device in devices]
        at_chamber, at_table, *others = (port.url for port in self.ports)
        settings = {"sample_rate": f"{sample_rate_hz:g} Hz", "baudrate": baudrate}
        units = [
            {"name": name, "driver": "stim300", "port": port, "options": settings}
            for name, port in zip(sensors, others, strict=False)
        ]
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "espec", "port": at_chamber, "safe": "standby"},
            "axis": [_axis_table(*axis, at_table, i, by_hand) for i, axis in enumerate(axes.items(), start=1)],
            "imu": units,
        }
        self.rig = rig_of(tables | ({"operator": {"port": others[-1]}} if len(others) > len(sensors) else {}))

    def __enter__(self) -> Self:
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()


def _chain_of(plants: list[AxisPlant], clock: Clock, axes: Iterable[Table | TableAxis]) -> SimulatedZaber:
    chain = SimulatedZaber(plants, clock)
    for stage, says in zip(chain.stages, axes, strict=True):
        if not np.isinf(travel := float(says.travel)):
            reach = round(float(np.degrees(travel)) / 360.0 * stage.settings["limit.cycle.dist"])
            stage.settings |= {"limit.min": -reach, "limit.max": reach}
    return chain


def _axis_table(name: str, says: Table | TableAxis, port: str, number: int, by_hand: bool) -> dict[str, Any]:
    """The rig file's table of an axis: a stage on a chain, or turned by hand."""
    limits = {"max_rate": str(says.max_rate), "max_acceleration": str(says.max_acceleration)}
    if by_hand and not np.isinf(float(says.travel)):
        limits["travel"] = str(says.travel)
    device = {"name": name, "driver": "operator" if by_hand else "zaber", "port": port, "safe": "hold"}
    return device | {"gravity_loaded": False, "options": limits if by_hand else {"device": number, **limits}}


class SimulatedLab(SimulatedDevices):
    """The laboratory for one recipe's spec. A context manager; `rig` is its rig file.

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
        along = float(np.degrees(spec.rig.earth_rate or 0.0)) / EARTH_RATE_DPS
        turned = {"latitude_deg": 0.0, "azimuth_deg": float(np.degrees(np.arcsin(np.clip(along, -1.0, 1.0))))}
        mounting = Mounting(
            axes=tuple(_ALONG[axis] for axis in self.axes) if several else (_ALONG["x"],),
            mounting=_MOUNTED["x"] if several else _MOUNTED[self.axes[0]],
            **({"earth_rate_dps": 0.0} if several else turned if along and np.isfinite(along) else {}),
        )
        self.sensor = SimulatedSensor(
            self.truth.sensor,
            mounting,
            self.chamber_plant,
            self.axis_plants,
            sample_rate_hz=sample_rate_hz,
            seed=seed + 1,
            start_s=now,
        )
        plants = dict(zip(map(str, self.axes), self.axis_plants, strict=True))
        operator = SimulatedOperator(plants, clock, OperatorOptions(seed=seed, slips=_SLIPS))
        self._connect(
            dict.fromkeys(self.axes, table),
            operator,
            {_SENSOR_NAME: self.sensor},
            by_hand=table.drive == "hand",
            sample_rate_hz=sample_rate_hz,
            burst_s=burst_s,
        )
        (self.imu,) = self.imus.values()

    def truths(self) -> dict[str, Any]:
        """The true parameters, for a file."""
        return self.truth.tables(self.axes)


def _axes(spec: Spec) -> tuple[Axis, ...]:
    turned = {move.axis for block in tracks_of(spec)[1] for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(axis for axis in AXES if axis in turned) or ("x",)
