"""The standard deviations that a plan of one gyro along a table's only axis leaves, from a timeline
(gradcal-timeline/3) alone.

    python recompute.py timeline.json        # as `gradcal check SPEC --timeline segments --json` writes it

A second opinion: it reads the JSON, knows the contract's words, and shares no code and no method with the program that
wrote it. Symbols: `A(t)` integrated error of the sensor (rad), `c(t) = bias gain + rate gain·ω(t)` what drives it.

* Columns: `∫ψ(T) dt` for B, `∫ψ(T)χ(ω)ω dt` for M, by composite Gauss–Legendre quadrature that is split wherever
  motion or temperature bend, turn round, or cross a break of a basis.
* Noise: covariances of the increments from one reading to the next. Of a Gauss–Markov process, `σ²∫∫c(s)c(s')
  e^(−|s−s'|/τ) ds ds'`; of a walk from zero, `K²∫∫min(s, s') ds ds'`; of a constant, `σ²∫c·∫c'`. Errors of the
  readings enter as differences. No state, no filter, no steps: one dense matrix.
* Dense generalised least squares with the priors as more rows; or ordinary least squares on mean rates.
"""

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev, legendre
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, solve_triangular
from scipy.optimize import brentq

Json = dict[str, Any]

_X, _W = legendre.leggauss(24)
_X, _W = (_X + 1.0) / 2.0, _W / 2.0
# A value this close below a break counts as on it, and belongs to what is above: plans in round numbers stand there.
_ON_A_BREAK = 1e-11
# Singular values of columns of unit length below this share of the largest are not information.
_OBSERVABLE = 1e-11


# --- motion and temperature -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stretch:
    """From `begin` to `end` (s), motion and chamber are smooth. `rate` and `slope` (dω/dt) are functions of time."""

    begin: float
    end: float
    rate: Callable[[np.ndarray], np.ndarray]
    slope: Callable[[np.ndarray], np.ndarray]
    moving: bool
    parts: int
    chamber: float
    chamber_slope: float


def _still(t):
    return np.zeros_like(t)


def _shape(s: Json) -> list[tuple[float, float, Callable, Callable, int]]:
    """Smooth parts of a segment: begin and end (s from the segment's start), ω(t), dω/dt, and how often to divide."""
    d, peak, shape = s["duration"], s.get("peak_rate", 0.0), s["shape"]
    pi = math.pi
    if shape == "rest":
        return [(0.0, d, _still, _still, 1)]
    if shape == "constant":
        return [(0.0, d, lambda t: np.full_like(t, peak), _still, 1)]
    if shape in ("cosine ramps", "linear ramps"):
        r = s["ramp"]
        if shape == "linear ramps":
            up, up_slope = (lambda t: peak * t / r), (lambda t: np.full_like(t, peak / r))
        else:
            up = lambda t: peak * np.sin(pi * t / (2.0 * r)) ** 2  # noqa: E731
            up_slope = lambda t: peak * pi / (2.0 * r) * np.sin(pi * t / r)  # noqa: E731
        parts = [
            (0.0, r, up, up_slope, 1),
            (r, d - r, lambda t: np.full_like(t, peak), _still, 1),
            (d - r, d, lambda t: up(d - t), lambda t: -up_slope(d - t), 1),
        ]
        return [p for p in parts if p[1] - p[0] > 1e-12 * d]
    if shape == "hand":
        r = s.get("ramp") or 0.0
        e, w = s.get("unevenness", 0.0), 2.0 * pi / (d - 2.0 * r)

        def rate(t):
            t = t - r
            return peak * np.sin(w * t / 2.0) ** 2 * (1.0 + e * np.sin(3.0 * w * t))

        def slope(t):
            t = t - r
            return (
                peak
                * w
                * (
                    0.5 * np.sin(w * t) * (1.0 + e * np.sin(3.0 * w * t))
                    + np.sin(w * t / 2.0) ** 2 * 3.0 * e * np.cos(3.0 * w * t)
                )
            )

        parts = [(0.0, r, _still, _still, 1), (r, d - r, rate, slope, 24), (d - r, d, _still, _still, 1)]
        return [p for p in parts if p[1] - p[0] > 1e-12 * d]
    raise ValueError(f"a shape that this recomputation does not know: {shape}")


