"""A spec in the core's terms: its channels, its installation, and the motion of the table."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from gradcal_jax.formulas import EARTH_RATE
from gradcal_jax.model.bases import Basis, BSpline, Polynomial
from gradcal_jax.model.imu import KINDS, Channel, ChannelKind, EncoderNoise, ImuModel
from gradcal_jax.model.installation import (
    AxisHarmonics,
    BaseTilt,
    CommonScale,
    InstallationTerm,
    MountingError,
    NonOrthogonality,
)
from gradcal_jax.model.nodes import AXIS_NAMES, BodyNodes
from gradcal_jax.model.noise import Processes, constant, gauss_markov, no_processes, rate_random_walk
from gradcal_jax.model.path import Hysteresis
from gradcal_jax.model.terms import (
    BIAS,
    SCALE_FACTOR,
    SLOPE,
    GradientOfBias,
    Map,
    OwnTerm,
    ProductTerm,
    Term,
    known_terms,
    make_map,
    term_of_class,
)
from gradcal_jax.motion import TableMotion, body_nodes
from gradcal_jax.motion.plan_motion import moves_alike, plan_motion
from gradcal_jax.spec.bases import PolynomialKeys
from gradcal_jax.spec.bench import Rig
from gradcal_jax.spec.memory import too_large
from gradcal_jax.spec.plan import StandardPlan
from gradcal_jax.spec.sensor import AccelerometerTriad, GyroTriad, Sensor
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.spec.temperature_path import GeneralTerm

# Names of terms, for requirements and sentences.
MISALIGNMENT = "misalignment_{}"
HYSTERESIS = "hysteresis_{}K"
SCALE_FACTOR_HYSTERESIS = "scale_factor_hysteresis_{}K"
ROTATION = "ww_"
_LAGGED = 16
# Standard deviation of an angle that is known exactly, rad: far below any encoder's.
_EXACT = 1e-12
# Standard deviation (rad) of a standstill's angle that no encoder tells: unknown beside what gravity and the gyros say,
# and small enough for a covariance in double precision to hold 0.1 µrad beside it.
_UNKNOWN = 3.0

Triad = GyroTriad | AccelerometerTriad


class BuiltImu(NamedTuple):
    """An IMU's spec in the core's terms. `motion`: of the plan. `points`: quadrature points along a piece for functions
    of temperature, which are smooth there (`rough`: not along the pieces of a log). `about` `(p,)`: the parameters of
    an estimate, by which its errors act; None: an ideal sensor's. `gears`: of what the spec itself names (`gears_of`).
    """

    spec: Spec
    model: ImuModel
    motion: TableMotion
    points: int
    rough: bool
    about: np.ndarray | None = None
    gears: Sequence[tuple[float, float]] = ()

    def body_nodes(self) -> BodyNodes:
        """The nodes on which the terms are integrated."""
        return body_nodes(self.motion, self.points)


def build_imu(spec: Spec, like: BuiltImu | None = None) -> BuiltImu:
    """Model and motion of an IMU's spec. `like`: an IMU with the same plan and other error terms, whose motion serves
    if the terms need the same pieces. Errors: `MemoryError` for a plan with more readings than this machine can hold,
    `ValueError` for a fixture of several IMUs."""
    if spec.rig.table.place:
        raise ValueError(
            "the spec has a fixture of several IMUs, and only predict, optimise and estimate support fixtures; for "
            "other commands, write the mounting of one place as rig.table.mounting, and remove rig.table.place"
        )
    if too := too_large(spec):
        raise MemoryError(too)
    # (Sections are frozen.)
    of = spec.sensor, spec.rig, _has_common_clock(spec), known_terms()
    model = _model(*of)  # pyright: ignore[reportArgumentType]
    bases = [term.whole.temperature for term in model.terms if isinstance(term, Map)]
    # A lagging unit's exponentials are no polynomials; a play is linear in T on each piece.
    own = any(isinstance(t, OwnTerm) and not isinstance(t, Hysteresis | ProductTerm) for t in model.terms)
    exponential = spec.sensor.lag is not None or own
    least = _LAGGED if exponential else 2 if model.knows_path else 1
    points = max(least, *(basis.degree + 1 for basis in bases))
    rough = model.knows_path or any(basis.breaks for basis in bases)
    gears = gears_of(spec) if like is None else like.gears
    motion = like.motion if like is not None and _alike(spec, model, like) else plan_motion(spec, model)
    return BuiltImu(spec, model, motion, points, rough, gears=gears)


def _alike(spec: Spec, model: ImuModel, like: BuiltImu) -> bool:
    line = like.motion.line
    return moves_alike(spec, model, line) == moves_alike(like.spec, like.model, line)


def gears_of(spec: Spec) -> list[tuple[float, float]]:
    """Standard deviations of scale error and backlash (rad) of every axis, as far as the covariance of readings is to
    contain them; empty: none. Readings along the only axis of a table take a scale error for one of the gyro's: there
    it counts instead, and so does a typical one of any axis."""
    table = spec.rig.table
    if table.by_gravity or isinstance(spec.plan, StandardPlan):
        return []
    angles = [axis.angle for axis in table.axis]
    scaled = not spec.is_one_axis and all(angle.scale_error is not None for angle in angles)
    sizes = [(float(a.scale_error or 0.0) * scaled, float(a.backlash or 0.0)) for a in angles]
    return sizes if np.any(sizes) else []


def unweighted_estimator(spec: Spec) -> bool:
    """Whether the spec's estimator is ordinary least squares on the points' rates, as in the paper's figure."""
    return isinstance(spec.plan, StandardPlan) and spec.plan.estimator == "least squares"


