"""The simulated laboratory on ports: an ESPEC, boards with GRBL or a person at a terminal, units that
send frames."""

from typing import Any, Self

import numpy as np
from simulated_devices.espec import EspecOptions, SimulatedEspec
from simulated_devices.frames import SimulatedFrames
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.operator import SimulatedOperator
from simulated_devices.port import FastClock, SimulatedPort
from simulated_devices.wire import Wire

from gradcal_jax.hardware.clock import Clock, VirtualClock
from gradcal_jax.hardware.simulate import lab
from gradcal_jax.hardware.simulate.lab import unit_options
from gradcal_jax.hardware.simulate.plants import AxisPlant
from gradcal_jax.spec.bench import TableAxis
from gradcal_jax.spec.rig import rig_of
from gradcal_jax.spec.spec_sections import Spec


class SimulatedLab(lab.SimulatedLab):
    """Each device on a port of its own. A context manager."""

    def _connect(self, spec: Spec, clock: Clock, seed: int, sample_rate_hz: float, burst_s: float) -> None:
        drawn, by_hand = spec.rig.table, spec.rig.table.drive == "hand"
        axes = {axis.name: axis for axis in drawn.axis}
        low_c, high_c = (float(end) for end in spec.rig.chamber.range)
        self.chamber = SimulatedEspec(self.chamber_plant, clock, EspecOptions(high_c=high_c + 5.0, low_c=low_c - 5.0))
        plants = dict(zip(map(str, axes), self.axis_plants, strict=True))
        hang = self._hang if len(drawn.mounting) > 1 else None
        operator = SimulatedOperator(plants, clock, lab.SimulatedHand(seed), hang, slips=0.02)
        self.imus = {
            name: SimulatedFrames(sensor, clock, rate_hz=sample_rate_hz, burst_s=burst_s)
            for name, sensor in self.units.items()
        }
        self.imu = next(iter(self.imus.values()))
        boards = [board_of(plant, clock) for plant in self.axis_plants]
        self.table: Any = operator if by_hand else boards[0]
        turners = [operator] if by_hand else boards
        hangs = hang is not None and not by_hand
        devices = [self.chamber, *turners, *self.imus.values(), *([operator] if hangs else [])]
        line: Any = Wire if isinstance(clock, VirtualClock) else SimulatedPort
        self.ports = [line(device, clock) for device in devices]
        at_chamber, *others = (port.url for port in self.ports)
        at_axes = [others.pop(0) for _ in turners] * (len(axes) if by_hand else 1)
        units: list[dict[str, Any]] = [
            {"name": name, "driver": "frames", "port": port, "options": unit_options(sample_rate_hz)}
            for name, port in zip(self.units, others, strict=False)
        ]
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "lines", "port": at_chamber, "safe": "standby", "options": {"protocol": "espec"}},
            "axis": [axis_table(*axis, port, by_hand) for axis, port in zip(axes.items(), at_axes, strict=True)],
            "imu": units,
        }
        if isinstance(clock, FastClock):
            # As long by the computer's clock as at the speed of a clock.
            for device in (tables["chamber"], *tables["axis"]):
                device["options"]["reply_timeout"] = f"{0.5 * clock.speed:g} s"
            for unit in units:
                unit["options"]["changes"]["timeout"] = f"{3.0 * clock.speed:g} s"
        self.rig = rig_of(tables | ({"operator": {"port": others[-1]}} if len(others) > len(units) else {}))

    def __enter__(self) -> Self:
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.__exit__()


def board_of(plant: AxisPlant, clock: Clock) -> SimulatedGrbl:
    """A board that accepts the rates of a rate table."""
    board = SimulatedGrbl(plant, clock)
    board.settings[110] = 360_000.0
    return board


def axis_table(name: str, says: TableAxis, port: str, by_hand: bool) -> dict[str, Any]:
    """The rig file's table of an axis: a board, or turned by hand."""
    limits: dict[str, Any] = {"max_rate": str(says.max_rate), "max_acceleration": str(says.max_acceleration)}
    travels = not np.isinf(float(says.travel))
    if by_hand and travels:
        limits["travel"] = str(says.travel)
    device = {"name": name, "driver": "operator" if by_hand else "lines", "port": port, "safe": "hold"}
    if not by_hand:
        ends = {"lowest_angle": f"-{says.travel}", "highest_angle": str(says.travel)} if travels else {}
        limits = {"protocol": "grbl", "changes": {"limits": limits | ends, "line": {"boot": "0 s"}}}
    return device | {"gravity_loaded": False, "options": limits}
