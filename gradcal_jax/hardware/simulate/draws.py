"""The hidden parameters of simulated devices, drawn from a spec's priors; for a flat prior of typical size."""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.random import Generator, default_rng

from gradcal_jax import formulas
from gradcal_jax.hardware.simulate import imu
from gradcal_jax.hardware.simulate.imu import (
    ErrorTerm,
    Factors,
    ImuTruth,
    Kind,
    PlayTruth,
    Process,
    TableTruth,
    TriadTruth,
    Vectors,
    turn_by,
)
from gradcal_jax.hardware.simulate.plants import AxisTruth
from gradcal_jax.spec.absent import absent_lever_arm
from gradcal_jax.spec.bases import PolynomialKeys
from gradcal_jax.spec.places import rotation_of
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad
from gradcal_jax.spec.spec_sections import Spec

_XYZ: Final = "xyz"
# Distances of a unit from the intersection of the axes, and of its gyros from its accelerometers.
_LEVER_M: Final = 0.03
_APART_M: Final = 0.003
_PLAY: Final = "hysteresis_{:g}K"
_TYPICAL_GRADIENT: Final[dict[Kind, float]] = {"gyro": np.radians(1.0) / 60.0, "accelerometer": 1e-3 * 9.8 * 60.0}
_OTHERS: Final = [["" if a == b else f"m_{b}" for b in _XYZ] for a in _XYZ]
# The errors of each kind of sensor, in the order of their draws: section of the spec, size for a flat prior (SI),
# factors, and names of the coefficients by sensor axis, "" for none. The scale factor of gyros is M(T, ω).
_ERRORS: Final[dict[Kind, tuple[tuple[str, float, Factors, list[list[str]]], ...]]] = {
    "gyro": (
        ("bias", np.radians(0.02), imu.one, [["a"]] * 3),
        ("scale_factor", 1e-3, imu.one, []),
        ("misalignment", 1e-3, imu.all_inputs, _OTHERS),
        ("g_sensitivity", np.radians(10.0) / 3600.0 / 9.8, imu.all_forces, [[f"g_{a}" for a in _XYZ]] * 3),
    ),
    "accelerometer": (
        ("bias", 5e-3 * 9.8, imu.one, [["a"]] * 3),
        ("scale_factor", 1e-3, imu.own_input, [["s"]] * 3),
        ("misalignment", 1e-3, imu.all_inputs, _OTHERS),
        ("second_order", 1e-4 / 9.8, imu.own_squared, [["k2"]] * 3),
    ),
}


def _constant(x: Vectors) -> Vectors:
    return np.ones((len(x), 1))


def _ordinal(section: Any, number: int) -> str:
    kind = "" if isinstance(section, PolynomialKeys) else "_spline" if section.degree else "_bin"
    return f"{kind}{number}"


def _processes(triad: GyroTriad | AccelerometerTriad) -> Iterator[Process]:
    """Drifts, scale-factor errors, and the error of the measured temperature."""
    for of in triad.drift:
        yield Process(float(of.standard_deviation), float(of.correlation_time), 1.0)
    for of in triad.scale_factor_instability:
        yield Process(float(of.standard_deviation), float(of.correlation_time), 0.0, 1.0)
    if (error := triad.thermometer_noise) is not None:
        lasts = np.inf if error.correlation_time is None else float(error.correlation_time)
        gains = float(error.bias_slope or 0.0), float(error.scale_factor_slope or 0.0)
        yield Process(float(error.standard_deviation), lasts, *gains)