def _stretches(segments: list[Json]) -> list[Stretch]:
    """All smooth stretches of one axis, in order."""
    found = []
    for s in segments:
        start, end = s["start"], s["start"] + s["duration"]
        knots = [(start, s["temperature_start"]), *(tuple(b) for b in s.get("temperature_bends") or ())]
        knots.append((end, s["temperature_end"]))
        for (t0, c0), (t1, c1) in pairwise(knots):
            for a, b, rate, slope, parts in _shape(s):
                low, high = max(start + a, t0), min(start + b, t1)
                if high - low <= 1e-9:
                    continue
                m = (c1 - c0) / (t1 - t0)
                found.append(
                    Stretch(
                        low,
                        high,
                        lambda t, f=rate, o=start: f(t - o),
                        lambda t, f=slope, o=start: f(t - o),
                        s["shape"] != "rest" and s.get("peak_rate", 0.0) != 0.0,
                        parts,
                        c0 + m * (low - t0),
                        m,
                    )
                )
    return found


@dataclass
class Axis:
    """Motion of one axis and temperature of its sensor at any time; panels on which everything is smooth."""

    stretches: list[Stretch]
    lag: float | None
    # What the sensor lacks to its steady trail behind the chamber, at the beginning of each stretch (K).
    excess: list[float] = field(default_factory=list)

    def __post_init__(self):
        sensor = self.stretches[0].chamber
        for s in self.stretches:
            behind = 0.0 if self.lag is None else s.chamber_slope * self.lag
            if self.lag is None:
                self.excess.append(0.0)
                continue
            self.excess.append(sensor - (s.chamber - behind))
            lasts = s.end - s.begin
            sensor = s.chamber + s.chamber_slope * lasts - behind + self.excess[-1] * math.exp(-lasts / self.lag)

    def temperature(self, k: int, t: np.ndarray) -> np.ndarray:
        """Of the sensor (°C), on stretch k."""
        s = self.stretches[k]
        straight = s.chamber + s.chamber_slope * (t - s.begin)
        if self.lag is None:
            return straight
        return straight - s.chamber_slope * self.lag + self.excess[k] * np.exp(-(t - s.begin) / self.lag)

    def temperature_slope(self, k: int, t: np.ndarray) -> np.ndarray:
        """dT/dt of the sensor (K/s), on stretch k."""
        s = self.stretches[k]
        if self.lag is None:
            return np.full_like(t, s.chamber_slope)
        return s.chamber_slope - self.excess[k] / self.lag * np.exp(-(t - s.begin) / self.lag)

    def at(self, t: float) -> tuple[float, float]:
        """Rate (rad/s) and sensor temperature (°C) just before an instant."""
        k = next(k for k, s in enumerate(self.stretches) if t <= s.end + 1e-9 and t >= s.begin - 1e-9)
        now = np.array([min(max(t, self.stretches[k].begin), self.stretches[k].end)])
        return float(self.stretches[k].rate(now)[0]), float(self.temperature(k, now)[0])

    def panels(self, stops: list[float], breaks_t: list[float], breaks_w: list[float], longest: float) -> "Panels":
        """Divide at `stops`, where a variable turns round or crosses a break, and until no panel exceeds `longest`."""
        edges, of = [], []
        for k, s in enumerate(self.stretches):
            inner = [t for t in stops if s.begin + 1e-9 < t < s.end - 1e-9]
            rough = np.unique([s.begin, *inner, s.end])
            fine: list[float] = []
            step = min(longest, (s.end - s.begin) / s.parts)
            for a, b in pairwise(rough):
                fine += np.linspace(a, b, max(1, math.ceil((b - a) / step - 1e-9)) + 1)[:-1].tolist()
            fine.append(s.end)
            places = set(fine)
            for value, slope, levels in (
                (lambda t, k=k: self.temperature(k, t), lambda t, k=k: self.temperature_slope(k, t), breaks_t),
                (s.rate, s.slope, breaks_w),
            ):
                if levels:
                    for a, b in pairwise(fine):
                        places.update(_crossings(value, slope, levels, a, b))
            ordered = sorted(places)
            edges += list(pairwise(ordered))
            of += [k] * (len(ordered) - 1)
        ends = np.array(edges)
        times = ends[:, :1] + np.diff(ends, axis=1) * _X
        weights = np.diff(ends, axis=1) * _W
        rate, temperature = np.empty_like(times), np.empty_like(times)
        for k, s in enumerate(self.stretches):
            mine = np.array(of) == k
            rate[mine], temperature[mine] = s.rate(times[mine]), self.temperature(k, times[mine])
        return Panels(self, np.array(of), ends[:, 0], ends[:, 1], times, weights, rate, temperature)


