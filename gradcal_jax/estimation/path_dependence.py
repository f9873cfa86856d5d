"""How a sensor's bias in a record depends on the path of temperature: half the difference between heating and cooling,
curves of the bias over temperature, and terms that explain what the maps of a model lack.

Plays of several half-widths, dT/dt at once and late by several lags, transients from power-on, the second thermometer's
difference, and a lag of the maps of the bias are columns beside those of the model, of all channels. The whitened rows
are independent, so nothing is estimated anew. Terms are taken one after another, each time the one with which
χ² + 2·(number of coefficients) is least, while it gains more than chance (by the number of candidates) does.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from gradcal_jax.estimation import Estimate, ImuEstimate, ImuReadings, Whitened, solve, split
from gradcal_jax.information import segments_of
from gradcal_jax.information.imu_residual import UNITS_OF_TERMS
from gradcal_jax.model import (
    BIAS,
    SECOND,
    TEMPERATURE_GRADIENT,
    BSpline,
    Channel,
    GradientOfBias,
    HalfDifference,
    Hysteresis,
    ImuModel,
    Map,
    OtherTemperature,
    PathTerm,
    SignalMap,
    TemperatureDifference,
    Term,
    TurnOnTransient,
)
from gradcal_jax.spec.absent import path_terms_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.display import summary
from gradcal_jax.units import parse

HEATING_AGAINST_COOLING = "heating against cooling"
# Half-widths that are tried, K, up to this share of the range of temperature.
_WIDTHS, _LARGEST_SHARE = (2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0), 0.5
# Time constants of lags and of transients that are tried, s, up to this share of the record.
_LAGS, _TRANSIENTS, _LONGEST_SHARE = (20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0), (60.0, 240.0, 960.0), 0.25
# The prior of what is tried, in plays of 10 K of the typical figure of the class.
_TYPICAL = 30.0
# The most terms that are taken together.
_MOST_TERMS = 3
# Standard deviations beyond which a coefficient is stated.
STATED = 4.0
# Chance below which a term is offered.
_OFFERED = 1e-4
# A width or a time constant within this share of one that the model has is not tried.
_ALIKE = 0.2
_ENTRY = '{{{{ time_constant = "{} s", prior = "{{}}" }}}}'


class OfferedTerm(NamedTuple):
    """A term of every channel: in `words`, the `key` of the spec and its `entry`, with the prior to be filled in; χ²
    over degrees of freedom without it and with it, the chance of heating against cooling with it, and its coefficients
    by channel, SI, with standard deviations (none for a lag of the maps), and their `units` by kind of channel."""

    words: str
    key: str
    entry: str
    before: float
    after: float
    chance: float
    coefficients: dict[str, tuple[float, float]]
    units: dict[str, str]

    @property
    def explains(self) -> bool:
        """Whether heating and cooling agree with it."""
        return self.chance > _OFFERED


class _Amount(NamedTuple):
    """The SI unit of a coefficient by the kind of its channel, and its prior for a bias of 1 SI."""

    units: dict[str, str]
    prior: float


_BIAS = _Amount({"gyro": "rad/s", "accelerometer": "m/s^2"}, 1.0)
_PER_K = _Amount({"gyro": "rad/s/K", "accelerometer": "m/s^2/K"}, 0.1)
_PER_SLOPE = _Amount({"gyro": "rad/K", "accelerometer": "m/s/K"}, 60.0)


class _Candidate(NamedTuple):
    """`make`: a term with standard deviation and SI unit of its coefficient, an `amount`; None: the map of the bias
    with a `lag` (s), in the place of that without."""

    words: str
    key: str
    entry: str
    amount: _Amount = _BIAS
    make: Callable[..., Term] | None = None
    lag: float = 0.0

    def term(self, spec: Spec, c: Channel) -> Term | None:
        """The term of a channel; None where it has no map that may lag."""
        if self.make is not None:
            std = np.asarray(_TYPICAL * size_of_class(spec, c.kind) * self.amount.prior)
            return self.make(std=std, name=self.words, si_unit=self.amount.units[c.kind])
        of = _prompt_bias(c)
        return None if of is None else replace(of, late=OtherTemperature.late(self.lag), name=self.words)


def _prompt_bias(c: Channel) -> Map | SignalMap | None:
    """The map of a channel's bias, where it has one without a lag."""
    of = c.model.term(BIAS)
    return of if isinstance(of, Map | SignalMap) and of.late is None else None


