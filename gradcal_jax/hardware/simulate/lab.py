"""A whole simulated laboratory for a recipe: chamber, table and one sensor, on ports of their own, with hidden truth.

The chamber is an ESPEC, the table a chain of Zaber stages (or, where the spec's table is driven by hand, a gimbal with
an operator who turns it and types its angles), the sensor a STIM300. The seed draws the true parameters from the spec's
priors and the noise from its error model; for a flat prior typical values. A single table axis points east, where the
Earth's rate has no component; with several axes the Earth's rate is zero. The sensor's mounting is perfect and its
structure is the spec's: a `discrepancy` is not drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import numpy as np

from ...files.bases import RatePolynomial, RateSpline, TemperaturePolynomial, TemperatureSpline
from ...files.bench import Chamber
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
from .sensor import Mounting, Process, SensorTruth, SimulatedSensor, Triple, TruthBasis
from .stim300 import RATES_HZ, SimulatedStim300, Stim300Options
from .zaber import SimulatedZaber

_EAST: Final[Triple] = (1.0, 0.0, 0.0)
_ALONG: Final[dict[Axis, Triple]] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Mountings that point this axis of the sensor east.
_MOUNTED: Final[dict[Axis, tuple[Triple, Triple, Triple]]] = {
    "x": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "y": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    "z": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
}
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
        bias_basis = temperature_truth(sensor.bias.temperature)
        size = _TYPICAL_BIAS_DPS if sensor.bias.prior is None else float(sensor.bias.prior) * deg
        bias = size * random.standard_normal((3, sensor.bias.temperature.size))
    bias[:, 0] += float(sensor.turn_on_bias or 0.0) * deg * random.standard_normal(3)
    temperature_basis, rate_basis, scale = TruthBasis(), TruthBasis(), np.zeros((3, 1, 1))
    if (section := sensor.scale_factor) is not None:
        temperature_basis, rate_basis = temperature_truth(section.temperature), rate_truth(section.rate)
        size = _TYPICAL_SCALE if section.prior is None else float(section.prior)
        scale = size * random.standard_normal((3, section.temperature.size, section.rate.size))
    gradient = np.zeros(3)
    if (slope := sensor.bias_temperature_gradient) is not None:
        gradient = (np.radians(1.0) / 60.0 if slope.prior is None else float(slope.prior)) * deg * np.ones(3)
        gradient *= random.standard_normal(3)
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


def temperature_truth(section: Any) -> TruthBasis:
    if isinstance(section, TemperaturePolynomial):
        return TruthBasis("polynomial", section.degree, float(section.centre), float(section.scale))
    if isinstance(section, TemperatureSpline):
        return TruthBasis("b-spline", section.degree, knots=tuple(float(k) for k in section.knots))
    return TruthBasis("bins", knots=tuple(float(e) for e in section.edges))


def rate_truth(section: Any) -> TruthBasis:
    def dps(values: tuple[Any, ...]) -> tuple[float, ...]:
        return tuple(to_unit(float(value), "deg/s") for value in values)

    if isinstance(section, RatePolynomial):
        centre, scale = dps((section.centre, section.scale))
        return TruthBasis("polynomial", section.degree, centre, scale)
    if isinstance(section, RateSpline):
        return TruthBasis("b-spline", section.degree, knots=dps(section.knots))
    return TruthBasis("bins", knots=dps(section.edges))


class OnPorts:
    """Context with simulated devices on open ports; `rig` is the rig file."""

    ports: list[SimulatedPort]
    rig: RigFile

    def __enter__(self) -> Self:
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()


class SimulatedLab(OnPorts):
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
        burst_s: float = 0.5,
        room_c: float = 23.0,
    ) -> None:
        self.truth = draw_truth(spec, seed)
        now = clock.now()
        table, chamber = spec.rig.table, spec.rig.chamber
        self.axes = _axes(spec)
        lag_s = float(spec.sensor.thermal_lag or 0.0)
        self.chamber_plant = ChamberPlant(chamber_truth(chamber, lag_s, room_c), now)
        axis = self.truth.axis
        self.axis_plants = [
            AxisPlant(replace(axis, seed=16 * axis.seed + number), now) for number in range(1, len(self.axes) + 1)
        ]
        several = len(self.axes) > 1
        mounting = Mounting(
            axes=tuple(_ALONG[axis] for axis in self.axes) if several else (_EAST,),
            mounting=_MOUNTED["x"] if several else _MOUNTED[self.axes[0]],
            **({"earth_rate_dps": 0.0} if several else {}),
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
        cold, hot = (float(end) for end in chamber.range)
        limited = None if np.isinf(float(table.travel)) else float(np.degrees(float(table.travel)))
        self.chamber = SimulatedEspec(self.chamber_plant, clock, EspecOptions(high_c=hot + 5.0, low_c=cold - 5.0))
        self.table: SimulatedZaber | SimulatedOperator
        if table.drive == "hand":
            plants = dict(zip(map(str, self.axes), self.axis_plants, strict=True))
            self.table = SimulatedOperator(plants, clock, OperatorOptions(seed=seed, slips=_SLIPS))
        else:
            self.table = chain_of(self.axis_plants, clock, [limited] * len(self.axes))
        self.imu = SimulatedStim300(self.sensor, clock, unit_options(sample_rate_hz, burst_s))
        self.ports = [SimulatedPort(device, clock) for device in (self.chamber, self.table, self.imu)]
        at_chamber, at_table, at_imu = (port.url for port in self.ports)
        by_hand = isinstance(self.table, SimulatedOperator)
        axes = [axis_tables(axis, at_table, number, table, by_hand) for number, axis in enumerate(self.axes, start=1)]
        self.rig = lab_rig(at_chamber, axes, {_SENSOR_NAME: at_imu}, sample_rate_hz)

    def truths(self) -> dict[str, Any]:
        """The true parameters, for a file."""
        return self.truth.tables(self.axes)


def chain_of(plants: list[AxisPlant], clock: Clock, travel_deg: Sequence[float | None]) -> SimulatedZaber:
    """A chain of stages; travel in degrees each way from zero."""
    chain = SimulatedZaber(plants, clock)
    for stage, travel in zip(chain.stages, travel_deg, strict=True):
        if travel is not None:
            reach = round(travel / 360.0 * stage.settings["limit.cycle.dist"])
            stage.settings |= {"limit.min": -reach, "limit.max": reach}
    return chain


def axis_tables(name: str, port: str, number: int, says: Any, by_hand: bool) -> dict[str, Any]:
    """The rig file's table of a simulated axis: a stage on a chain, or turned by hand. `says`: the spec's."""
    limits = {"max_rate": str(says.max_rate), "max_acceleration": str(says.max_acceleration)}
    if by_hand and not np.isinf(float(says.travel)):
        limits["travel"] = str(says.travel)
    device = {"name": name, "driver": "operator" if by_hand else "zaber", "port": port, "safe": "hold"}
    return device | {"gravity_loaded": False, "options": limits if by_hand else {"device": number, **limits}}


def unit_options(sample_rate_hz: float, burst_s: float) -> Stim300Options:
    """The options of a simulated unit whose bytes reach the computer every `burst_s`."""
    line = _BAUDRATE if sample_rate_hz < RATES_HZ[-1] else _BAUDRATE_AT_FULL_RATE
    return Stim300Options(baudrate=line, rate_code=RATES_HZ.index(sample_rate_hz), burst_s=burst_s)


def lab_rig(
    at_chamber: str,
    axes: list[dict[str, Any]],
    units: dict[str, str],
    sample_rate_hz: float,
    at_person: str | None = None,
) -> RigFile:
    """The rig file of simulated devices; `units`: names and ports. `at_person`: the port of the operator who hangs
    them anew."""
    options = {"sample_rate": f"{sample_rate_hz:g} Hz", "baudrate": unit_options(sample_rate_hz, 0.0).baudrate}
    tables: dict[str, Any] = {
        "format": "gradcal-rig/1",
        "title": "simulated laboratory",
        "chamber": {"driver": "espec", "port": at_chamber, "safe": "standby"},
        "axis": axes,
        "imu": [{"name": n, "driver": "stim300", "port": port, "options": options} for n, port in units.items()],
    }
    return rig_of(tables if at_person is None else tables | {"operator": {"port": at_person}})


def chamber_truth(chamber: Chamber, lag_s: float, room_c: float) -> ChamberTruth:
    """A chamber that follows the spec's limits with a margin."""
    return ChamberTruth(
        start_c=room_c,
        ambient_c=room_c,
        heating_k_per_min=1.2 * 60.0 * float(chamber.max_heating),
        cooling_k_per_min=1.2 * 60.0 * float(chamber.max_cooling),
        load_time_constant_s=max(lag_s, 1.0),
    )


def _axes(spec: Spec) -> tuple[Axis, ...]:
    turned = {move.axis for block in tracks_of(spec)[1] for move in block.moves if move.do not in ("rest", "wait")}
    return tuple(axis for axis in AXES if axis in turned) or ("x",)