def _crossings(value, slope, levels: list[float], a: float, b: float) -> list[float]:
    """Where a smooth function on [a, b] turns round, and where it crosses levels."""
    grid = np.linspace(a, b, 9)
    found = [a, b]
    slopes = slope(grid)
    at = lambda f, t: float(f(np.array([t]))[0])  # noqa: E731
    for i in np.flatnonzero(slopes[:-1] * slopes[1:] < 0.0):
        found.append(brentq(lambda t: at(slope, t), grid[i], grid[i + 1], xtol=1e-13, rtol=1e-15))
    turns = sorted(found)
    places = turns[1:-1]
    for level in levels:
        for low, high in pairwise(turns):
            before, after = at(value, low) - level, at(value, high) - level
            if before * after < 0.0:
                places.append(brentq(lambda t, level=level: at(value, t) - level, low, high, xtol=1e-13, rtol=1e-15))
    return places


@dataclass
class Panels:
    """Short intervals with quadrature nodes; arrays of shape `(P,)` or `(P, q)`."""

    axis: Axis
    stretch: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    times: np.ndarray
    weights: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray

    def rate_at(self, panel: int, t: np.ndarray) -> np.ndarray:
        """ω at instants within a panel."""
        return self.axis.stretches[self.stretch[panel]].rate(t)


# --- bases ------------------------------------------------------------------------------------------------------------


def _breaks(basis: Json) -> list[float]:
    if basis["basis"] == "bins":
        return list(basis["edges"][1:-1])
    return list(basis.get("knots") or ())


def _values(basis: Json, x: np.ndarray) -> np.ndarray:
    """The functions that a prior and a prediction's std are on: `(...) -> (..., size)`."""
    kind = basis["prior_functions"]
    if kind == "monomial":
        z = (x - basis["centre"]) / basis["scale"]
        return z[..., None] ** np.arange(basis["degree"] + 1)
    near = x + _ON_A_BREAK * (1.0 + np.max(np.abs(_breaks(basis)), initial=0.0))
    if kind == "bins":
        inner = basis["edges"][1:-1]
        return np.eye(len(inner) + 1)[np.searchsorted(inner, near, side="right")]
    if kind == "b-spline":
        knots, degree = np.array(basis["knots"]), basis["degree"]
        whole = np.r_[[knots[0]] * degree, knots, [knots[-1]] * degree]
        size = len(knots) - 1 + degree
        # Those of degree 0 jump at the knots, like bins.
        return BSpline(whole, np.eye(size), degree)(np.clip(x if degree else near, knots[0], knots[-1]))
    raise ValueError(f"functions that this recomputation does not know: {kind}")


def _size(basis: Json) -> int:
    return _values(basis, np.zeros(1)).shape[-1]


def _legendre(basis: Json, x: np.ndarray, degree: int) -> np.ndarray:
    return legendre.legvander((x - basis["centre"]) / basis["scale"], degree)


