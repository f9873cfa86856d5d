"""What a record shows of the path of temperature: half of what heating and cooling differ by, the terms that explain
it, and curves of the bias over temperature."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gradcal_jax.api.imu_residual import UNITS_OF_TERMS
from gradcal_jax.api.path_candidates import (
    STATED,
    OfferedTerm,
    offer_sentences,
    offered_terms,
    size_of_class,
    with_terms,
)
from gradcal_jax.display import summary
from gradcal_jax.estimation import ImuEstimate, ImuReadings, solve
from gradcal_jax.files.spec_sections import Spec
from gradcal_jax.information import segments_of
from gradcal_jax.model import BIAS, BSpline, Channel, HalfDifference, PathTerm, Term

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
            deviations = fitted.known[0].deviations(np.eye(extended.size)[own])
            unit = "rad/s" if c.kind == "gyro" else "m/s^2"
            differences.append(BranchDifference(c.name, unit, knots, fitted.parameters[0][own], deviations))
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
    words = "heating and cooling disagree: the errors depend on the path of temperature"
    of_half = "; half of heating less cooling: " + "; ".join(parts) if parts else ""
    return [words + of_half, *offer_sentences(spec, offers)]
