"""The simulated laboratory on ports: an ESPEC, boards with GRBL or somebody at the terminal, units that
send frames."""

import numpy as np
from simulated_devices.espec import SimulatedEspec
from simulated_devices.frames import SimulatedFrames
from simulated_devices.line_tables import SimulatedGrbl
from simulated_devices.port import FastClock, SimulatedPort
from simulated_devices.wire import Wire

from gradcal_jax.hardware.clock import VirtualClock
from gradcal_jax.hardware.simulate import lab
from gradcal_jax.hardware.simulate.lab import unit_options
from gradcal_jax.spec.rig import rig_of


class SimulatedLab(lab.SimulatedLab):
    """Each device on a port of its own. A context manager."""

    def _connect(self, spec, clock, seed, sample_rate_hz, burst_s):
        axes, by_hand = spec.rig.table.axis, spec.rig.table.drive == "hand"
        low_c, high_c = (float(end) for end in spec.rig.chamber.range)
        self.chamber = SimulatedEspec(self.chamber_plant, clock, high_c=high_c + 5.0, low_c=low_c - 5.0)
        boards = [board_of(plant, clock) for plant in self.axis_plants]
        self.table = boards[0]
        units = [
            SimulatedFrames(sensor, clock, rate_hz=sample_rate_hz, burst_s=burst_s) for sensor in self.units.values()
        ]
        line = Wire if isinstance(clock, VirtualClock) else SimulatedPort
        self.ports = [line(device, clock) for device in [self.chamber, *boards, *units]]
        at_chamber, *others = (port.url for port in self.ports)
        at_axes, at_units = others[: len(boards)], others[len(boards) :]
        tables = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "lines", "port": at_chamber, "safe": "standby", "options": {"protocol": "espec"}},
            "axis": [axis_table(axis, port, by_hand) for axis, port in zip(axes, at_axes, strict=True)],
            "imu": [
                {"name": name, "driver": "frames", "port": port, "options": unit_options(sample_rate_hz)}
                for name, port in zip(self.units, at_units, strict=True)
            ],
        }
        if isinstance(clock, FastClock):
            # As long by the computer's clock as at the speed of a clock.
            for device in (tables["chamber"], *tables["axis"]):
                device["options"]["reply_timeout"] = f"{0.5 * clock.speed:g} s"
            for unit in tables["imu"]:
                unit["options"]["changes"]["timeout"] = f"{3.0 * clock.speed:g} s"
        self.rig = rig_of(tables)

    def __enter__(self):
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_):
        for port in self.ports:
            port.__exit__()


def board_of(plant, clock):
    """A board that accepts the rates of a rate table, with the encoder that the spec's table has."""
    board = SimulatedGrbl(plant, clock, has_encoder=True)
    board.settings[110] = 360_000.0
    return board


def axis_table(axis, port, by_hand):
    """The rig file's table of an axis: a board, or turned by hand at the terminal."""
    limits = {"max_rate": str(axis.max_rate), "max_acceleration": str(axis.max_acceleration)}
    if by_hand:
        device = {"driver": "operator", "port": "terminal", "options": limits}
    else:
        travels = not np.isinf(float(axis.travel))
        ends = {"lowest_angle": f"-{axis.travel}", "highest_angle": str(axis.travel)} if travels else {}
        options = {"protocol": "grbl", "changes": {"limits": limits | ends, "line": {"boot": "0 s"}}}
        device = {"driver": "lines", "port": port, "options": options}
    return device | {"name": axis.name, "safe": "hold", "gravity_loaded": False}