def _left_out(row: Json, temperature: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """The functions that a map's structure leaves out: `(...) -> (..., extra)`."""
    beyond, t, w = row["discrepancy"], row["temperature"], row.get("rate")
    if beyond["functions"] != "legendre":
        raise ValueError(f"functions that this recomputation does not know: {beyond['functions']}")
    top = max(beyond["temperature_degree"], t["degree"])
    in_t = _legendre(t, temperature, top)
    if w is None:
        return in_t[..., t["degree"] + 1 :]
    in_w = _legendre(w, rate, max(beyond["rate_degree"], w["degree"]))
    columns = [
        in_t[..., i] * in_w[..., j]
        for i in range(in_t.shape[-1])
        for j in range(in_w.shape[-1])
        if i > t["degree"] or j > w["degree"]
    ]
    return np.stack(columns, axis=-1)


def _to_functions(basis: Json, kind: str) -> np.ndarray:
    """Coefficients of the prior's functions to those of `kind`, which span the same."""
    if kind == basis["prior_functions"]:
        return np.eye(_size(basis))
    convert = {"legendre": legendre.poly2leg, "chebyshev": chebyshev.poly2cheb}[kind]
    size = basis["degree"] + 1
    matrix = np.zeros((size, size))
    for k in range(size):
        column = convert(np.eye(size)[k])
        matrix[: len(column), k] = column
    return matrix


# --- columns and priors -----------------------------------------------------------------------------------------------


class Columns:
    """The parameters of an axis, reported ones first: B, M (temperature slow, rate fast), dB/dṪ, then nuisances."""

    def __init__(self, timeline: Json):
        sensor = timeline["sensor"]
        self.bias, self.scale = sensor.get("bias"), sensor.get("scale_factor")
        self.gradient = sensor.get("bias_temperature_gradient")
        self.turn_on = sensor.get("turn_on_bias") if sensor["starts"].get("turn_on_bias") == "prior" else None
        self.harmonics = timeline.get("harmonics") or []
        maps = [m for m in (self.bias, self.scale) if m is not None]
        rates = [m["rate"] for m in maps if m.get("rate") is not None]
        self.breaks_t = sorted({b for m in maps for b in _breaks(m["temperature"])})
        self.breaks_w = sorted({b for r in rates for b in _breaks(r)})

    def increments(self, panels: Panels) -> tuple[np.ndarray, int]:
        """What each parameter's unit adds to A over each panel (the harmonics excepted), and how many are reported."""
        blocks, w = [], panels.weights
        if self.bias is not None:
            blocks.append(np.einsum("pq,pqa->pa", w, _values(self.bias["temperature"], panels.temperature)))
        if self.scale is not None:
            in_t = _values(self.scale["temperature"], panels.temperature)
            in_w = _values(self.scale["rate"], panels.rate)
            both = np.einsum("pq,pqa,pqb->pab", w * panels.rate, in_t, in_w)
            blocks.append(both.reshape(len(w), -1))
        if self.gradient is not None:
            ends = [
                [float(panels.axis.temperature(k, np.array([t]))[0]) for t in (a, b)]
                for k, a, b in zip(panels.stretch, panels.begin, panels.end, strict=True)
            ]
            blocks.append(np.diff(np.array(ends), axis=1))
        reported = sum(b.shape[1] for b in blocks)
        for row, drives in ((self.bias, 1.0), (self.scale, panels.rate)):
            if row is not None and row.get("discrepancy") is not None:
                outside = _left_out(row, panels.temperature, panels.rate)
                blocks.append(np.einsum("pq,pqa->pa", w * drives, outside))
        return np.concatenate(blocks, axis=1), reported

    def priors(self) -> list[tuple[str, np.ndarray]]:
        """Whitened rows of each group, in the order of the columns: ("bias" | "scale" | … , rows)."""
        found: list[tuple[str, np.ndarray]] = []
        for name, row in (("bias", self.bias), ("scale", self.scale)):
            if row is None:
                continue
            bases = [b for b in (row["temperature"], row.get("rate")) if b is not None]
            sizes = [_size(b) for b in bases]
            count = int(np.prod(sizes))
            rows = [np.zeros((0, count))]
            if row.get("prior") is not None or row.get("shapes"):
                shapes = np.array(row.get("shapes") or np.eye(count) * row["prior"])
                covariance = shapes.T @ shapes
                if name == "bias" and self.turn_on is not None:
                    one = np.eye(count)[0] if bases[0]["prior_functions"] == "monomial" else np.ones(count)
                    covariance = covariance + self.turn_on**2 * np.outer(one, one)
                rows.append(np.linalg.inv(np.linalg.cholesky(covariance)))
            if row.get("smoothness") is not None:
                to = np.ones((1, 1))
                for b in bases:
                    to = np.kron(to, _to_functions(b, b["smoothness_functions"]))
                for along in row["smoothness_along"]:
                    steps = np.ones((1, 1))
                    for axis, size in zip(("temperature", "rate"), sizes, strict=False):
                        steps = np.kron(steps, np.diff(np.eye(size), axis=0) if axis == along else np.eye(size))
                    rows.append(steps @ to / row["smoothness"])
            found.append((name, np.concatenate(rows)))
        if self.gradient is not None:
            prior = self.gradient.get("prior")
            found.append(("gradient", np.full((0 if prior is None else 1, 1), 0.0 if prior is None else 1.0 / prior)))
        for name, row in (("bias left out", self.bias), ("scale left out", self.scale)):
            if row is not None and row.get("discrepancy") is not None:
                extra = _left_out(row, np.zeros(1), np.zeros(1)).shape[-1]
                found.append((name, np.eye(extra) / row["discrepancy"]["sigma"]))
        for h in self.harmonics:
            found.append((f"harmonic {h['order']}", np.eye(2) / h["sigma"]))
        return found


def _block_rows(blocks: list[np.ndarray]) -> np.ndarray:
    width, at, rows = sum(b.shape[1] for b in blocks), 0, []
    for b in blocks:
        rows.append(np.pad(b, ((0, 0), (at, width - at - b.shape[1]))))
        at += b.shape[1]
    return np.concatenate(rows) if rows else np.zeros((0, width))


# --- noise ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Process:
    """`start`: "stationary" (σ, τ), "zero" (`sigma` is K in rad/s/√s) or "constant"."""

    start: str
    sigma: float
    tau: float
    bias_gain: float
    rate_gain: float


def processes(sensor: Json) -> list[Process]:
    """Every slow error of the sensor that is noise."""
    starts, found = sensor["starts"], []
    for d in sensor.get("drift") or ():
        found.append(Process(starts["drift"], d["sigma"], d["tau"], 1.0, 0.0))
    if starts.get("rate_random_walk"):
        found.append(Process(starts["rate_random_walk"], sensor["rate_random_walk"], math.inf, 1.0, 0.0))
    for d in sensor.get("scale_factor_instability") or ():
        found.append(Process(starts["scale_factor_instability"], d["sigma"], d["tau"], 0.0, 1.0))
    if (e := sensor.get("temperature_error")) is not None:
        gains = e.get("bias_slope") or 0.0, e.get("scale_factor_slope") or 0.0
        found.append(Process(starts["temperature_error"], e["sigma"], e.get("tau") or math.inf, *gains))
    if starts.get("sample_clock_error"):
        found.append(Process(starts["sample_clock_error"], sensor["sample_clock_error"], math.inf, 0.0, 1.0))
    if starts.get("turn_on_bias") == "constant":
        found.append(Process("constant", sensor["turn_on_bias"], math.inf, 1.0, 0.0))
    return found


def covariance(process: Process, panels: Panels, spans: list[np.ndarray], origin: list[float]) -> np.ndarray:
    """Of the integrals of c(t)·x(t) over spans of neighbouring panels, in order of time; a walk is 0 at `origin`."""
    p, w = process, panels.weights
    c = p.bias_gain + p.rate_gain * panels.rate
    whole = np.array([np.sum((w * c)[span]) for span in spans])
    if p.start == "constant":
        return p.sigma**2 * np.outer(whole, whole)
    begin = np.array([panels.begin[s[0]] for s in spans])
    end = np.array([panels.end[s[-1]] for s in spans])
    if p.start == "zero":
        since = np.array([np.sum((w * (panels.times - o))[span]) for span, o in zip(spans, origin, strict=True)])
        lasts = end - begin
        own = (begin - np.array(origin)) * lasts**2 + lasts**3 / 3.0
        return p.sigma**2 * (_symmetric(np.outer(since, lasts)) + np.diag(own))
    decay = 1.0 / p.tau
    to_end = np.sum(w * c * np.exp(-decay * (panels.end[:, None] - panels.times)), axis=1)
    from_begin = np.sum(w * c * np.exp(-decay * (panels.times - panels.begin[:, None])), axis=1)
    first, last, own = [], [], []
    for span in spans:
        late = early = both = 0.0
        for k in span:
            fade = math.exp(-decay * (panels.end[k] - panels.begin[k]))
            both += _within(p, panels, k, c[k]) + 2.0 * late * from_begin[k]
            early += from_begin[k] * math.exp(-decay * (panels.begin[k] - panels.begin[span[0]]))
            late = late * fade + to_end[k]
        first.append(early)
        last.append(late)
        own.append(both)
    apart = np.exp(-decay * np.maximum(begin[None, :] - end[:, None], 0.0))
    return p.sigma**2 * (_symmetric(np.outer(last, first) * apart) + np.diag(own))


def _within(p: Process, panels: Panels, k: int, c: np.ndarray) -> float:
    """∫∫ c c' e^(−|s − s'|/τ) over one panel squared: twice the triangle, by nodes of its own for each s."""
    times = panels.times[k]
    reach = (times - panels.begin[k])[:, None]
    inner = panels.begin[k] + reach * _X
    driven = p.bias_gain + (p.rate_gain * panels.rate_at(k, inner) if p.rate_gain else np.zeros_like(inner))
    return float(
        2.0 * (panels.weights[k] * c) @ np.sum(reach * _W * driven * np.exp((inner - times[:, None]) / p.tau), 1)
    )


def _symmetric(upper: np.ndarray) -> np.ndarray:
    """A matrix whose part above the diagonal is `upper`'s, below it likewise, and zero on it."""
    above = np.triu(upper, 1)
    return above + above.T


# --- readings ---------------------------------------------------------------------------------------------------------


@dataclass
class System:
    """Increments `Φβ + noise` of an axis, `noise ~ (0, V)`, over `lasting` s each."""

    columns: np.ndarray
    noise: np.ndarray
    lasting: np.ndarray
    reported: int


def _longest(sensor: Json) -> float:
    times = [p.tau for p in processes(sensor) if math.isfinite(p.tau)]
    return min([*times, sensor.get("thermal_lag") or math.inf, 600.0])


def _spans(panels: Panels, ends: list[tuple[float, float]]) -> list[np.ndarray]:
    middle = 0.5 * (panels.begin + panels.end)
    return [np.flatnonzero((middle > a) & (middle < b)) for a, b in ends]


def angles(timeline: Json, axis: str) -> System:
    """Differences of neighbouring angle readings."""
    sensor, columns = timeline["sensor"], Columns(timeline)
    readings = [r for r in timeline["readings"] if r["axis"] == axis]
    motion = Axis(_stretches([s for s in timeline["segments"] if s["axis"] == axis]), sensor.get("thermal_lag"))
    stops = [r["time"] for r in readings]
    panels = motion.panels(stops, columns.breaks_t, columns.breaks_w, _longest(sensor))
    pairs = [(k - 1, k) for k, r in enumerate(readings) if not r.get("origin", False)]
    spans = _spans(panels, [(stops[a], stops[b]) for a, b in pairs])
    increments, reported = columns.increments(panels)
    rows = np.array([increments[s].sum(axis=0) for s in spans])
    turned = np.r_[0.0, np.cumsum(np.sum(panels.weights * panels.rate, axis=1))]
    upto = np.array([turned[np.argmin(np.abs(np.r_[panels.begin, panels.end[-1]] - t))] for t in stops])
    for h in columns.harmonics:
        for wave in (np.cos(h["order"] * upto), np.sin(h["order"] * upto)):
            rows = np.c_[rows, [wave[b] - wave[a] for a, b in pairs]]

    lasting = np.array([stops[b] - stops[a] for a, b in pairs])
    noise = np.diag(sensor["arw"] ** 2 * lasting)
    for p in processes(sensor):
        noise = noise + covariance(p, panels, spans, [stops[0]] * len(spans))
    differences = np.zeros((len(pairs), len(readings)))
    for i, (a, b) in enumerate(pairs):
        differences[i, a], differences[i, b] = -1.0, 1.0
    white = [r["white_std"] ** 2 + (r.get("timing_std", 0.0) * motion.at(r["time"])[0]) ** 2 for r in readings]
    noise = noise + (differences * white) @ differences.T + _common(readings, differences)
    return System(rows, noise, lasting, reported)


def _common(readings: list[Json], of: np.ndarray) -> np.ndarray:
    """Covariance of what is common to a standstill or a set point."""
    ids = sorted({r["standstill_id"] for r in readings if r.get("standstill_id") is not None})
    offsets = np.zeros((len(readings), len(ids)))
    for k, r in enumerate(readings):
        if r.get("standstill_id") is not None:
            offsets[k, ids.index(r["standstill_id"])] = r.get("offset_std", 0.0)
    half = of @ offsets
    return half @ half.T


def rates(timeline: Json, axis: str) -> System:
    """Readings of held rates, as the angle that each turns."""
    sensor, columns = timeline["sensor"], Columns(timeline)
    readings = [r for r in timeline["readings"] if r["axis"] == axis]
    motion = Axis(_stretches([s for s in timeline["segments"] if s["axis"] == axis]), sensor.get("thermal_lag"))
    ends = [(r["time"] - r["duration"], r["time"]) for r in readings]
    panels = motion.panels([t for pair in ends for t in pair], columns.breaks_t, columns.breaks_w, _longest(sensor))
    spans = _spans(panels, ends)
    increments, reported = columns.increments(panels)
    rows = np.array([increments[s].sum(axis=0) for s in spans])
    lasting = np.array([r["duration"] for r in readings])
    noise = np.diag(sensor["arw"] ** 2 * lasting)
    shared = timeline["points"] == "one run"
    origin = [ends[0][0]] * len(spans) if shared else [a for a, _ in ends]
    for p in processes(sensor):
        whole = covariance(p, panels, spans, origin)
        noise = noise + (whole if shared else np.diag(np.diagonal(whole)))
    held = np.diag(lasting)
    white = np.array([r["white_std"] for r in readings])
    noise = noise + np.diag((white * lasting) ** 2) + _common(readings, held)
    return System(rows, noise, lasting, reported)


# --- estimators -------------------------------------------------------------------------------------------------------


@dataclass
class Known:
    """Of the reported parameters: `root rootᵀ` is their covariance; `hidden` says which the plan does not determine."""

    root: np.ndarray
    hidden: np.ndarray

    @property
    def sigmas(self) -> list[float | None]:
        """Standard deviations; None where the plan says nothing."""
        found = np.linalg.norm(self.root, axis=1)
        return [None if out else float(v) for v, out in zip(found, self.hidden, strict=True)]


def best_linear(system: System, priors: np.ndarray) -> Known:
    """Generalised least squares with the priors as further rows."""
    scale = np.sqrt(np.diagonal(system.noise))
    lower = cho_factor(system.noise / np.outer(scale, scale), lower=True)[0]
    rows = solve_triangular(lower, system.columns / scale[:, None], lower=True)
    return _known(np.concatenate([rows, priors]), np.eye(len(rows) + len(priors)), system.reported)


def least_squares(system: System) -> Known:
    """Ordinary least squares on the mean rate of each reading, whose noise is what it is."""
    rows = system.columns / system.lasting[:, None]
    root = np.linalg.cholesky(system.noise / np.outer(system.lasting, system.lasting))
    return _known(rows, root, system.reported)


def _known(rows: np.ndarray, root: np.ndarray, reported: int) -> Known:
    """`rows⁺ root` on the directions that the rows determine."""
    norm = np.linalg.norm(rows, axis=0)
    norm[norm == 0.0] = 1.0
    left, singular, right = np.linalg.svd(rows / norm)
    seen = int(np.sum(singular > _OBSERVABLE * singular[0]))
    spread = (right[:seen].T / singular[:seen]) @ (left[:, :seen].T @ root) / norm[:, None]
    unseen = right[seen:] / norm
    unseen = unseen / np.linalg.norm(unseen, axis=1, keepdims=True)
    return Known(spread[:reported], np.any(np.abs(unseen[:, :reported]) > 1e-7, axis=0))


def plain(timeline: Json) -> Json:
    """One gyro and the only axis of its table: the sensor, the axis's motion, and every reading with its errors."""
    (channel,), (axis,) = timeline["channels"], timeline["table"]
    terms = {term["name"]: term for term in channel["terms"]}
    clock = [row["stds"][0] for row in timeline["installation"] if row["kind"] == "sample_clock"]
    error = channel.get("temperature_error")
    sensor = {key: channel[key] for key in channel.keys() - {"terms", "path", "name", "kind", "axis", "white"}} | {
        "arw": channel["white"],
        "thermal_lag": timeline.get("thermal_lag"),
        "sample_clock_error": clock[0] if clock else channel.get("sample_clock_error"),
        "bias": terms.get("bias"),
        "scale_factor": terms.get("scale_factor"),
    }
    sensor["starts"] = {
        "drift": "stationary",
        "rate_random_walk": "zero" if channel.get("rate_random_walk") else None,
        "scale_factor_instability": "stationary",
        "temperature_error": error and ("stationary" if error.get("tau") else "constant"),
        "sample_clock_error": "constant" if sensor["sample_clock_error"] else None,
        "turn_on_bias": channel.get("turn_on_bias") and ("prior" if "bias" in terms else "constant"),
    }
    waves = [row for row in timeline["installation"] if row["kind"] == "harmonics"]
    harmonics = [{"order": k, "sigma": row["stds"][2 * n]} for row in waves for n, k in enumerate(row["orders"])]
    reading = {"axis": channel["axis"], "white_std": axis["reading_noise"]}
    moves = [s["start"] + s["duration"] for s in timeline["segments"] if s.get("axis") is not None]
    readings: list[Json] = []
    for r in timeline["readings"]:
        (stands,) = r["standstill_ids"]
        if r.get("rate") is not None:
            offset = timeline["rate_accuracy"] * abs(r["rate"])
            held = {"kind": "rate", "duration": r["time"] - r["start"], "white_std": 0.0, "offset_std": offset}
            readings.append(reading | held | {"time": r["time"], "standstill_id": len(readings)})
            continue
        if not readings or r["start"] > readings[-1]["time"] + 1e-9:
            # The axis stands where a row begins that follows no other.
            begun = sum(end <= r["start"] + 1e-6 for end in moves)
            at_rest = {"standstill_id": begun, "offset_std": axis["standstill_offset"]}
            readings.append(reading | at_rest | {"time": r["start"], "kind": "angle", "origin": True})
        own = {"timing_std": axis["timing_error"]} if stands is None else {"offset_std": axis["standstill_offset"]}
        readings.append(reading | own | {"time": r["time"], "kind": "angle", "standstill_id": stands})
    segments = [s | {"axis": channel["axis"]} for s in timeline["segments"]]
    found = {"sensor": sensor, "harmonics": harmonics, "segments": segments, "readings": readings}
    return found | {"estimator": timeline["estimator"], "points": timeline.get("points")}


def knowledge(timeline: Json) -> dict[str, Known]:
    """What is left of B's and M's coefficients and of dB/dṪ, in the contract's order, by the name of the axis."""
    if timeline["format"] != "gradcal-timeline/3":
        raise ValueError(f"a format that this recomputation does not know: {timeline['format']}")
    timeline = plain(timeline)
    priors = _block_rows([rows for _, rows in Columns(timeline).priors()])
    axis, kind = timeline["readings"][0]["axis"], timeline["readings"][0]["kind"]
    system = rates(timeline, axis) if kind == "rate" else angles(timeline, axis)
    return {axis: least_squares(system) if timeline["estimator"] == "least squares" else best_linear(system, priors)}


def sigmas(timeline: Json) -> dict[str, list[float | None]]:
    """Standard deviations (SI) of the reported parameters; null where the plan does not determine one."""
    return {axis: known.sigmas for axis, known in knowledge(timeline).items()}


if __name__ == "__main__":
    with open(sys.argv[1], encoding="utf-8") as file:
        print(json.dumps(sigmas(json.load(file)), indent=1))
