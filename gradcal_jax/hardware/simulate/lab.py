"""A simulated laboratory for a recipe: chamber, a table of nested axes, one or several devices, with hidden truth.

The seed draws the true parameters from the spec's priors (`draws`): each device's own, and those of the table. With the
frame "table axes" the mounting has no error, by definition of the frame. Where the spec's table is driven by hand, a
person turns it, and types its angles where the plan does not read the axes at rest; else an encoder is read. Where
gravity is the reference nothing is read, and axes stop some degrees off. The operator hangs the devices anew where
there are several mountings; at the places of a fixture sits one each.

The devices have the methods of their roles and no lines. They wait on the run's clock alone, so that a run in virtual
time takes as long as its computation. A unit gives the bytes that the description "stim300" has.
"""

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware import roles
from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.drivers.base import ChamberDriver, require_within
from gradcal_jax.hardware.drivers.listening import FramesConfig
from gradcal_jax.hardware.drivers.operator import OperatorAxis, OperatorConfig
from gradcal_jax.hardware.frames import FrameDecoder
from gradcal_jax.hardware.setup import Bench
from gradcal_jax.hardware.simulate.draws import draw_places, draw_table, draw_truth
from gradcal_jax.hardware.simulate.imu import SensorSamples, SimulatedImu
from gradcal_jax.hardware.simulate.plants import AxisPlant, ChamberPlant, ChamberTruth, UncontrolledRoom
from gradcal_jax.recipe.tracks import read_at_rest, tracks_of
from gradcal_jax.spec.rig import RigFile, rig_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.units import to_unit

RATES_HZ: Final = (125.0, 250.0, 500.0, 1000.0, 2000.0)
# The unit sends the frames of the description "stim300": their first byte and their checksum.
_IDENTIFIER: Final = 0xA5
_CRC: Final = CrcOfRows(32, 0x04C11DB7, 0xFFFFFFFF, 0, zeros=2)


def datagrams(samples: SensorSamples, first: int, rate_hz: float) -> NDArray[np.uint8]:
    """A row for each sample, of which `first` is the number since the unit began; of a range of 10 g."""
    rows = np.zeros((len(samples.time_s), 42), np.uint8)
    rows[:, 0] = _IDENTIFIER
    rows[:, 1:10] = _integers(samples.rate_dps * 2.0**14, 3)
    # Status bit 4 and the channel's bit where a rate is beyond the 24 bits.
    beyond = (np.abs(samples.rate_dps) >= 512.0 - 2.0**-14) @ np.array([1, 2, 4])
    rows[:, 10] = np.where(beyond, 0x10 | beyond, 0)
    rows[:, 11:20] = _integers(samples.acceleration_g * 2.0**19, 3)
    rows[:, 21:27] = np.tile(_integers(samples.temperature_c[:, None] * 256.0, 2), 3)
    rows[:, 35] = (first + 1 + np.arange(len(rows))) * round(2000.0 / rate_hz) % 256
    rows[:, 38:] = _CRC(rows[:, :38]).astype(">u4")[:, None].view(np.uint8)
    return rows


def _integers(values: NDArray[np.float64], size: int) -> NDArray[np.uint8]:
    """The bytes of numbers `(n, k) -> (n, k · size)` as big-endian integers, clipped to their range."""
    most = 2.0 ** (8 * size - 1)
    # A sensor that the unit lacks has no number: zero.
    known = np.where(np.isnan(values), 0.0, values)
    whole = np.rint(np.minimum(np.maximum(known, -most), most - 1.0)).astype(">i4", order="C")
    return whole.view(np.uint8).reshape(len(whole), -1, 4)[:, :, 4 - size :].reshape(len(whole), -1)


_HANG: Final = re.compile(r"mount the IMUs as follows: mounting (\d+)")
_TURN: Final = re.compile(r"([\w-]+): turn (?:by \S+ deg in (\S+) s, )?to (\S+) deg")
_ZERO: Final = re.compile(r"([\w-]+): bring it to its zero mark")
_HOME_S, _HANGS_S, _HOMES_AT_DPS = 5.0, 120.0, 30.0
# Where a motor without feedback stops, about its goal (standard deviation), deg.
_STOPS_OFF_DEG: Final = 5.0
_AXIS_STEP_DEG: Final = 360.0 / 1_152_000


