"""What a record shows of the path of temperature: half of what heating and cooling differ by, and plays that
explain it.

The estimate's whitened rows are independent of each other, so that further terms are columns beside those of the model:
nothing is estimated anew, and the noise is that of the spec.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gradcal_jax.api.imu_residual import UNITS_OF_TERMS
from gradcal_jax.display import summary
from gradcal_jax.estimation import ImuEstimate, ImuReadings, Whitened, solve, split
from gradcal_jax.files.absent import path_terms_of
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import segments_of, whiten
from gradcal_jax.model import BIAS, BSpline, Channel, HalfDifference, Hysteresis, ImuModel, PathTerm
from gradcal_jax.units import parse

HEATING_AGAINST_COOLING = "heating against cooling"
# Half-widths that are tried, K, up to this share of the range of temperature.
_WIDTHS, _LARGEST_SHARE = (2.0, 3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0), 0.5
# The prior of a play that is tried, in typical figures of the class; that of half-differences, in those of 10 K.
_TYPICAL, _WIDE = 30.0, 300.0
# Knots of a half-difference over temperature, and the least overlap of the legs (K) for one.
_KNOTS, _OVERLAP_K = 5, 3.0
# Standard deviations beyond which a half-difference or a coefficient is stated.
_STATED = 4.0
# Chance below which a play is offered.
_OFFERED = 1e-4


class BranchDifference(NamedTuple):
    """Half of what a channel's bias is on heating legs less that on cooling legs, with its standard deviation: `(k,)`,
    SI, at temperatures (°C)."""

    channel: str
    si_unit: str
    temperature_c: np.ndarray
    value: np.ndarray
    std: np.ndarray


class OfferedPlay(NamedTuple):
    """A play of half-width `width_k` for every channel: χ² over degrees of freedom without it and with it, the chance
    of heating against cooling with it, and its coefficients by channel, SI for each K, with standard deviations."""

    width_k: float
    before: float
    after: float
    chance: float
    coefficients: dict[str, tuple[float, float]]


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
    offer: OfferedPlay | None
    sentences: tuple[str, ...]

    __repr__ = summary


def path_dependence(
    spec: Spec, readings: ImuReadings, solution: ImuEstimate, temperature: np.ndarray, heating: np.ndarray
) -> PathDependence:
    """The half-differences of all channels and the play that explains them best. `temperature` (°C) and `heating` of
    every row that is used. Errors: none."""
    model = readings.model
    both = [temperature[heating], temperature[~heating]]
    low, high = max(float(t.min()) for t in both), min(float(t.max()) for t in both)
    differences: list[BranchDifference] = []
    if high - low > _OVERLAP_K:
        knots = np.linspace(low, high, _KNOTS)
        white, extended, places = _with_terms(
            readings, solution, lambda c: [_half_difference(spec, c, tuple(map(float, knots)))]
        )
        fitted = solve(white)
        for c, (own,) in zip(model.channels, places, strict=True):
            rows = np.eye(extended.size)[own]
            deviations = fitted.known[0].deviations(rows)
            unit = "rad/s" if c.kind == "gyro" else "m/s^2"
            differences.append(BranchDifference(c.name, unit, knots, fitted.parameters[0][own], deviations))
    offer = _offered(spec, readings, solution, temperature, heating)
    return PathDependence(tuple(differences), offer, tuple(_sentences(spec, differences, offer)))


def _typical(spec: Spec, kind: str) -> float:
    """Typical coefficient of a play in the class of a kind of channel, SI for each K."""
    value = next(t.value for t in path_terms_of(spec.sensor, kind) if t.key == "hysteresis")[0]["prior"]
    return parse(value, "bias slope" if kind == "gyro" else "acceleration slope")


def _half_difference(spec: Spec, channel: Channel, knots: tuple[float, ...]) -> PathTerm:
    unit = "rad/s" if channel.kind == "gyro" else "m/s^2"
    std = np.asarray(_WIDE * 10.0 * _typical(spec, channel.kind))
    return HalfDifference(std=std, temperature=BSpline(knots, 1), signals=(), name="half_difference", si_unit=unit)


def _with_terms(
    readings: ImuReadings, solution: ImuEstimate, terms_of: Callable[[Channel], Sequence[PathTerm]]
) -> tuple[Whitened, ImuModel, list[list[slice]]]:
    """The whitened rows with further terms of every channel, their model, and the places of these terms."""
    model, begin = readings.model, 0
    channels: list[Channel] = []
    places: list[list[slice]] = []
    former: list[np.ndarray] = []
    for c in model.channels:
        more = list(terms_of(c))
        channels.append(replace(c, model=replace(c.model, terms=(*c.model.terms, *more))))
        former.append(begin + np.arange(c.model.size))
        begin += c.model.size
        places.append([])
        for term in more:
            places[-1].append(slice(begin, begin + term.size))
            begin += term.size
    extended = replace(model, channels=tuple(channels))
    former.append(begin + np.arange(model.size - model.calibrated))
    about = np.zeros(extended.size)
    about[np.concatenate(former)] = solution.parameters
    more_readings = readings._replace(model=extended, points=0)
    steps, columns = more_readings.linear(about)
    rows = np.asarray(whiten(steps, columns))[readings.by_steps(solution.used)]
    return Whitened(rows[None], solution.white.data, extended.prior_rows()), extended, places


def _offered(
    spec: Spec, readings: ImuReadings, solution: ImuEstimate, temperature: np.ndarray, heating: np.ndarray
) -> OfferedPlay | None:
    """The play that reduces χ² most, if it does so beyond chance."""
    span = float(np.ptp(temperature))
    widths = [w for w in _WIDTHS if w <= _LARGEST_SHARE * span]
    known = {t.name for c in readings.model.channels for t in c.model.terms if isinstance(t, Hysteresis)}
    if not widths or known:
        return None

    def plays(c: Channel) -> list[PathTerm]:
        unit = "rad/s/K" if c.kind == "gyro" else "m/s^2/K"
        std = np.asarray(_TYPICAL * _typical(spec, c.kind))
        of = {"std": std, "signals": (), "si_unit": unit}
        return [Hysteresis(width=np.asarray(w), name=f"tried_{w:g}K", **of) for w in widths]

    white, extended, places = _with_terms(readings, solution, plays)
    tried = np.zeros(extended.size, bool)
    for own in (place for of_channel in places for place in of_channel):
        tried[own] = True
    best, first = None, solve(white.without(tried))
    for k, width in enumerate(widths):
        kept = ~tried
        for of_channel in places:
            kept[of_channel[k]] = True
        chosen = white.without(~kept)
        fit = solve(chosen)
        if best is None or fit.chi_squared[0] < best[1].chi_squared[0]:
            best = width, fit, chosen, np.flatnonzero(kept), k
    assert best is not None
    width, fit, chosen, columns, k = best
    gained = float(first.chi_squared[0] - fit.chi_squared[0])
    # One coefficient for each channel; the best of several widths.
    from scipy.special import chdtrc

    if chdtrc(len(places), max(gained, 0.0)) * len(widths) > _OFFERED:
        return None
    after = split(chosen, HEATING_AGAINST_COOLING, heating, np.eye(len(columns)))
    deviations = fit.known[0].deviations(np.eye(len(columns)))
    coefficients = {}
    for c, of_channel in zip(readings.model.channels, places, strict=True):
        at = int(np.searchsorted(columns, of_channel[k].start))
        coefficients[c.name] = float(fit.parameters[0][at]), float(deviations[at])
    before, now = (float(f.chi_squared[0]) / max(int(f.degrees[0]), 1) for f in (first, fit))
    return OfferedPlay(width, before, now, 1.0 if after is None else after.agreement.probability, coefficients)


def _sentences(spec: Spec, differences: Sequence[BranchDifference], offer: OfferedPlay | None) -> list[str]:
    parts: list[str] = []
    for d in differences:
        if np.max(np.abs(d.value) / d.std) > _STATED:
            unit, factor = UNITS_OF_TERMS[d.si_unit]
            at = [0, len(d.value) // 2, len(d.value) - 1]
            values = ", ".join(
                f"{d.value[k] * factor:.3g} ± {d.std[k] * factor:.2g} at {d.temperature_c[k]:.3g} °C" for k in at
            )
            parts.append(f"{d.channel.replace('_', ' ')} {values} {unit}")
    words = "heating and cooling disagree: the errors depend on the path of temperature"
    result = [words + ("; half of heating less cooling: " + "; ".join(parts) if parts else "")]
    if offer is not None:
        whole = "explains it" if offer.chance > _OFFERED else "explains a part of it"
        result.append(
            f"a play of {offer.width_k:g} K {whole}: χ² over degrees of freedom {offer.before:.3g} → "
            f"{offer.after:.3g}; " + "; ".join(_keys(spec, offer))
        )
    return result


def _keys(spec: Spec, offer: OfferedPlay) -> list[str]:
    """What to put into the spec for a play."""
    lines = []
    for kind in ("gyro", "accelerometer"):
        if getattr(spec.sensor, kind) is None:
            continue
        own = [v for name, v in offer.coefficients.items() if name.startswith(kind)]
        if max(abs(value) / std for value, std in own) > _STATED:
            unit, factor = UNITS_OF_TERMS["rad/s/K" if kind == "gyro" else "m/s^2/K"]
            prior = f"{2.0 * max(abs(value) for value, _ in own) * factor:.1g}"
            size = f"{float(prior):g} {unit}"
            lines.append(
                f'[sensor.{kind}] hysteresis = [{{ width = "{offer.width_k:g} K", prior = "{size}" }}] estimates it'
            )
    return lines
