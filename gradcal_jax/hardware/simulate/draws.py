"""The hidden parameters of simulated devices, drawn from a spec's priors; for a flat prior of typical size."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.random import Generator, default_rng

from gradcal_jax import formulas
from gradcal_jax.hardware.simulate.imu import (
    FACTORS,
    ErrorTerm,
    ImuTruth,
    Kind,
    PlayTruth,
    Process,
    TableTruth,
    TriadTruth,
    rate_functions,
    turn_by,
)
from gradcal_jax.hardware.simulate.plants import AxisTruth, Floats
from gradcal_jax.spec.absent import absent_lever_arm
from gradcal_jax.spec.bases import PolynomialKeys
from gradcal_jax.spec.places import rotation_of
from gradcal_jax.spec.spec_sections import Spec

_XYZ: Final = "xyz"
# Distances of a unit from the intersection of the axes, and of its gyros from its accelerometers.
_LEVER_M: Final = 0.03
_APART_M: Final = 0.003
_TYPICAL_GRADIENT: Final[Mapping[Kind, float]] = {"gyro": np.radians(1.0) / 60.0, "accelerometer": 1e-3 * 9.8 * 60.0}
# The errors of each kind of sensor by the sections of the spec, in the order of their draws: size for a flat prior, SI.
_TYPICAL: Final[Mapping[Kind, Mapping[str, float]]] = {
    "gyro": {
        "bias": np.radians(0.02),
        "scale_factor": 1e-3,
        "misalignment": 1e-3,
        "g_sensitivity": np.radians(10.0) / 3600.0 / 9.8,
    },
    "accelerometer": {
        "bias": 5e-3 * 9.8,
        "scale_factor": 1e-3,
        "misalignment": 1e-3,
        "second_order": 1e-4 / 9.8,
    },
}
# The names of their coefficients in the calibration; a "_" is followed by an axis.
_SYMBOLS: Final = {"bias": "a", "scale_factor": "s", "misalignment": "m_", "g_sensitivity": "g_", "second_order": "k2"}


def _legendre(powers: PolynomialKeys, degree: int, x: Floats) -> Floats:
    """Legendre polynomials up to a degree, where a map has powers: no other map has a discrepancy."""
    return formulas.legendre((x - float(powers.centre)) / float(powers.scale), degree)


def _ordinal(basis: Any, number: int) -> str:
    """The end of a coefficient's name."""
    if basis is None or isinstance(basis, PolynomialKeys):
        return str(number)
    return f"_spline{number}" if basis.degree else f"_bin{number}"


def _processes(triad: Any) -> list[Process]:
    """Drifts, scale-factor errors, and the error of the measured temperature."""
    processes = [Process(float(of.standard_deviation), float(of.correlation_time), 1.0) for of in triad.drift]
    for of in triad.scale_factor_instability:
        processes.append(Process(float(of.standard_deviation), float(of.correlation_time), 0.0, 1.0))
    if (error := triad.thermometer_noise) is not None:
        lasts_s = np.inf if error.correlation_time is None else float(error.correlation_time)
        gains = float(error.bias_slope or 0.0), float(error.scale_factor_slope or 0.0)
        processes.append(Process(float(error.standard_deviation), lasts_s, *gains))
    return processes