class _Draws:
    """What is drawn for the unit of a number; `values`: by its names in the calibration."""

    def __init__(self, seed: int, number: int) -> None:
        of = (20261, 20265, 20267, 20268)
        self.random, self.path, self.hidden, self.die = (default_rng([seed, number, k]) for k in of)
        self.values: dict[str, float] = {}

    def triad(self, kind: Kind, triad: Any) -> TriadTruth:
        errors: list[ErrorTerm] = []
        for name, typical, factors, symbols in _ERRORS[kind]:
            section: Any = getattr(triad, name)
            if section is not None:
                size = float(section.prior) if isinstance(section.prior, float) else typical
                if symbols:
                    errors.append(self._term(kind, section, size, factors, symbols, triad.axes))
                else:
                    errors.append(self._scale_factors(section, size, triad.axes))
        if triad.turn_on_bias:
            errors.append(self._turn_on(kind, float(triad.turn_on_bias), triad.axes))
        gradient = self._gradient(kind, triad)
        white = triad.angle_random_walk if kind == "gyro" else triad.velocity_random_walk
        walk = triad.rate_random_walk if kind == "gyro" else None
        errors += self._beyond_maps(triad)
        loops = tuple(self._plays(kind, triad))
        return TriadTruth(tuple(errors), float(white), float(walk or 0.0), tuple(_processes(triad)), gradient, loops)

    def _three(self, random: Generator, size: float, kind: Kind, name: str, axes: Sequence[str]) -> Vectors:
        """A named value of each of three sensors."""
        values = size * random.standard_normal(3)
        self.values |= {f"{kind}_{a}.{name}": float(v) for a, v in zip(_XYZ, values, strict=True) if a in axes}
        return values

    def _turn_on(self, kind: Kind, size: float, axes: Sequence[str]) -> ErrorTerm:
        """The bias of this power-on, a part of the bias's constant; splines and bins sum to one."""
        values = size * self.random.standard_normal((3, 1, 1))
        for row, axis in enumerate(_XYZ):
            for name in self.values:
                if axis in axes and re.fullmatch(rf"{kind}_{axis}\.a(0|_(bin|spline)\d+)?", name):
                    self.values[name] += float(values[row, 0, 0])
        return ErrorTerm(values, _constant, imu.one)

    def _gradient(self, kind: Kind, triad: Any) -> tuple[float, ...]:
        if triad.bias_temperature_gradient is None:
            return (0.0, 0.0, 0.0)
        # Of a sensitivity that is not estimated no parameter has the name.
        axes, typical = (triad.axes, _TYPICAL_GRADIENT[kind]) if triad.gradient_sensitivity is not None else ((), 0.0)
        size = triad.gradient_std or typical
        return tuple(self._three(self.random, size, kind, "bias_temperature_gradient", axes).tolist())

    def _term(
        self, kind: Kind, section: Any, size: float, factors: Factors, symbols: list[list[str]], axes: Sequence[str]
    ) -> ErrorTerm:
        of_t = section.temperature
        basis, count = (_constant, 1) if of_t is None else (of_t.values, of_t.size)
        values = size * self.random.standard_normal((3, len(symbols[0]), count))
        # A gyro's bias is numbered also where it is constant.
        counted = count > 1 or (kind, factors) == ("gyro", imu.one)
        for row, column, power in np.ndindex(values.shape):
            if symbols[row][column] and _XYZ[row] in axes:
                ending = ("0" if of_t is None else _ordinal(of_t, power)) if counted else ""
                self.values[f"{kind}_{_XYZ[row]}.{symbols[row][column]}{ending}"] = float(values[row, column, power])
            else:
                values[row, column, power] = 0.0
        return ErrorTerm(values, basis, factors)

    def _scale_factors(self, section: Any, size: float, axes: Sequence[str]) -> ErrorTerm:
        of_t, of_w = section.temperature, section.rate
        values = size * self.random.standard_normal((3, of_t.size, of_w.size))
        powers = all(isinstance(of, PolynomialKeys) for of in (of_t, of_w)) and max(values.shape[1:]) <= 10
        for row, i, j in np.ndindex(values.shape):
            symbol = f"b{j}{i}" if powers else f"b{_ordinal(of_w, j)}_{_ordinal(of_t, i)}"
            if _XYZ[row] in axes:
                self.values[f"gyro_{_XYZ[row]}.{symbol}"] = float(values[row, i, j])
        return ErrorTerm(values.transpose(0, 2, 1), of_t.values, imu.rate_functions(of_w.values))

    def _plays(self, kind: Kind, triad: Any) -> Iterator[PlayTruth]:
        for plays, name in ((triad.hysteresis, _PLAY), (triad.scale_factor_hysteresis, f"scale_factor_{_PLAY}")):
            for play in plays:
                width_k = float(play.width)
                slopes = self._three(self.path, float(play.prior), kind, name.format(width_k), triad.axes)
                yield PlayTruth(tuple(slopes.tolist()), width_k, name != _PLAY)

    def _beyond_maps(self, triad: Any) -> Iterator[ErrorTerm]:
        """Structure of the size of a triad's discrepancies: Legendre polynomials of degrees that its maps lack."""
        maps: Any = ((triad.bias, False), (getattr(triad, "scale_factor", None), True))
        for section, of_input in maps:
            if (of := getattr(section, "discrepancy", None)) is None:
                continue
            count, known = (of.rate_degree + 1, section.rate.size) if of_input else (1, 1)
            values = float(of.standard_deviation) * self.hidden.standard_normal((3, of.temperature_degree + 1, count))
            values[:, : section.temperature.size, :known] = 0.0
            basis = partial(_legendre, section.temperature, of.temperature_degree)
            factors = imu.one
            if of_input:
                factors = imu.rate_functions(partial(_legendre, section.rate, of.rate_degree))
            yield ErrorTerm(values.transpose(0, 2, 1), basis, factors)