def _has_common_clock(spec: Spec) -> bool:
    """Whether the sample clock is a parameter common to all channels; independent points each have their own."""
    return not isinstance(spec.plan, StandardPlan) or spec.plan.points == "one run"


@lru_cache(maxsize=16)
def _model(sensor: Sensor, rig: Rig, common_clock: bool, _classes: tuple[type[OwnTerm], ...]) -> ImuModel:
    """The model of a sensor on a rig; kept, since the points of a sweep have plans of their own only. `_classes`: of
    terms, which may be defined anew."""
    channels: list[Channel] = []
    for kind in KINDS:
        triad = getattr(sensor, kind)
        if triad is None:
            continue
        processes = sum(_processes(sensor, rig, common_clock, triad), no_processes())
        white = np.asarray(float(getattr(triad, _WHITE[kind])))
        for axis in triad.axes:
            terms = tuple(_terms(triad, kind, axis))
            channels.append(Channel(terms, white, processes, kind, AXIS_NAMES.index(axis)))
    return ImuModel(tuple(channels), tuple(_installation(sensor, rig, common_clock)), _encoder(rig))


def _encoder(rig: Rig) -> EncoderNoise:
    table = rig.table

    def of_axes(name: str) -> np.ndarray:
        return np.array([float(getattr(axis.angle, name)) for axis in table.axis])

    offset, reading, every = map(of_axes, ("standstill_offset", "reading_noise", "read_every"))
    if table.by_gravity:
        count = len(table.axis)
        offset, reading, every = np.full(count, _UNKNOWN), np.zeros(count), np.full(count, np.inf)
    rate, held = np.asarray(float(table.rate_accuracy or 0.0)), table.standing == "held"
    has_offset = held or bool(np.any(offset))
    return EncoderNoise(offset, reading, every, held, of_axes("timing_error"), rate, has_offset)


def _installation(sensor: Sensor, rig: Rig, common_clock: bool) -> Iterator[InstallationTerm]:
    table, site, force = rig.table, rig.site, sensor.accelerometer

    def known(*sizes) -> np.ndarray:
        # A zero prior would be no prior: an angle that is known exactly keeps a tiny one.
        return np.maximum([float(size) for size in sizes], _EXACT)

    if table.tilt or table.azimuth:
        yield BaseTilt(known(table.tilt, table.tilt, table.azimuth))
    if len(table.axis) > 1 and any(a.orthogonality for a in table.axis):
        sizes = known(*(axis.orthogonality for axis in table.axis[:-1]))
        yield NonOrthogonality(sizes, tuple(axis.name for axis in table.axis))
    for k, axis in enumerate(table.axis):
        if harmonics := axis.angle.harmonics:
            stds = np.repeat([float(h.amplitude) for h in harmonics], 2)
            yield AxisHarmonics(stds, tuple(h.order for h in harmonics), k, axis.name)
    if sensor.frame == "case":
        yield MountingError(np.repeat([float(m.accuracy) for m in table.mounting], 3))
    if site.gravity_accuracy and force is not None:
        yield CommonScale(np.array([float(site.gravity_accuracy)]), "gravity")
    timed = force is not None and force.velocity_increments
    if sensor.clock_error and common_clock and (timed or sensor.gyro is not None):
        yield CommonScale(np.array([sensor.clock_error]), "sample_clock", forces=timed)


