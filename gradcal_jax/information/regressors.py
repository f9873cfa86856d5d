"""Regressors: what each parameter adds to the integrated gyro error, at every piece of a timeline.

    Φ_k = ∫ ψ(T) dt  (bias),  ∫ ψ(T, ω)·ω dt  (scale factor),  ∫ Ṫ dt  (bias temperature-gradient sensitivity)

Each smooth piece is integrated by Gauss–Legendre quadrature, exact to rounding for polynomial bases. Where a basis has
breaks (bins, B-splines) the piece is divided at the instants at which the temperature or the rate crosses them, and
those instants carry their derivative, too.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gradcal_jax.errormodel import GyroModel, Map
from gradcal_jax.plans import Timeline

# A raised cosine to the fourth power, the steepest of a cubic M(T, ω), is resolved to 1e-12 by 16 points; a higher
# degree in rate adds a period to it, and needs two more.
_MOVING_NODES = 16
_CUBIC = 3
# At rest only B(T) is integrated: degree 15 is exact for polynomials. A lagging sensor's exponentials need more.
_STANDING_NODES = 8
# A shape or a lagged temperature is monotone in each of these shares of a piece, or its turning point is no break.
_PANELS = 8
# Halvings that locate a crossing: to 2^-45 of a panel.
_HALVINGS = 45
# In units of rounding: more than the temperature's at the end of a long ramp, less than any integral notices.
_HAIR = 1e2


def quadrature(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss–Legendre nodes and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return (x + 1.0) / 2.0, w / 2.0


def increments(timeline: Timeline, model: GyroModel) -> Float[Array, "P p"]:
    """What each parameter's unit adds to the integrated error over each piece, in rad."""
    columns = model.columns
    everything, moving = np.arange(timeline.piece_count), timeline.moving_pieces.values
    standing = np.setdiff1d(everything, moving)
    rows = jnp.zeros((timeline.piece_count, columns.count))

    def add(rows, pieces, values, where):
        return (
            rows.at[pieces[:, None], np.arange(where.start, where.stop)[None, :]].set(values) if len(pieces) else rows
        )

    if model.scale is not None:
        scale = _integrals(
            timeline, model.scale, moving, _MOVING_NODES + 2 * max(0, _rate_degree(model.scale) - _CUBIC)
        )
        rows = add(rows, moving, scale[0], columns.scale)
        rows = add(rows, moving, scale[1], columns.scale_discrepancy)
    if model.bias is not None:
        at_rest = _MOVING_NODES if timeline.lagged else _STANDING_NODES
        for pieces, nodes in ((moving, _MOVING_NODES), (standing, at_rest)):
            bias = _integrals(timeline, model.bias, pieces, nodes)
            rows = add(rows, pieces, bias[0], columns.bias)
            rows = add(rows, pieces, bias[1], columns.bias_discrepancy)
    if model.has_gradient:
        ends = jnp.broadcast_to(jnp.array([0.0, 1.0]), (timeline.piece_count, 2))
        temperature = timeline.temperature(ends)
        rows = rows.at[:, columns.gradient].set(temperature[:, 1:] - temperature[:, :1])
    return rows


def _rate_degree(of: Map) -> int:
    """Highest degree in rate of a map and of what its structure leaves out."""
    degrees = [getattr(basis, "degree", 0) for basis in (of.rate, of.discrepancy_rate)]
    return max(degrees)


def at_readings(timeline: Timeline, model: GyroModel) -> Float[Array, "P p"]:
    """Regressors of the reading at the end of each piece, relative to the first reading or the point's own start."""
    rows = increments(timeline, model)
    orders = model.reference.harmonic_orders
    if timeline.rate_reference:
        if orders:
            raise ValueError(
                "the encoder's error by angle has no meaning for the standard method: leave the harmonics out"
            )
        return rows
    rows = jnp.cumsum(rows, axis=0)
    if orders:
        phase = jnp.cumsum(timeline.turned())[:, None] * jnp.asarray(orders, dtype=rows.dtype)[None, :]
        # The reference is subtracted, hence the sign; the table starts at the angle 0.
        waves = jnp.stack([1.0 - jnp.cos(phase), -jnp.sin(phase)], axis=-1)
        rows = rows.at[:, model.columns.harmonics].set(jnp.reshape(waves, (rows.shape[0], -1)))
    gaps = timeline.gap_pieces.values
    if len(gaps):
        # After a gap the origin is the reading at its end.
        since = np.searchsorted(gaps, np.arange(timeline.piece_count), side="right") - 1
        origin = jnp.where(since[:, None] >= 0, rows[gaps[np.maximum(since, 0)]], 0.0)
        rows = rows - origin
    return rows


