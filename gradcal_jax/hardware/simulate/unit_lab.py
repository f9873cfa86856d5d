"""A simulated laboratory for the recipe of a whole unit: chamber, a table of nested axes, one or several units.

The seed draws the true parameters from the spec's priors: each unit's own coefficients, and the common ones, attitudes
of base and axes, harmonics of the encoders, the mountings; for a flat prior typical values. The accelerometers are a
few centimetres off the axes and sense it. With the frame "table axes" the unit's mounting has no error, by definition
of the frame. A simulated operator turns the axes that the plan turns by hand, and hangs the units anew where there are
several mountings.
"""

import itertools
from typing import Any, Final

import numpy as np

from ...files.sensor import AccelerometerTriad, GyroTriad
from ...files.unit_spec import UnitSpec
from ..clock import Clock
from ..pose import turn_by
from .lab import Laboratory, basis_truth, processes_of
from .operator import OperatorOptions, SimulatedOperator
from .plants import AxisPlant, AxisTruth
from .sensor import TruthBasis
from .unit import (
    Coefficients,
    Hanging,
    Matrix,
    ScaleFactors,
    SimulatedUnit,
    TableTruth,
    TriadTruth,
    UnitTruth,
)

_XYZ: Final = "xyz"
_PAIRS: Final = ("xy", "xz", "yz")
# Distances of a unit from the intersection of the axes, and of its gyros from its accelerometers.
_LEVER_M: Final = 0.03
_APART_M: Final = 0.003
_CONSTANT: Final = TruthBasis()
# Typical sizes for flat priors, SI.
_TYPICAL: Final = {
    "bias": np.radians(0.02),
    "scale_factor": 1e-3,
    "misalignment": 1e-3,
    "g_sensitivity": np.radians(10.0) / 3600.0 / 9.8,
    "g_squared": np.radians(0.1) / 3600.0 / 9.8**2,
    "force_bias": 5e-3 * 9.8,
    "second_order": 1e-4 / 9.8,
    "third_order": 1e-5 / 9.8**2,
}


class _Draws:
    """Draws coefficients and keeps them by their names in the calibration."""

    def __init__(self, random: np.random.Generator) -> None:
        self.random = random
        self.values: dict[str, float] = {}

    def draw(
        self,
        kind: str,
        section: Any,
        typical: str,
        symbols: list[list[str]],
        axes: tuple[str, ...],
        *,
        counted: bool = False,
    ) -> Coefficients | None:
        """`symbols`: names of the coefficients by sensor axis, "" for none."""
        if section is None:
            return None
        basis = _CONSTANT if section.temperature is None else basis_truth(section.temperature)
        count = 1 if section.temperature is None else section.temperature.size
        size = _TYPICAL[typical] if section.prior is None else float(section.prior)
        values = size * self.random.standard_normal((3, len(symbols[0]), count))
        for row, own in enumerate(symbols):
            for column, symbol in enumerate(own):
                if not symbol or _XYZ[row] not in axes:
                    values[row, column] = 0.0
                    continue
                for power, value in enumerate(values[row, column]):
                    ending = ordinal(basis, power) if count > 1 or counted else ""
                    self.values[f"{kind}_{_XYZ[row]}.{symbol}{ending}"] = float(value)
        return Coefficients(values, basis)


def ordinal(basis: TruthBasis, number: int) -> str:
    """The number of a basis function in the calibration's names."""
    return {"polynomial": "", "b-spline": "_spline", "bins": "_bin"}[basis.kind] + str(number)


def _others(symbol: str) -> list[list[str]]:
    return [["" if a == b else f"{symbol}_{b}" for b in _XYZ] for a in _XYZ]