# The axes to which the terms of a section belong: none, the other axes, all of them.
_OVER: dict[str, Callable[[str], Iterable[tuple[str, ...]]]] = {
    "itself": lambda _: [()],
    "others": lambda axis: [(b,) for b in AXIS_NAMES if b != axis],
    "all": lambda _: [(b,) for b in AXIS_NAMES],
}
# Section, axes, signals ({own}: the channel's axis), name, symbol, SI unit.
_MAPS: dict[ChannelKind, tuple[tuple[str, str, tuple[str, ...], str, str, str], ...]] = {
    "gyro": (
        ("bias", "itself", (), BIAS, "a", "rad/s"),
        ("scale_factor", "itself", ("rate {own}",), SCALE_FACTOR, "b", "1"),
        ("misalignment", "others", ("rate {}",), MISALIGNMENT, "m_{}", "rad"),
        ("g_sensitivity", "all", ("force {}",), "g_sensitivity_{}", "g_{}", "rad/s/(m/s^2)"),
    ),
    "accelerometer": (
        ("bias", "itself", (), BIAS, "a", "m/s^2"),
        ("scale_factor", "itself", ("force {own}",), SCALE_FACTOR, "s", "1"),
        ("misalignment", "others", ("force {}",), MISALIGNMENT, "m_{}", "rad"),
        ("second_order", "itself", ("force {own}",) * 2, "second_order", "k2", "1/(m/s^2)"),
    ),
}
_WHITE: dict[ChannelKind, str] = {"gyro": "angle_random_walk", "accelerometer": "velocity_random_walk"}


def _processes(sensor: Sensor, rig: Rig, common_clock: bool, triad: Triad) -> Iterator[Processes]:
    """The noise processes of a channel: its own, the sample clock where it is no common parameter of all channels, and
    the Earth's rate where no bias is estimated that includes it."""
    for d in triad.drift:
        yield gauss_markov(float(d.standard_deviation), float(d.correlation_time))
    gyro = triad if isinstance(triad, GyroTriad) else None
    if gyro is not None and gyro.rate_random_walk:
        yield rate_random_walk(float(gyro.rate_random_walk))
    for d in triad.scale_factor_instability:
        figures = float(d.standard_deviation), float(d.correlation_time)
        yield gauss_markov(*figures, bias_gain=0.0, rate_gain=1.0, source="scale-factor instability")
    if (error := triad.thermometer_noise) is not None:
        # All channels share a thermometer, but the signs of their slopes are unknown: their errors are uncorrelated.
        gains = {"bias_gain": float(error.bias_slope or 0.0), "rate_gain": float(error.scale_factor_slope or 0.0)}
        time = np.inf if error.correlation_time is None else float(error.correlation_time)
        yield gauss_markov(float(error.standard_deviation), time, **gains, source="temperature measurement")
    if gyro is not None and sensor.clock_error and not common_clock:
        yield constant(sensor.clock_error, rate_gain=1.0, source="sample clock")
    if triad.turn_on_bias and triad.bias is None:
        yield constant(float(triad.turn_on_bias), bias_gain=1.0)
    if gyro is not None and rig.site.is_unknown and gyro.bias is None:
        # Rectangular within the whole rate.
        yield constant(EARTH_RATE / 3.0**0.5, bias_gain=1.0, source="Earth's rate")