def _integrals(timeline: Timeline, of: Map, pieces: np.ndarray, nodes: int) -> tuple[Array, Array]:
    """Integrals over pieces of a map's functions and of those that its structure leaves out."""
    if not len(pieces):
        return jnp.zeros((0, of.size)), jnp.zeros((0, of.discrepancy_size))
    duration = timeline.duration[pieces]
    x, w = quadrature(nodes)
    temperature_breaks = of.temperature.breaks
    rate_breaks = () if of.rate is None else of.rate.breaks
    if temperature_breaks or rate_breaks:
        lower, upper = _smooth_panels(timeline, pieces, temperature_breaks, rate_breaks)
        width = (upper - lower)[..., None]
        v = jnp.reshape(lower[..., None] + width * jnp.asarray(x)[None, None], (len(pieces), -1))
        weight = jnp.reshape(width * jnp.asarray(w)[None, None], (len(pieces), -1))
    else:
        v = jnp.broadcast_to(jnp.asarray(x), (len(pieces), nodes))
        weight = jnp.broadcast_to(jnp.asarray(w), (len(pieces), nodes))
    temperature = timeline.temperature(v, pieces) + _hair(temperature_breaks)
    weight = weight * duration[:, None]
    if of.rate is None:
        inside = jnp.einsum("kq,kqa->ka", weight, of.temperature(temperature))
        return inside, jnp.einsum("kq,kqa->ka", weight, of.discrepancy_values(temperature, temperature))
    rate = timeline.rate(v, pieces)
    weight = weight * rate
    by_rate = of.rate(rate + _hair(rate_breaks)) * weight[..., None]
    inside = jnp.einsum("kqa,kqb->kab", of.temperature(temperature), by_rate)
    outside = jnp.einsum("kq,kqa->ka", weight, of.discrepancy_values(temperature, rate))
    return jnp.reshape(inside, (len(pieces), -1)), outside


def _hair(breaks: tuple[float, ...]) -> float:
    """By how much all breaks are taken lower than they are, a rounding error or some.

    A piece that ends on a break and the next, which begins there, must agree on who crosses it, or the crossing's
    derivative is lost; plans in round numbers do end there, and nothing is so round as a break less a hair.
    """
    return float(_HAIR * jnp.finfo(float).eps * (1.0 + max(abs(b) for b in breaks))) if breaks else 0.0


def _smooth_panels(
    timeline: Timeline, pieces: np.ndarray, temperature_breaks: tuple[float, ...], rate_breaks: tuple[float, ...]
) -> tuple[Float[Array, "k m"], Float[Array, "k m"]]:
    """Sub-intervals (fractions of each piece) on which neither variable crosses a break."""
    panels = _PANELS if rate_breaks else 1
    edges = jnp.linspace(0.0, 1.0, panels + 1)
    count = len(pieces)
    a = jnp.broadcast_to(edges[:-1], (count, panels))
    b = jnp.broadcast_to(edges[1:], (count, panels))
    bounds = [a, b]
    for variable, breaks in ((timeline.temperature, temperature_breaks), (timeline.rate, rate_breaks)):
        at = lambda v, f=variable: f(v, pieces)  # noqa: E731
        bounds += [_crossing(at, level - _hair(breaks), a, b) for level in breaks]
    ordered = jnp.sort(jnp.stack(bounds, axis=-1), axis=-1)
    flat = lambda x: jnp.reshape(x, (count, -1))  # noqa: E731
    return flat(ordered[..., :-1]), flat(ordered[..., 1:])


def _crossing(
    variable: Callable[[Array], Array], level: float, a: Float[Array, "k n"], b: Float[Array, "k n"]
) -> Float[Array, "k n"]:
    """Where `variable` crosses `level` between `a` and `b`, or `b` where it does not.

    Bisection finds the place and one Newton step, whose value is zero, gives it the derivative of the implicit
    function.
    """
    above_at_a = variable(a) >= level
    crosses = above_at_a != (variable(b) >= level)

    def halve(_, ends):
        low, high = ends
        middle = 0.5 * (low + high)
        same = (variable(middle) >= level) == above_at_a
        return jnp.where(same, middle, low), jnp.where(same, high, middle)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halve, (a, b))
    place = jax.lax.stop_gradient(0.5 * (low + high))
    value, slope = jax.jvp(variable, (place,), (jnp.ones_like(place),))
    slope = jax.lax.stop_gradient(slope)
    usable = crosses & (slope != 0.0)
    step = (value - jax.lax.stop_gradient(value)) / jnp.where(usable, slope, 1.0)
    return jnp.where(crosses, place - jnp.where(usable, step, 0.0), b)