def with_terms(
    readings: ImuReadings, solution: ImuEstimate, terms_of: Callable[[Channel], Sequence[Term]]
) -> tuple[Whitened, ImuModel]:
    """The whitened rows with further terms of every channel, and their model."""
    model, begin = readings.model, 0
    channels: list[Channel] = []
    former: list[np.ndarray] = []
    for c in model.channels:
        more = replace(c.model, terms=(*c.model.terms, *terms_of(c)))
        channels.append(replace(c, model=more))
        former.append(begin + np.arange(c.model.size))
        begin += more.size
    extended = replace(model, channels=tuple(channels))
    former.append(begin + np.arange(model.size - model.calibrated))
    # The new terms' own columns at the nominal table: the effect of its errors on them is of second order.
    steps, columns = readings._replace(model=extended, points=0).linear(None)
    known, rows = np.concatenate(former), np.zeros((int(np.count_nonzero(solution.used)), extended.size))
    new = np.setdiff1d(np.arange(extended.size), known)
    rows[:, new] = readings.whitened(steps, columns[:, new])
    rows[:, known] = solution.white.rows
    return Whitened(rows, solution.white.data, extended.prior_rows()), extended


def size_of_class(spec: Spec, kind: str) -> float:
    """Typical coefficient of a play of 10 K in the class of a kind of channel times 10 K, SI."""
    value = next(t.value for t in path_terms_of(spec.sensor, kind) if t.key == "hysteresis")[0]["prior"]
    return 10.0 * parse(value, "bias slope" if kind == "gyro" else "acceleration slope")


def _candidates(readings: ImuReadings, span_k: float, lasting_s: float) -> list[_Candidate]:
    """What may be tried on a record of a range of temperature and a duration, beside the terms of the model."""
    known = [t for t in readings.model.terms if not getattr(t, "signals", ())]
    plays = [float(t.width) for t in known if isinstance(t, Hysteresis)]
    others = [t.other for t in known if isinstance(t, TemperatureDifference)]
    transients = [float(t.time_constant) for t in known if isinstance(t, TurnOnTransient)]
    longest = _LONGEST_SHARE * lasting_s
    found: list[_Candidate] = []

    def add(words: str, key: str, entry: str, amount: _Amount, make: Callable[..., Term], **of: Any) -> None:
        found.append(_Candidate(words, key, entry, amount, partial(make, **of)))

    for w in _untried(_WIDTHS, _LARGEST_SHARE * span_k, plays):
        entry, of = f'{{{{ width = "{w:g} K", prior = "{{}}" }}}}', {"width": np.asarray(w), "signals": ()}
        add(f"a play of {w:g} K", "hysteresis", entry, _PER_K, Hysteresis, **of)
    if not any(t.name == TEMPERATURE_GRADIENT for t in known):
        add("dT/dt", TEMPERATURE_GRADIENT, '{{ prior = "{}" }}', _PER_SLOPE, GradientOfBias, has_prior=True)
    for tau in _untried(_LAGS, longest, [other.lag for other in others if other.name != SECOND]):
        late = {"other": OtherTemperature.late(tau), "gain": -1.0 / tau, "signals": ()}
        words, key = f"dT/dt delayed by {tau:g} s", "late_temperature_gradient"
        add(words, key, _ENTRY.format(f"{tau:g}"), _PER_SLOPE, TemperatureDifference, **late)
    for tau in _untried(_TRANSIENTS, longest, transients):
        words, of = f"a transient from power-on of {tau:g} s", {"time_constant": np.asarray(tau), "signals": ()}
        add(words, "turn_on_transient", _ENTRY.format(f"{tau:g}"), _BIAS, TurnOnTransient, **of)
    if readings.log.second_c is not None and not any(other.name == SECOND for other in others):
        of = {"other": OtherTemperature(SECOND, 0.0), "gain": 1.0, "signals": ()}
        words, key = "the temperature difference between the two thermometers", "thermometer_difference"
        add(words, key, '{{ prior = "{}" }}', _PER_K, TemperatureDifference, **of)
    lags = [tau for tau in _LAGS if tau <= longest]
    return found + [_Candidate(f"a lag of the bias of {t:g} s", "bias.lag", f'"{t:g} s"', lag=t) for t in lags]


def _untried(values: Sequence[float], largest: float, known: Sequence[float]) -> list[float]:
    return [v for v in values if v <= largest and not any(abs(v - other) < _ALIKE * other for other in known)]


def _places(model: ImuModel, name: str, channels: Sequence[Channel]) -> np.ndarray:
    """`(p,)`: whether a parameter is one of the term of that name, in these channels."""
    mask = np.zeros(model.size, bool)
    for c in channels:
        mask[model.where(c.kind, c.axis, name)] = True
    return mask