class SimulatedChamber(ChamberDriver):
    """Role `TemperatureChamber`, on a plant: from `lowest_c` to `highest_c`, ramps of any rate."""

    def __init__(self, plant: ChamberPlant, clock: Clock, lowest_c: float, highest_c: float) -> None:
        self.plant, self._clock, self._title = plant, clock, "simulated chamber"
        self._limits = roles.ChamberLimits(lowest_c, highest_c, hardware_ramp=True)

    def identify(self) -> roles.Identity:
        return roles.Identity("simulated", "chamber")

    def limits(self) -> roles.ChamberLimits:
        return self._limits

    def read(self) -> roles.ChamberReading:
        now = self._clock.now()
        plant = self.plant.at(now)
        mode, air_c = "CONSTANT" if plant.conditioning else "STANDBY", round(plant.air_c, 1)
        return roles.ChamberReading(now, air_c, None, plant.set_point_c, mode, plant.conditioning, ())

    def hold(self, temperature_c: float) -> None:
        self.set_point(temperature_c)
        self.plant.conditioning = True

    def set_point(self, temperature_c: float) -> None:
        self._check(temperature_c)
        self.plant.command(self._clock.now(), target_c=round(temperature_c, 1))

    def ramp(self, temperature_c: float, rate_k_per_min: float) -> float:
        self._check(temperature_c)
        now = self._clock.now()
        plant = self.plant.at(now)
        if not plant.conditioning or abs(plant.set_point_c - plant.air_c) >= 2.0:
            plant.set_point_c = plant.air_c
        plant.command(now, target_c=round(temperature_c, 1), gradient_k_per_min=rate_k_per_min)
        plant.conditioning = True
        return rate_k_per_min

    def standby(self) -> None:
        self.plant.at(self._clock.now()).conditioning = False


class SimulatedAxis(roles.MotionAxis):
    def __init__(self, plant: AxisPlant, clock: Clock, limits: roles.AxisLimits) -> None:
        self.plant, self._clock, self._title, self._limits = plant, clock, "The simulated axis", limits
        self.settings = roles.KeptSettings()
        self._referenced = False
        self._off_deg, self._random = 0.0, np.random.default_rng([plant.truth.seed, 5])
        self._acceleration_dps2 = limits.max_acceleration_dps2

    def identify(self) -> roles.Identity:
        return roles.Identity("simulated", "axis")

    def limits(self) -> roles.AxisLimits:
        return self._limits

    def read(self) -> roles.AxisReading:
        now = self._clock.now()
        angle, rate = self._on_grid(self.plant.reading(now)) - self._off_deg, self.plant.state(now)[1]
        return roles.AxisReading(now, angle, rate, self.plant.moving(now), self._referenced, ())

    def home(self) -> None:
        now = self._clock.now()
        angle, _ = self.plant.state(now)
        away = (angle + 180.0) % 360.0 - 180.0
        self.plant.move_to(now, angle - away, _HOMES_AT_DPS, self._acceleration_dps2)
        self._clock.sleep(abs(away) / _HOMES_AT_DPS + 1.0)
        self.plant.set_zero(self._clock.now())
        self._referenced, self._off_deg = True, 0.0

    def move_to(self, position_deg: float, rate_dps: float, acceleration_dps2: float) -> None:
        require_within(self._limits.beyond(rate_dps, acceleration_dps2, position_deg))
        self._acceleration_dps2 = acceleration_dps2
        if self._limits.told:
            # A motor that is switched on and off stops anywhere near, and nothing shows where.
            self._off_deg = _STOPS_OFF_DEG * float(self._random.standard_normal())
        goal_deg = self._on_grid(position_deg) + self._off_deg
        self.plant.move_to(self._clock.now(), goal_deg, rate_dps, acceleration_dps2)

    def spin(self, rate_dps: float, acceleration_dps2: float) -> None:
        require_within(self._limits.beyond(abs(rate_dps), acceleration_dps2))
        self._acceleration_dps2 = acceleration_dps2
        self.plant.spin(self._clock.now(), rate_dps, acceleration_dps2)

    def stop(self) -> None:
        self.plant.spin(self._clock.now(), 0.0, self._acceleration_dps2)
        self._clock.sleep_until(self.plant.ends_s)

    def safe(self, policy: str) -> roles.SafeReport:
        self.stop()
        reading = self.read()
        return roles.SafeReport(not reading.moving, f"stands at {reading.position_deg:.4f} deg")

    def _on_grid(self, angle_deg: float) -> float:
        step = self._limits.resolution_deg
        return step * round(angle_deg / step)


