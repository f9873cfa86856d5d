"""A simulated laboratory for a recipe: chamber, a table of nested axes, one or several devices, with hidden truth.

The seed draws the true parameters from the spec's priors: each device's own coefficients, and the common ones,
attitudes of base and axes, harmonics of the encoders, the mountings. The accelerometers are a few centimetres off the
axes and sense it. With the frame "table axes" the mounting has no error, by definition of the frame. Where the spec's
table is driven by hand, a person turns it, and types its angles where the plan does not read the axes at rest; else an
encoder is read. Where gravity is the reference nothing is read, and axes stop some degrees off. The operator hangs the
devices anew where there are several mountings; at the places of a fixture sits one each. The devices are STIM300. What
a `discrepancy` says that the maps lack is drawn, too.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np

from ...files.bench import TableAxis
from ...files.rig import RigFile, rig_of
from ...files.spec_sections import Spec
from ...files.tracks import read_at_rest, tracks_of
from ...units import to_unit
from ..clock import Clock
from ..drivers.operator import OperatorAxis, OperatorConfig
from ..drivers.stim300 import Stim300Config
from ..roles import AxisLimits
from ..setup import Bench
from .devices import RATES_HZ, SimulatedAxis, SimulatedChamber, SimulatedHand, SimulatedPerson, SimulatedStream
from .draws import draw_places, draw_table, draw_truth
from .imu import SimulatedImu
from .plants import AxisPlant, ChamberPlant, ChamberTruth, UncontrolledRoom

# Bits/s. 2000 datagrams/s of rates, forces and temperatures leave no margin on the usual line.
_BAUDRATE: Final = 921_600
_BAUDRATE_AT_FULL_RATE: Final = 1_843_200
_AXIS_STEP_DEG: Final = 360.0 / 1_152_000


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
        self.chamber_plant = ChamberPlant(physics, now)
        climate = self.chamber_plant
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
        places = spec.rig.table.place
        names = [place.name for place in places] or [f"unit{number}" for number in range(1, units + 1)]
        held = draw_places(spec, truth, seed)
        self.units: dict[str, SimulatedImu] = {
            name: SimulatedImu(
                draw_truth(spec, seed, number),
                held[number - 1] if held else truth,
                climate,
                self.axis_plants,
                sample_rate_hz=sample_rate_hz,
                seed=64 * seed + number,
                mounting=mounting,
                start_s=now,
            )
            for number, name in enumerate(names, start=1)
        }
        self._connect(spec, clock, seed, sample_rate_hz, burst_s)

    def _connect(self, spec: Spec, clock: Clock, seed: int, sample_rate_hz: float, burst_s: float) -> None:
        """Make the devices. Axes may be turned by hand, their angles typed or read from an encoder."""
        axes, by_hand = spec.rig.table.axis, spec.rig.table.drive == "hand"
        typed = not read_at_rest(tracks_of(spec)[1])
        cold, hot = (float(end) for end in spec.rig.chamber.range)
        baudrate = _BAUDRATE if sample_rate_hz < RATES_HZ[-1] else _BAUDRATE_AT_FULL_RATE
        settings = {"sample_rate": f"{sample_rate_hz:g} Hz", "baudrate": baudrate}
        table = {"driver": "simulated", "port": "/simulated/table", "safe": "hold", "gravity_loaded": False}
        unit = {"driver": "stim300", "options": settings}
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "simulated", "port": "/simulated/chamber", "safe": "standby"},
            "axis": [{"name": axis.name, **table} for axis in axes],
            "imu": [{"name": name, "port": f"/simulated/{name}", **unit} for name in self.units],
        }
        if spec.rig.chamber.control == "none":
            del tables["chamber"]
        self.rig = rig_of(tables)
        self.bench = Bench(self.rig, simulated=True)
        if spec.rig.chamber.control == "chamber":
            self.bench.chamber = SimulatedChamber(self.chamber_plant, clock, cold - 5.0, hot + 5.0)
        told = spec.rig.table.by_gravity
        plants = {axis.name: plant for axis, plant in zip(axes, self.axis_plants, strict=True)}
        hand = SimulatedHand(seed, miss_deg=3.0 if told else 0.3)
        if takes_s := float(spec.rig.table.answer_time):
            # Nine tenths of what the spec allows, in the mean: half to hear and begin, half to say that it is done.
            hand = replace(hand, reaction_s=0.45 * takes_s, reading_s=0.45 * takes_s)
        person = SimulatedPerson(clock, plants, hand, self._hang)
        for axis in axes:
            limits = _limits_of(axis, told=told and not by_hand)
            driven = SimulatedAxis(plants[axis.name], clock, limits)
            config = OperatorConfig(
                limits.max_rate_dps,
                limits.max_acceleration_dps2,
                limits.travel_deg[1],
                angle="none" if told else "typed",
            )
            by_person = OperatorAxis(person, config, clock, axis.name, None if typed or told else driven)
            self.bench.axes[axis.name] = by_person if by_hand else driven
        config = Stim300Config(baudrate=baudrate, sample_rate_hz=sample_rate_hz)
        for number, (name, sensor) in enumerate(self.units.items(), start=1):
            self.bench.imus[name] = SimulatedStream(sensor, clock, config, burst_s, f"SIMULATED{number}")
        if len(spec.rig.table.mounting) > 1:
            self.bench.console = person

    def truths(self) -> dict[str, Any]:
        """The true parameters by their names in the calibrations, SI, for a file."""
        units = {name: unit.truth.names for name, unit in self.units.items()}
        return {"installation": self._installation, "units": units}

    def _hang(self, number: int) -> None:
        for unit in self.units.values():
            unit.mounting = number - 1


def _limits_of(says: TableAxis, *, told: bool) -> AxisLimits:
    rate, acceleration = to_unit(float(says.max_rate), "deg/s"), to_unit(float(says.max_acceleration), "deg/s^2")
    travel = float(np.degrees(float(says.travel)))
    lowest, highest = (None, None) if np.isinf(travel) else (-travel, travel)
    return AxisLimits(rate, acceleration, lowest, highest, _AXIS_STEP_DEG, hardware_watchdog=False, told=told)