def _gyro(triad: GyroTriad, draws: _Draws) -> TriadTruth:
    axes, all_three = triad.axes, [[*_XYZ]] * 3
    bias = draws.draw("gyro", triad.bias, "bias", [["a"]] * 3, axes, counted=True)
    assert bias is not None
    scale = None
    if (section := triad.scale_factor) is not None:
        of_t, of_w = basis_truth(section.temperature), basis_truth(section.rate, "deg/s")
        size = _TYPICAL["scale_factor"] if section.prior is None else float(section.prior)
        values = size * draws.random.standard_normal((3, section.temperature.size, section.rate.size))
        powers = of_t.kind == of_w.kind == "polynomial" and max(values.shape[1:]) <= 10
        for row, axis in enumerate(_XYZ):
            for i, j in itertools.product(*map(range, values.shape[1:])):
                symbol = f"b{j}{i}" if powers else f"b{ordinal(of_w, j)}_{ordinal(of_t, i)}"
                if axis in axes:
                    draws.values[f"gyro_{axis}.{symbol}"] = float(values[row, i, j])
        scale = ScaleFactors(values, of_t, of_w)
    force = [[f"g_{a}" for a in row] for row in all_three]
    squares = [[f"gg_{a}" for a in row] for row in all_three]
    return TriadTruth(
        bias=bias,
        white=float(triad.angle_random_walk),
        walk=float(triad.rate_random_walk or 0.0),
        drifts=processes_of(triad.drift, triad.scale_factor_instability),
        scale=scale,
        misalignment=draws.draw("gyro", triad.misalignment, "misalignment", _others("m"), axes),
        force=draws.draw("gyro", triad.g_sensitivity, "g_sensitivity", force, axes),
        force_squared=draws.draw("gyro", triad.g_squared, "g_squared", squares, axes),
    )


def _accelerometer(triad: AccelerometerTriad, draws: _Draws) -> TriadTruth:
    axes, kind = triad.axes, "accelerometer"

    def own(section: Any, typical: str, symbol: str) -> Coefficients | None:
        return draws.draw(kind, section, typical, [[symbol]] * 3, axes)

    bias = own(triad.bias, "force_bias", "a")
    assert bias is not None
    return TriadTruth(
        bias=bias,
        white=float(triad.velocity_random_walk),
        drifts=processes_of(triad.drift),
        scale=own(triad.scale_factor, "scale_factor", "s"),
        misalignment=draws.draw(kind, triad.misalignment, "misalignment", _others("m"), axes),
        second=own(triad.second_order, "second_order", "k2"),
        third=own(triad.third_order, "third_order", "k3"),
        asymmetry=own(triad.asymmetry, "scale_factor", "asymmetry"),
        cross=draws.draw(kind, triad.cross_coupling, "second_order", [[f"k_{p}" for p in _PAIRS]] * 3, axes),
    )


def draw_unit_truth(spec: UnitSpec, seed: int, number: int) -> UnitTruth:
    """The hidden parameters of the unit of this number, in `names` by their names in the calibration, SI."""
    draws = _Draws(np.random.default_rng([seed, number, 20261]))
    sensor = spec.sensor
    gyro = None if sensor.gyro is None else _gyro(sensor.gyro, draws)
    accelerometer = None if sensor.accelerometer is None else _accelerometer(sensor.accelerometer, draws)
    lever = _LEVER_M * draws.random.standard_normal(3)
    clock = 0.0
    if sensor.sample_clock_error:
        clock = draws.values["sample_clock"] = float(sensor.sample_clock_error) * float(draws.random.standard_normal())
    of_gyros = lever + _APART_M * draws.random.standard_normal(3)
    return UnitTruth(gyro, accelerometer, tuple(lever.tolist()), tuple(of_gyros.tolist()), clock, draws.values)