class SimulatedPerson:
    """Role `OperatorAsked`, for `drivers.operator`: turns axes, by name, on their plants as the questions say, types
    angles, and hangs the units anew.

    A person reacts after a while, turns unevenly in the time that is asked for, misses the mark a little (`miss_deg`,
    standard deviation), and reads the dial when the axis stands.
    """

    def __init__(
        self,
        clock: Clock,
        plants: Mapping[str, AxisPlant],
        units: Iterable[SimulatedImu] = (),
        *,
        seed: int = 0,
        miss_deg: float = 0.3,
    ) -> None:
        self.reaction_s, self.reading_s, self.miss_deg = 1.5, 2.0, miss_deg
        self._clock, self._plants, self._units = clock, plants, units
        self._random = np.random.default_rng([seed, 4])
        self.answers_s = math.inf
        """When the answer is given."""
        # The axis that was turned last, whether its angle is typed, and the mounting that was asked for.
        self._axis, self._by_angle, self._mounting = "", False, 0

    def ask(self, question: str) -> None:
        now = self._clock.now()
        # A doubted answer is given again in the same way: "press Enter again", "type it again".
        self._by_angle, self._mounting = "Enter" not in question, 0
        self.answers_s = now + self.reading_s
        if hung := _HANG.search(question):
            self.answers_s, self._mounting = now + _HANGS_S, int(hung[1])
        elif turn := _TURN.search(question):
            self._turn(turn[1], float(turn[3]), float(turn[2] or _HOME_S))
        elif zero := _ZERO.search(question):
            # At the zero mark the angle becomes zero, without whole turns.
            plant = self._plants[zero[1]]
            angle, _ = plant.state(now)
            plant.set_zero(now, angle - 360.0 * round(angle / 360.0))
            self._turn(zero[1], 0.0, _HOME_S)

    def answer(self) -> tuple[str, float] | None:
        at_s = self.answers_s
        if self._clock.now() < at_s:
            return None
        self.answers_s = math.inf
        if self._mounting:
            for unit in self._units:
                unit.mounting = self._mounting - 1
        return f"{self._plants[self._axis].reading(at_s) % 360.0:.3f} deg" if self._by_angle else "", at_s

    def withdraw(self, why: str) -> None:
        self.answers_s = math.inf

    def _turn(self, name: str, goal_deg: float, lasts_s: float) -> None:
        plant, begins_s = self._plants[name], self._clock.now() + self.reaction_s
        goal_deg += self.miss_deg * float(self._random.standard_normal())
        plant.turn_by_hand(begins_s, goal_deg, lasts_s)
        self._axis, self.answers_s = name, begins_s + lasts_s + self.reading_s


class SimulatedStream:
    """Role `ImuStream`: a unit of the driver "frames" whose bytes reach the computer every `burst_s`."""

    def __init__(self, sensor: SimulatedImu, clock: Clock, config: FramesConfig, burst_s: float, serial: str) -> None:
        self.sensor, self._clock, self._unit, self._burst_s = sensor, clock, config.described, burst_s
        self.serial = serial
        self._rate_hz = float(self._unit.rate)

    def identify(self) -> roles.Identity:
        return roles.Identity("frames", "simulated", self.serial)

    def configure(self) -> roles.ImuSettings:
        return roles.ImuSettings(self._rate_hz, {})

    def start(self) -> None:
        self.sensor.restart(self._clock.now(), self._rate_hz)

    def read_bytes(self, timeout_s: float) -> tuple[bytes, float]:
        ahead = max(1, round(self._burst_s / self.sensor.true_period_s))
        self._clock.sleep_until(self.sensor.next_time_s(ahead))
        now = self._clock.now()
        first, samples = self.sensor.taken, self.sensor.take(self.sensor.due(now))
        return datagrams(samples, first, self._rate_hz).tobytes(), now

    def decoder(self) -> FrameDecoder:
        return FrameDecoder(self._unit)


def unit_options(sample_rate_hz: float) -> dict[str, Any]:
    """The options of a unit in the rig file."""
    return {"protocol": "stim300", "changes": {"rate": f"{sample_rate_hz:g} Hz"}}