class _TriadDraws:
    """Three sensors of a kind; `names` gets what is drawn, by its name in the calibration."""

    def __init__(self, kind: Kind, triad: Any, names: dict[str, float], generators: Sequence[Generator]) -> None:
        self.kind: Kind = kind
        self.triad, self.names = triad, names
        self.random, self.path, self.hidden = generators

    def truth(self) -> TriadTruth:
        triad, errors = self.triad, dict[str, ErrorTerm]()
        for name, typical in _TYPICAL[self.kind].items():
            if (section := getattr(triad, name)) is not None:
                errors[name] = self._error(name, section, typical)
        if triad.turn_on_bias:
            errors["turn_on_bias"] = self._turn_on(float(triad.turn_on_bias))
        gradient = self._gradient()
        for name in ("bias", "scale_factor"):
            if (hidden := getattr(getattr(triad, name, None), "discrepancy", None)) is not None:
                errors[f"{name}_discrepancy"] = self._beyond_map(getattr(triad, name), hidden)
        white, walk = (
            (triad.angle_random_walk, triad.rate_random_walk)
            if self.kind == "gyro"
            else (triad.velocity_random_walk, None)
        )
        loops = self._plays("hysteresis") + self._plays("scale_factor_hysteresis")
        return TriadTruth(errors, float(white), float(walk or 0.0), tuple(_processes(triad)), gradient, tuple(loops))

    def _error(self, name: str, section: Any, typical: float) -> ErrorTerm:
        of_t, of_rate, symbol = section.temperature, getattr(section, "rate", None), _SYMBOLS[name]
        basis, count = (None, 1) if of_t is None else (of_t.values, of_t.size)
        # A list of priors counts as a flat one.
        size = float(section.prior) if isinstance(section.prior, float) else typical
        # A gyro's coefficients over temperature are numbered also where there is one.
        numbered = count > 1 or of_rate is not None or (self.kind, name) == ("gyro", "bias")
        factors = FACTORS[name]
        if of_rate is not None:
            powers = all(isinstance(of, PolynomialKeys) for of in (of_t, of_rate)) and max(count, of_rate.size) <= 10
            symbols = [f"b{_ordinal(of_rate, j)}{'' if powers else '_'}" for j in range(of_rate.size)]
            factors = rate_functions(of_rate.values)
            values = size * self.random.standard_normal((3, count, of_rate.size)).swapaxes(1, 2)
        else:
            symbols = [symbol + axis for axis in _XYZ] if symbol.endswith("_") else [symbol]
            values = size * self.random.standard_normal((3, len(symbols), count))
        for row, column, power in np.ndindex(values.shape):
            axis = _XYZ[row]
            if axis not in self.triad.axes or symbols[column] == f"m_{axis}":
                values[row, column, power] = 0.0
                continue
            ending = _ordinal(of_t, power) if numbered else ""
            self.names[f"{self.kind}_{axis}.{symbols[column]}{ending}"] = float(values[row, column, power])
        return ErrorTerm(values, basis, factors)

    def _turn_on(self, size: float) -> ErrorTerm:
        """The bias of this power-on, a part of the bias's constant; splines and bins sum to one."""
        values = size * self.random.standard_normal((3, 1, 1))
        for row, axis in enumerate(_XYZ):
            for name in self.names:
                if axis in self.triad.axes and re.fullmatch(rf"{self.kind}_{axis}\.a(0|_(bin|spline)\d+)?", name):
                    self.names[name] += float(values[row, 0, 0])
        return ErrorTerm(values, None, FACTORS["bias"])

    def _three(self, random: Generator, size: float, name: str) -> tuple[float, ...]:
        """A named value of each of three sensors."""
        values = tuple((size * random.standard_normal(3)).tolist())
        named = zip(_XYZ, values, strict=True)
        self.names |= {f"{self.kind}_{axis}.{name}": value for axis, value in named if axis in self.triad.axes}
        return values

    def _gradient(self) -> tuple[float, ...]:
        triad, size = self.triad, self.triad.gradient_std
        if triad.bias_temperature_gradient is None:
            return (0.0, 0.0, 0.0)
        if triad.gradient_sensitivity is not None:
            return self._three(self.random, size or _TYPICAL_GRADIENT[self.kind], "bias_temperature_gradient")
        # Of a sensitivity that is not estimated no parameter has the name.
        return tuple((size * self.random.standard_normal(3)).tolist())

    def _plays(self, section: str) -> list[PlayTruth]:
        plays: list[PlayTruth] = []
        for play in getattr(self.triad, section):
            width_k = float(play.width)
            slopes = self._three(self.path, float(play.prior), f"{section}_{width_k:g}K")
            plays.append(PlayTruth(slopes, width_k, section != "hysteresis"))
        return plays

    def _beyond_map(self, section: Any, hidden: Any) -> ErrorTerm:
        """Structure of the size of a map's discrepancy: Legendre polynomials of the degrees that the map lacks."""
        of_t, of_rate = section.temperature, getattr(section, "rate", None)
        degree, degree_of_rate = hidden.temperature_degree, 0 if of_rate is None else hidden.rate_degree
        values = self.hidden.standard_normal((3, degree + 1, degree_of_rate + 1))
        values[:, : of_t.size, : 1 if of_rate is None else of_rate.size] = 0.0
        factors = FACTORS["bias"]
        if of_rate is not None:
            factors = rate_functions(partial(_legendre, of_rate, degree_of_rate))
        values = float(hidden.standard_deviation) * values.swapaxes(1, 2)
        return ErrorTerm(values, partial(_legendre, of_t, degree), factors)


def draw_truth(spec: Spec, seed: int, number: int) -> ImuTruth:
    """The hidden parameters of the unit of this number, in `names` by their names in the calibration, SI."""
    random, path, hidden, die = (default_rng([seed, number, k]) for k in (20261, 20265, 20267, 20268))
    sensor, names, triads = spec.sensor, dict[str, float](), dict[Kind, TriadTruth]()
    both: dict[Kind, Any] = {"gyro": sensor.gyro, "accelerometer": sensor.accelerometer}
    for kind, triad in both.items():
        if triad is not None:
            triads[kind] = _TriadDraws(kind, triad, names, (random, path, hidden)).truth()
    lever, clock = _LEVER_M * random.standard_normal(3), 0.0
    if sensor.sample_clock_error:
        clock = names["sample_clock"] = float(sensor.sample_clock_error) * float(random.standard_normal())
    felt = None if sensor.gyro is None else sensor.gyro.g_sensitivity
    stated_m = None if felt is None or felt.lever_arm is None else float(felt.lever_arm)
    if stated_m is not None and sensor.accelerometer is None:
        lever *= stated_m / _LEVER_M
    apart = random.standard_normal(3) * (_APART_M if stated_m is None else stated_m)
    of_gyros = lever + apart
    if sensor.gyro is not None and felt is not None and (stated_m or absent_lever_arm(spec)):
        names |= _rotation(names, of_gyros if sensor.accelerometer is None else apart, sensor.gyro.axes)
    late_s = float(sensor.temperature_lag or 0.0) * abs(float(die.standard_normal()))
    offset_k = float(sensor.temperature_offset or 0.0) * float(die.standard_normal())
    if offset_k:
        names["temperature_offset"] = offset_k
    levers = tuple(lever.tolist()), tuple(of_gyros.tolist())
    return ImuTruth(triads, *levers, clock, names, late_s, offset_k)