def offered_terms(
    spec: Spec, readings: ImuReadings, solution: ImuEstimate, temperature: np.ndarray, heating: np.ndarray
) -> tuple[OfferedTerm, ...]:
    """The terms that reduce χ² most, one after the other, each with those before it: until heating and cooling agree,
    or none does so beyond chance. `temperature` (°C) and `heating` of every row that is used. Errors: none."""
    time, degrees = readings.log.time_s, max(solution.estimate.degrees, 1)
    left = _candidates(readings, float(np.ptp(temperature)), float(time[-1] - time[0]))
    white, extended = with_terms(
        readings, solution, lambda c: [t for one in left if (t := one.term(spec, c)) is not None]
    )

    own = {one.words: _places(extended, one.words, extended.channels) for one in left}
    maps = _places(extended, BIAS, [c for c in extended.channels if _prompt_bias(c) is not None])
    kept = ~np.any([np.zeros(extended.size, bool), *own.values()], axis=0)
    short, offered = white.condensed(), list[OfferedTerm]()
    fit = solve(short.without(~kept))
    while left and len(offered) < _MOST_TERMS and not (offered and offered[-1].explains):
        tried: list[tuple[float, int, _Candidate, np.ndarray, Estimate]] = []
        for one in left:
            chosen = (kept | own[one.words]) & ~(maps & bool(one.lag))
            added = int(np.count_nonzero(chosen) - np.count_nonzero(kept))
            now = solve(short.without(~chosen))
            tried.append((float(now.chi_squared) + 2.0 * added, added, one, chosen, now))
        _, added, one, chosen, now = min(tried, key=lambda of: of[0])
        gained = max(float(fit.chi_squared - now.chi_squared), 0.0)
        if chdtrc(max(added, 1), gained) * len(left) > _OFFERED:
            break
        after = split(white.without(~chosen), HEATING_AGAINST_COOLING, heating, np.eye(int(np.count_nonzero(chosen))))
        deviations, rank = now.known.deviations(np.eye(int(np.count_nonzero(chosen)))), np.cumsum(chosen) - 1
        coefficients: dict[str, tuple[float, float]] = {}
        for c in extended.channels:
            where = extended.where(c.kind, c.axis, one.words)
            if not one.lag and where.stop > where.start:
                at = rank[where.start]
                coefficients[c.name] = float(now.parameters[at]), float(deviations[at])
        chance = 1.0 if after is None else after.agreement.probability
        before, with_it = (float(of.chi_squared) / degrees for of in (fit, now))
        offered.append(
            OfferedTerm(one.words, one.key, one.entry, before, with_it, chance, coefficients, one.amount.units)
        )
        kept, fit, maps = chosen, now, maps & (not one.lag)
        left = [other for other in left if other is not one and not (one.lag and other.lag)]
    return tuple(offered)


def offer_sentences(spec: Spec, offered: Sequence[OfferedTerm]) -> list[str]:
    """What the terms explain, one after the other, and what to put into the spec for them."""
    sentences: list[str] = []
    for number, one in enumerate(offered):
        also = f"with {' and '.join(o.words for o in offered[:number])}, " if number else ""
        whole = "explains the difference" if one.explains else "explains a part of the difference"
        sentences.append(f"{also}{one.words} {whole}: χ² over degrees of freedom {one.before:.3g} → {one.after:.3g}")
    if offered:
        sentences[-1] += f"; to estimate this, write {' and '.join(_keys(spec, offered))}"
    return sentences


def _keys(spec: Spec, offered: Sequence[OfferedTerm]) -> list[str]:
    """Keys of the spec for the terms, of the kinds of channels in which they are significant."""
    found: dict[str, list[str]] = {}
    for kind in ("gyro", "accelerometer"):
        for one in offered:
            own = [v for name, v in one.coefficients.items() if name.startswith(kind)]
            entry = one.entry
            if own and max(abs(value) / std for value, std in own) > STATED:
                unit, factor = UNITS_OF_TERMS[one.units[kind]]
                size = f"{float(f'{2.0 * max(abs(value) for value, _ in own) * factor:.1g}'):g}"
                entry = one.entry.format(f"{size} {unit}")
            elif one.coefficients or getattr(spec.sensor, kind) is None:
                continue
            found.setdefault(f"[sensor.{kind}] {one.key}", []).append(entry)
    lists = ("hysteresis", "late_temperature_gradient", "turn_on_transient")
    return [f"{k} = " + (f"[{', '.join(of)}]" if k.endswith(lists) else of[0]) for k, of in found.items()]


# The prior of half-differences, in typical figures of the class.
_WIDE, _HALF = 300.0, "half_difference"
# Knots of a half-difference over temperature, and the least overlap of the legs (K) for one.
_KNOTS, _OVERLAP_K = 5, 3.0


class BranchDifference(NamedTuple):
    """Half of what a channel's bias is on heating legs less that on cooling legs, with its standard deviation: `(k,)`,
    SI, at temperatures (°C)."""

    channel: str
    si_unit: str
    temperature_c: np.ndarray
    value: np.ndarray
    std: np.ndarray