class SimulatedLab:
    """The laboratory for one recipe's spec, with `units` devices on the table. `rig` is the rig file, `bench` the open
    devices.

    `mounting`: the first mounting, from 0. `burst_s` is the time between bursts of a unit's bytes to the computer.
    """

    rig: RigFile

    def __init__(
        self,
        spec: Spec,
        clock: Clock,
        *,
        seed: int = 0,
        units: int = 1,
        mounting: int = 0,
        sample_rate_hz: float = 125.0,
        burst_s: float = 1.0,
        room_c: float = 23.0,
    ) -> None:
        now, chamber = clock.now(), spec.rig.chamber
        physics = ChamberTruth(
            start_c=room_c,
            ambient_c=room_c,
            # A margin beyond the spec's limits.
            heating_k_per_min=1.2 * 60.0 * float(chamber.max_heating),
            cooling_k_per_min=1.2 * 60.0 * float(chamber.max_cooling),
            load_time_constant_s=max(float(spec.sensor.thermal_lag or 0.0), 1.0),
        )
        climate = self.chamber_plant = ChamberPlant(physics, now)
        if chamber.control == "none":
            segments = spec.gradient_schedule.segments
            course = [segments[0].temperature_start, *(s.temperature_end for s in segments)]
            ends = [0.0, *(s.end for s in segments)]
            # A run that is late sees the way back, and so on.
            ends, course = [*ends, *(2.0 * ends[-1] - t for t in ends[-2::-1])], [*course, *course[-2::-1]]
            climate = UncontrolledRoom(ends, course, now, physics.load_time_constant_s)
        truth, encoders, self._installation = draw_table(spec, seed)
        self.axis_plants = [AxisPlant(encoder, now) for encoder in encoders]
        # Each at its place of a fixture: there are as many as places.
        held = draw_places(spec, truth, seed) or [truth] * units
        names = [place.name for place in spec.rig.table.place] or [f"unit{k + 1}" for k in range(units)]
        self.units: dict[str, SimulatedImu] = {}
        for number, (name, table) in enumerate(zip(names, held, strict=True), start=1):
            self.units[name] = SimulatedImu(
                draw_truth(spec, seed, number),
                table,
                climate,
                self.axis_plants,
                sample_rate_hz=sample_rate_hz,
                seed=64 * seed + number,
                mounting=mounting,
                start_s=now,
            )
        self._connect(spec, clock, seed, sample_rate_hz, burst_s)

    def _connect(self, spec: Spec, clock: Clock, seed: int, sample_rate_hz: float, burst_s: float) -> None:
        """Make the devices. Axes may be turned by hand, their angles typed or read from an encoder."""
        table, controlled = spec.rig.table, spec.rig.chamber.control == "chamber"
        by_hand, told = table.drive == "hand", table.by_gravity
        read = read_at_rest(tracks_of(spec).motion) and not told
        device, options = {"driver": "simulated"}, unit_options(sample_rate_hz)
        turned = device | {"port": "/simulated/table", "safe": "hold", "gravity_loaded": False}
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "axis": [{"name": axis.name, **turned} for axis in table.axis],
            "imu": [
                {"name": name, "port": f"/simulated/{name}", "driver": "frames", "options": options}
                for name in self.units
            ],
        }
        if controlled:
            tables["chamber"] = device | {"port": "/simulated/chamber", "safe": "standby"}
        self.rig = rig_of(tables)
        self.bench = bench = Bench(self.rig)
        if controlled:
            cold, hot = (float(end) for end in spec.rig.chamber.range)
            bench.chamber = SimulatedChamber(self.chamber_plant, clock, cold - 5.0, hot + 5.0)
        plants = {axis.name: plant for axis, plant in zip(table.axis, self.axis_plants, strict=True)}
        person = SimulatedPerson(clock, plants, self.units.values(), seed=seed, miss_deg=3.0 if told else 0.3)
        if takes_s := float(table.answer_time):
            # Nine tenths of what the spec allows: half to hear and begin, half to say that it is done.
            person.reaction_s = person.reading_s = 0.45 * takes_s
        for axis in table.axis:
            travel = float(np.degrees(float(axis.travel)))
            limits = roles.AxisLimits(
                to_unit(float(axis.max_rate), "deg/s"),
                to_unit(float(axis.max_acceleration), "deg/s^2"),
                None if np.isinf(travel) else -travel,
                None if np.isinf(travel) else travel,
                _AXIS_STEP_DEG,
                told=told and not by_hand,
            )
            bench.axes[axis.name] = driven = SimulatedAxis(plants[axis.name], clock, limits)
            if by_hand:
                most = {name: getattr(axis, name) for name in ("max_rate", "max_acceleration", "travel")}
                config = OperatorConfig(**most, angle="none" if told else "typed")
                bench.axes[axis.name] = OperatorAxis(person, config, clock, axis.name, driven if read else None)
        config = FramesConfig(**options)
        for number, (name, sensor) in enumerate(self.units.items(), start=1):
            bench.imus[name] = SimulatedStream(sensor, clock, config, burst_s, f"SIMULATED{number}")
        if len(table.mounting) > 1:
            bench.console = person

    def truths(self) -> dict[str, Any]:
        """The true parameters by their names in the calibrations, SI, for a file."""
        units = {name: unit.truth.names for name, unit in self.units.items()}
        return {"installation": self._installation, "units": units}