def _rotation(values: dict[str, float], lever: Floats, axes: Sequence[str]) -> dict[str, float]:
    """What gyros feel of rotation at a lever arm (m), where the specific force is known at its other end: coefficients
    of products of two rates in g · (ω(ω·d) − ω²d)."""
    found: dict[str, float] = {}
    for axis in axes:
        own = np.array([values.get(f"gyro_{axis}.g_{b}", values.get(f"gyro_{axis}.g_{b}0", 0.0)) for b in _XYZ])
        both = np.outer(own, lever) + np.outer(lever, own)
        for j, k in itertools.combinations_with_replacement(range(3), 2):
            value = both[j, k] if j != k else 0.5 * both[j, j] - own @ lever
            found[f"gyro_{axis}.ww_{_XYZ[j]}{_XYZ[k]}"] = float(value)
    return found


def draw_table(spec: Spec, seed: int) -> tuple[TableTruth, list[AxisTruth], dict[str, float]]:
    """The table's attitude and encoders, and those of its parameters that are in the calibration, by name, SI."""
    random, unshown = default_rng([seed, 20262]), default_rng([seed, 20269])
    table, site, named = spec.rig.table, spec.rig.site, dict[str, float]()

    def draw(size: float | None, name: str) -> float:
        value = float(size or 0.0) * float(random.standard_normal())
        if size:
            named[name] = value
        return value

    base = draw(table.tilt, "tilt_east"), draw(table.tilt, "tilt_north"), draw(table.azimuth, "azimuth")
    leans = tuple(draw(a.orthogonality, f"orthogonality_{a.name}_{b.name}") for a, b in itertools.pairwise(table.axis))
    encoders: list[AxisTruth] = []
    for number, axis in enumerate(table.axis, start=1):
        angle, waves = axis.angle, list[tuple[int, float, float]]()
        for harmonic in angle.harmonics:
            size, order = harmonic.amplitude, harmonic.order
            # The calibration's sign is true angle less reading, the encoder's the opposite.
            cosine = draw(size, f"angle_{axis.name}_cos{order}")
            sine = draw(size, f"angle_{axis.name}_sin{order}")
            waves.append((order, -float(np.degrees(cosine)), -float(np.degrees(sine))))
        truth = AxisTruth(
            tuple(waves),
            standstill_offset_deg=float(np.degrees(angle.standstill_offset)),
            reading_noise_deg=float(np.degrees(angle.reading_noise)),
            timing_error_s=float(angle.timing_error),
            rate_accuracy=float(table.rate_accuracy or 0.0),
            scale_error=float(angle.scale_error or 0.0) * float(unshown.standard_normal()),
            backlash_deg=abs(float(np.degrees(angle.backlash or 0.0)) * float(unshown.standard_normal())),
            seed=16 * seed + number,
        )
        encoders.append(truth)
    mountings: list[Floats] = []
    for number, mounting in enumerate(table.mounting, start=1):
        size = mounting.accuracy if _in_case(spec) else None
        off = [draw(size, f"mounting{number}_{axis}") for axis in _XYZ]
        if spec.is_one_axis and not _in_case(spec):  # which one gyro does not show
            off = (float(mounting.accuracy) * unshown.standard_normal(3)).tolist()
        mountings.append(rotation_of(mounting) @ turn_by(off))
    gravity = site.gravity_m_per_s2 + draw(site.gravity_accuracy, "gravity")
    axes = tuple(axis.unit_vector for axis in table.axis)
    # The Earth's rate along one axis of unknown direction is rectangular.
    latitude = float(np.arcsin(unshown.uniform(-1.0, 1.0))) if site.is_unknown else site.latitude_rad
    return TableTruth(axes, latitude, gravity, base, leans, tuple(mountings)), encoders, named


def draw_places(spec: Spec, truth: TableTruth, seed: int) -> list[TableTruth]:
    """The table as it holds the IMU at each place of a fixture, each off by the place's own accuracy."""
    random, tables = default_rng([seed, 20264]), list[TableTruth]()
    for place in spec.rig.table.place:
        off = (float(place.accuracy) if _in_case(spec) else 0.0) * random.standard_normal(3)
        held = rotation_of(place) @ turn_by(off)
        tables.append(replace(truth, mountings=tuple(mounting @ held for mounting in truth.mountings)))
    return tables


def _in_case(spec: Spec) -> bool:
    """Whether the mounting's error counts, as of a frame that is the case's."""
    return spec.sensor.frame == "case"