def _terms(triad: Triad, kind: ChannelKind, axis: str) -> Iterator[Term]:
    """The terms of a channel in the order of its parameters."""
    beyond: list[Term] = []
    for key, over, signals, name, symbol, unit in _MAPS[kind]:
        if getattr(triad, key) is not None:
            for of in _OVER[over](axis):
                own = tuple(signal.format(*of, own=axis) for signal in signals)
                term = _map(triad, key, name=name.format(*of), symbol=symbol.format(*of), unit=unit, signals=own)
                yield term
                if term.beyond is not None:
                    beyond.append(term.beyond)
    if isinstance(triad, GyroTriad):
        yield from _rotation_terms(triad)
    unit, own = ("rad/s", f"rate {axis}") if kind == "gyro" else ("m/s^2", f"force {axis}")
    if (gradient := triad.gradient_sensitivity) is not None:
        yield GradientOfBias(std=float(or_infinite(gradient.prior)), unit="rad/K" if kind == "gyro" else "m/s/K")
    plays = [(play, HYSTERESIS, f"{unit}/K", ()) for play in triad.hysteresis]
    plays += [(play, SCALE_FACTOR_HYSTERESIS, "1/K", (own,)) for play in triad.scale_factor_hysteresis]
    for play, name, of_play, signals in plays:
        prior, width = np.asarray(float(play.prior)), np.asarray(float(play.width))
        called = name.format(f"{float(width):g}")
        yield Hysteresis(std=prior, name=called, unit=of_play, signals=signals, width=width)
    for one in triad.term:
        yield _general_term(one, unit, own)
    yield from beyond


def _map(triad: Triad, key: str, **named) -> Map:
    """The map of a section with its priors. The constant of a bias *is* this run's turn-on bias, so their priors
    add."""
    section = getattr(triad, key)
    temperature, rate, beyond = (getattr(section, of, None) for of in ("temperature", "rate", "discrepancy"))
    hidden = None
    if beyond is not None:
        hidden = float(beyond.standard_deviation), beyond.temperature_degree, getattr(beyond, "rate_degree", 0)
    return make_map(
        None if temperature is None else basis(temperature),
        None if rate is None else basis(rate),
        discrepancy=hidden,
        numbered=isinstance(triad, GyroTriad) and key == "bias",
        prior_std=or_infinite(section.prior),
        smoothness_std=float(or_infinite(getattr(section, "smoothness", None))),
        common_std=float(triad.turn_on_bias or 0.0) if key == "bias" else 0.0,
        **named,
    )


def _rotation_terms(gyro: GyroTriad) -> Iterator[ProductTerm]:
    """Bias of a gyro by six products of two rates: its sensitivity to acceleration, times the centripetal acceleration
    at its place, from where the specific force is known."""
    if gyro.g_sensitivity is None or not (std := gyro.g_sensitivity.of_rotation):
        return
    for of in combinations_with_replacement(AXIS_NAMES, 2):
        signals = tuple(f"rate {a}" for a in of)
        yield ProductTerm(std=np.asarray(std), name=f"{ROTATION}{''.join(of)}", unit="s", signals=signals)


def _general_term(one: GeneralTerm, of_bias: str, own: str) -> OwnTerm:
    """A `[[term]]` of a channel with the unit `of_bias` of its bias and the input `own`."""
    unit, std = one.si_unit(of_bias), np.asarray(one.prior_in_si(of_bias))
    if one.class_name is not None:
        return term_of_class(one.class_name, float(std), one.name, unit)
    signals = [own] if one.target == "scale_factor" else []
    signals += [factor for factor in one.factors if factor != SLOPE]
    slopes = one.factors.count(SLOPE)
    return ProductTerm(std=std, name=one.name, unit=unit, signals=tuple(signals), slopes=slopes)


def basis(section) -> Basis:
    """A basis of the core from its section of a spec."""
    if isinstance(section, PolynomialKeys):
        return Polynomial(section.degree, float(section.centre), float(section.scale))
    return BSpline(knots=tuple(float(k) for k in section.knots), degree=section.degree)


def or_infinite(value: float | tuple[float, ...] | None) -> np.ndarray:
    """The prior's standard deviation, or that of each coefficient; infinite (a flat prior) where it is absent."""
    return np.asarray(np.inf if value is None else value, dtype=float)
