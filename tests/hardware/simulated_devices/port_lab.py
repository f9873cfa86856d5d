"""The simulated laboratory on ports: an ESPEC, a chain of Zaber stages or a person at a terminal, STIM300 units."""

from collections.abc import Iterable
from typing import Any, Self

import numpy as np
from simulated_devices.espec import EspecOptions, SimulatedEspec
from simulated_devices.operator import OperatorOptions, SimulatedOperator
from simulated_devices.port import SimulatedPort
from simulated_devices.stim300 import SimulatedStim300, Stim300Options
from simulated_devices.zaber import SimulatedZaber

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate import lab
from gradcal_jax.hardware.simulate.lab import RATES_HZ
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
        operator = SimulatedOperator(plants, clock, OperatorOptions(seed=seed, slips=0.02), hang=hang)
        baudrate = 921_600 if sample_rate_hz < RATES_HZ[-1] else 1_843_200
        options = Stim300Options(baudrate=baudrate, rate_code=RATES_HZ.index(sample_rate_hz), burst_s=burst_s)
        self.imus = {name: SimulatedStim300(sensor, clock, options) for name, sensor in self.units.items()}
        self.imu = next(iter(self.imus.values()))
        self.table: Any = operator if by_hand else chain_of(self.axis_plants, clock, axes.values())
        hangs = hang is not None and not by_hand
        devices = [self.chamber, self.table, *self.imus.values(), *([operator] if hangs else [])]
        self.ports = [SimulatedPort(device, clock) for device in devices]
        at_chamber, at_table, *others = (port.url for port in self.ports)
        settings = {"sample_rate": f"{sample_rate_hz:g} Hz", "baudrate": baudrate}
        units = [
            {"name": name, "driver": "stim300", "port": port, "options": settings}
            for name, port in zip(self.units, others, strict=False)
        ]
        tables: dict[str, Any] = {
            "format": "gradcal-rig/1",
            "title": "simulated laboratory",
            "chamber": {"driver": "espec", "port": at_chamber, "safe": "standby"},
            "axis": [axis_table(*axis, at_table, i, by_hand) for i, axis in enumerate(axes.items(), start=1)],
            "imu": units,
        }
        self.rig = rig_of(tables | ({"operator": {"port": others[-1]}} if len(others) > len(units) else {}))

    def __enter__(self) -> Self:
        for port in self.ports:
            port.open()
        return self

    def __exit__(self, *_: object) -> None:
        for port in self.ports:
            port.close()


def chain_of(plants: list[AxisPlant], clock: Clock, axes: Iterable[TableAxis]) -> SimulatedZaber:
    chain = SimulatedZaber(plants, clock)
    for stage, says in zip(chain.stages, axes, strict=True):
        if not np.isinf(travel := float(says.travel)):
            reach = round(float(np.degrees(travel)) / 360.0 * stage.settings["limit.cycle.dist"])
            stage.settings |= {"limit.min": -reach, "limit.max": reach}
    return chain


def axis_table(name: str, says: TableAxis, port: str, number: int, by_hand: bool) -> dict[str, Any]:
    """The rig file's table of an axis: a stage on a chain, or turned by hand."""
    limits = {"max_rate": str(says.max_rate), "max_acceleration": str(says.max_acceleration)}
    if by_hand and not np.isinf(float(says.travel)):
        limits["travel"] = str(says.travel)
    device = {"name": name, "driver": "operator" if by_hand else "zaber", "port": port, "safe": "hold"}
    return device | {"gravity_loaded": False, "options": limits if by_hand else {"device": number, **limits}}