class BiasCurve(NamedTuple):
    """The bias of a channel at the rows at rest, in order of time, `(n,)`, SI: as `measured`, less all other terms of
    the model; by the `model` with its path terms; the model's standard deviation `std` by the fit; the `map` alone."""

    channel: str
    si_unit: str
    temperature_c: np.ndarray
    measured: np.ndarray
    model: np.ndarray
    std: np.ndarray
    map: np.ndarray


def bias_curves(readings: ImuReadings, solution: ImuEstimate) -> tuple[BiasCurve, ...]:
    """The bias of every channel with a bias term, over the path of the temperature. Errors: none."""
    model, motion = readings.model, readings.done.motion
    at, line = segments_of(motion, model), motion.line
    apart = readings.observed - readings.expected(solution.parameters)
    lasting, warm = at.sums(line.duration), at.sums(line.duration * np.mean(line.ends(), axis=0))
    curves: list[BiasCurve] = []
    for i, (c, columns) in enumerate(zip(model.channels, model.own_columns(readings.nominal()), strict=True)):
        terms = [t for t in c.model.terms if t.name == BIAS or (isinstance(t, PathTerm) and not t.signals)]
        rows = solution.used & (at.row_channel == i) & (at.axis[at.row_segment] < 0)
        if not terms or not np.any(rows):
            continue
        kept, where = np.zeros(c.model.size, bool), model.where(c.kind, c.axis)
        for term in terms:
            kept[c.model.where(term.name)] = True
        segments = at.row_segment[rows]
        mean = at.sums(columns * kept)[segments] / lasting[segments, None]
        fitted = mean @ solution.parameters[where]
        std = np.linalg.norm(mean @ solution.known.spread[where], axis=1)
        unit = "rad/s" if c.kind == "gyro" else "m/s^2"
        measured = fitted + apart[rows] / lasting[segments]
        of_map = np.zeros(c.model.size, bool)
        of_map[c.model.where(BIAS)] = True
        alone = (mean * of_map) @ solution.parameters[where]
        curves.append(BiasCurve(c.name, unit, warm[segments] / lasting[segments], measured, fitted, std, alone))
    return tuple(curves)


class PathDependence(NamedTuple):
    """What a record shows of the path of temperature."""

    differences: tuple[BranchDifference, ...]
    offers: tuple[OfferedTerm, ...]
    sentences: tuple[str, ...]

    __repr__ = summary


def path_dependence(
    spec: Spec, readings: ImuReadings, solution: ImuEstimate, temperature: np.ndarray, heating: np.ndarray
) -> PathDependence:
    """The half-differences of all channels and the terms that explain them. `temperature` (°C) and `heating` of
    every row that is used. Errors: none."""
    model = readings.model
    both = [temperature[heating], temperature[~heating]]
    low, high = max(float(t.min()) for t in both), min(float(t.max()) for t in both)
    differences: list[BranchDifference] = []
    if high - low > _OVERLAP_K:
        knots = np.linspace(low, high, _KNOTS)
        white, extended = with_terms(
            readings, solution, lambda c: [_half_difference(spec, c, tuple(map(float, knots)))]
        )
        fitted = solve(white)
        for c in model.channels:
            own = extended.where(c.kind, c.axis, _HALF)
            deviations = fitted.known.deviations(np.eye(extended.size)[own])
            unit = "rad/s" if c.kind == "gyro" else "m/s^2"
            differences.append(BranchDifference(c.name, unit, knots, fitted.parameters[own], deviations))
    offers = offered_terms(spec, readings, solution, temperature, heating)
    return PathDependence(tuple(differences), offers, tuple(_sentences(spec, differences, offers)))


def _half_difference(spec: Spec, channel: Channel, knots: tuple[float, ...]) -> Term:
    unit = "rad/s" if channel.kind == "gyro" else "m/s^2"
    std = np.asarray(_WIDE * size_of_class(spec, channel.kind))
    return HalfDifference(std=std, temperature=BSpline(knots, 1), signals=(), name=_HALF, si_unit=unit)


def _sentences(spec: Spec, differences: Sequence[BranchDifference], offers: Sequence[OfferedTerm]) -> list[str]:
    parts: list[str] = []
    for d in differences:
        if np.max(np.abs(d.value) / d.std) > STATED:
            unit, factor = UNITS_OF_TERMS[d.si_unit]
            at = [0, len(d.value) // 2, len(d.value) - 1]
            values = ", ".join(
                f"{d.value[k] * factor:.3g} ± {d.std[k] * factor:.2g} at {d.temperature_c[k]:.3g} °C" for k in at
            )
            parts.append(f"{d.channel.replace('_', ' ')} {values} {unit}")
    words = "heating and cooling disagree: the errors depend on past temperatures"
    of_half = "; half the difference (heating minus cooling): " + "; ".join(parts) if parts else ""
    return [words + of_half, *offer_sentences(spec, offers)]