def draw_table(spec: UnitSpec, seed: int) -> tuple[TableTruth, list[AxisTruth], dict[str, float]]:
    """The table's attitude and encoders, and those of its parameters that are in the calibration, by name, SI."""
    random = np.random.default_rng([seed, 20262])
    rig, named = spec.rig, dict[str, float]()
    table, site = rig.table, rig.site

    def draw(size: float, name: str) -> float:
        value = size * float(random.standard_normal())
        if size:
            named[name] = value
        return value

    base = draw(float(table.tilt), "tilt_east"), draw(float(table.tilt), "tilt_north")
    azimuth = draw(float(table.azimuth), "azimuth")
    leans = tuple(
        draw(float(a.orthogonality), f"orthogonality_{a.name}_{b.name}") for a, b in itertools.pairwise(table.axis)
    )
    encoders: list[AxisTruth] = []
    for number, axis in enumerate(table.axis, start=1):
        waves: list[tuple[int, float, float]] = []
        for harmonic in axis.angle.harmonics:
            size, order = float(harmonic.amplitude), harmonic.order
            # The calibration's sign is true angle less reading, the encoder's the opposite.
            cosine = draw(size, f"angle_{axis.name}_cos{order}")
            sine = draw(size, f"angle_{axis.name}_sin{order}")
            waves.append((order, -float(np.degrees(cosine)), -float(np.degrees(sine))))
        limit = None if np.isinf(axis.travel) else float(np.degrees(axis.travel))
        encoders.append(
            AxisTruth(
                lowest_deg=None if limit is None else -limit,
                highest_deg=limit,
                harmonics=tuple(waves),
                standstill_offset_deg=float(np.degrees(axis.angle.standstill_offset)),
                reading_noise_deg=float(np.degrees(axis.angle.reading_noise)),
                seed=16 * seed + number,
            )
        )
    in_case = spec.sensor.frame is not None and spec.sensor.frame.fixed_by == "case"
    mountings: list[Matrix] = []
    for number, mounting in enumerate(table.mounting, start=1):
        size = float(mounting.accuracy) if in_case else 0.0
        off = [draw(size, f"mounting{number}_{axis}") for axis in _XYZ]
        drawn = mounting.rotation or (0.0, 0.0, 0.0)
        mountings.append(np.array(mounting.columns).T @ turn_by([float(angle) for angle in drawn]) @ turn_by(off))
    truth = TableTruth(
        axes=tuple(axis.unit_vector for axis in table.axis),
        latitude=float(site.latitude),
        gravity=float(site.gravity) + draw(float(site.gravity_accuracy), "gravity"),
        base=(*base, azimuth),
        orthogonality=leans,
        mountings=tuple(mountings),
    )
    return truth, encoders, named


class SimulatedUnitLab(Laboratory):
    """The laboratory for one recipe's spec, with `units` units on the table. A context manager; `rig` is its rig file.

    `mounting`: the first mounting, from 0. `burst_s` is the time between bursts of a unit's bytes to the computer.
    """

    def __init__(
        self,
        spec: UnitSpec,
        clock: Clock,
        *,
        seed: int = 0,
        units: int = 1,
        mounting: int = 0,
        sample_rate_hz: float = 125.0,
        burst_s: float = 0.5,
        room_c: float = 23.0,
    ) -> None:
        super().__init__(spec.rig.chamber, spec.sensor.thermal_lag, room_c, clock)
        now, table = clock.now(), spec.rig.table
        truth, encoders, self._installation = draw_table(spec, seed)
        self.hanging = Hanging(mounting)
        self.axis_plants = [AxisPlant(encoder, now) for encoder in encoders]
        self.units: dict[str, SimulatedUnit] = {
            f"unit{number}": SimulatedUnit(
                draw_unit_truth(spec, seed, number),
                truth,
                self.chamber_plant,
                self.axis_plants,
                sample_rate_hz=sample_rate_hz,
                seed=64 * seed + number,
                hanging=self.hanging,
                start_s=now,
            )
            for number in range(1, units + 1)
        }
        axes = {axis.name: axis for axis in table.axis}
        plants = dict(zip(axes, self.axis_plants, strict=True))
        operator = SimulatedOperator(plants, clock, OperatorOptions(seed=seed), hang=self._hang)
        self._connect(
            axes,
            operator,
            self.units,
            by_hand=any(step.move.shape == "hand" for step in spec.schedule.steps),
            hangs=len(table.mounting) > 1,
            sample_rate_hz=sample_rate_hz,
            burst_s=burst_s,
        )

    def truths(self) -> dict[str, Any]:
        """The true parameters by their names in the calibrations, SI, for a file."""
        units = {name: unit.truth.names for name, unit in self.units.items()}
        return {"installation": self._installation, "units": units}

    def _hang(self, number: int) -> None:
        self.hanging.mounting = number - 1