def _legendre(powers: PolynomialKeys, degree: int, x: Vectors) -> Vectors:
    """Legendre polynomials up to a degree, where a map has powers: no other map has a discrepancy."""
    return formulas.legendre((x - float(powers.centre)) / float(powers.scale), degree)


def draw_truth(spec: Spec, seed: int, number: int) -> ImuTruth:
    """The hidden parameters of the unit of this number, in `names` by their names in the calibration, SI."""
    draws, sensor = _Draws(seed, number), spec.sensor
    names, random, normal = draws.values, draws.random, draws.die.standard_normal
    both: dict[Kind, Any] = {"gyro": sensor.gyro, "accelerometer": sensor.accelerometer}
    triads: dict[Kind, TriadTruth] = {k: draws.triad(k, triad) for k, triad in both.items() if triad is not None}
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
    late_s = float(sensor.temperature_lag or 0.0) * abs(float(normal()))
    offset_k = float(sensor.temperature_offset or 0.0) * float(normal())
    if offset_k:
        names["temperature_offset"] = offset_k
    levers = tuple(lever.tolist()), tuple(of_gyros.tolist())
    return ImuTruth(triads, *levers, clock, names, late_s, offset_k)


def _rotation(values: dict[str, float], lever: Vectors, axes: Sequence[str]) -> dict[str, float]:
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
    random = default_rng([seed, 20262])
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
    unshown = default_rng([seed, 20269])
    encoders: list[AxisTruth] = []
    for number, axis in enumerate(table.axis, start=1):
        waves: list[tuple[int, float, float]] = []
        for harmonic in axis.angle.harmonics:
            size, order = float(harmonic.amplitude), harmonic.order
            # The calibration's sign is true angle less reading, the encoder's the opposite.
            cosine = draw(size, f"angle_{axis.name}_cos{order}")
            sine = draw(size, f"angle_{axis.name}_sin{order}")
            waves.append((order, -float(np.degrees(cosine)), -float(np.degrees(sine))))
        noise_deg = float(np.degrees(axis.angle.standstill_offset)), float(np.degrees(axis.angle.reading_noise))
        errors = *noise_deg, float(axis.angle.timing_error), float(table.rate_accuracy or 0.0)
        scale = float(axis.angle.scale_error or 0.0) * float(unshown.standard_normal())
        lash = abs(float(np.degrees(axis.angle.backlash or 0.0)) * float(unshown.standard_normal()))
        encoders.append(AxisTruth(tuple(waves), *errors, scale, lash, seed=16 * seed + number))
    in_case = _in_case(spec)
    mountings: list[Vectors] = []
    for number, mounting in enumerate(table.mounting, start=1):
        size = float(mounting.accuracy) if in_case else 0.0
        off = [draw(size, f"mounting{number}_{axis}") for axis in _XYZ]
        if spec.is_one_axis and not in_case:  # which one gyro does not show
            off = (float(mounting.accuracy) * unshown.standard_normal(3)).tolist()
        mountings.append(rotation_of(mounting) @ turn_by(off))
    gravity = site.gravity_m_per_s2 + draw(float(site.gravity_accuracy), "gravity")
    axes = tuple(axis.unit_vector for axis in table.axis)
    # The Earth's rate along one axis of unknown direction is rectangular.
    latitude = float(np.arcsin(unshown.uniform(-1.0, 1.0))) if site.is_unknown else site.latitude_rad
    truth = TableTruth(axes, latitude, gravity, (*base, azimuth), leans, tuple(mountings))
    return truth, encoders, named


def draw_places(spec: Spec, truth: TableTruth, seed: int) -> list[TableTruth]:
    """The table as it holds the IMU at each place of a fixture, each off by the place's own accuracy."""
    random, in_case = default_rng([seed, 20264]), _in_case(spec)
    tables: list[TableTruth] = []
    for place in spec.rig.table.place:
        off = (float(place.accuracy) if in_case else 0.0) * random.standard_normal(3)
        held = rotation_of(place) @ turn_by(off)
        tables.append(replace(truth, mountings=tuple(mounting @ held for mounting in truth.mountings)))
    return tables


def _in_case(spec: Spec) -> bool:
    """Whether the mounting's error counts, as of a frame that is the case's."""
    return spec.sensor.frame == "case"
