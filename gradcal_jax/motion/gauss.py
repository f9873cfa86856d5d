"""Gauss nodes of a trajectory, on which the terms of a model are integrated piece by piece.

Each smooth piece is integrated by Gauss–Legendre quadrature, exact to rounding for polynomial bases. Where a basis has
breaks (bins, B-splines) a piece is divided at the instants at which temperature or rate cross them; the derivatives of
these instants are included.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, fixed, namespace, repeated, running_sum
from gradcal_jax.model import BSpline, Discrepancy, GaussNodes, HigherPolynomials, Map, Nodes, Polynomial, SensorModel
from gradcal_jax.motion.trajectory import Trajectory, quadrature

# 16 nodes resolve a raised cosine to the fourth power, the fastest variation of a cubic M(T, ω), to 1e-12; each higher
# degree in rate adds a period, and two nodes. Cosine ramps and half sines have half as many periods: 10 nodes, and one
# more for each degree, are as accurate.
_MOVING_NODES = 16
_CUBIC = 3
_HALF_WAVE_NODES = 10
# The first terms of the motion family (`formulas.MOTION_TERMS`) are powers of the time, the next ones half waves.
_POWERS, _HALF_WAVES = 4, 6
# The exponentials of a thermal lag are not polynomials.
_LAGGED_NODES = 16
# A piece is bisected towards its start until the lag's exponential decays by less than about e^(this) in each part.
_LAG_TIMES = 8.0
# Divisions nearer than this to an end of a piece, or to each other, as a share of the piece, divide nothing.
EDGE = 1e-12
# Number of panels of a piece; in each a shape has at most one turning point, which is computed.
_PANELS = 8
# Bisection steps that locate a crossing, to 2^-45 of a panel.
_HALVINGS = 45
# In units of rounding: more than the temperature's error at the end of a long ramp, negligible in any integral.
_BREAK_SHIFT = 1e2


class Rule(NamedTuple):
    """How a model's terms are integrated: number of nodes of a moving and of a standing piece (or part of it); breaks
    of the bases; number of bisections of a piece with thermal lag; whether the rate drives any noise (`driven`).
    Structure, not numbers.
    """

    moving: int
    standing: int
    temperature_breaks: tuple[float, ...]
    rate_breaks: tuple[float, ...]
    lag_halves: int
    driven: bool


def rule_of(model: SensorModel, trajectory: Trajectory) -> Rule:
    """The integration rule of a model's terms on trajectories like this one, whose numbers are known."""
    bases = [
        basis for term in model.terms if isinstance(term, Map | Discrepancy) for basis in (term.temperature, term.rate)
    ]
    of_temperature, of_rate = [[b for b in group if b is not None] for group in (bases[::2], bases[1::2])]
    warm, fast = (tuple(sorted({b for basis in group for b in basis.breaks})) for group in (of_temperature, of_rate))
    degree = max((_degree(basis) for basis in of_rate), default=0)
    lagged = bool(np.any(np.asarray(trajectory.excess) != 0.0))
    decays = float(np.max(np.where(trajectory.gap, 0.0, trajectory.duration), initial=0.0) * trajectory.lag_rate)
    halves = int(np.ceil(np.log2(max(decays / _LAG_TIMES, 1.0)))) if lagged else 0
    of_time = max(_degree(basis) for basis in of_temperature)
    standing = _LAGGED_NODES if lagged else of_time // 2 + 1
    moving = _MOVING_NODES + 2 * max(0, degree - _CUBIC)
    # Linear ramps and splines are polynomials in time, which few nodes integrate exactly.
    present = np.asarray(trajectory.terms)[np.asarray(trajectory.moving)] != 0.0
    powers = np.flatnonzero(np.any(present, axis=0))
    # The shape of a move is unknown if it does not turn here but may where the rule is used.
    if not lagged and np.all(np.any(present, axis=1)) and np.all(powers < _HALF_WAVES):
        smooth = np.all(powers < _POWERS)
        exact = ((degree + 1) * int(np.max(powers, initial=0)) + of_time) // 2 + 1
        moving = min(moving, exact if smooth else _HALF_WAVE_NODES + degree)
    driven = bool(np.any(np.asarray(model.processes.rate_gain) != 0.0))
    return Rule(moving, standing, warm, fast, halves, driven)


def _degree(basis) -> int:
    return basis.degree if isinstance(basis, Polynomial | HigherPolynomials | BSpline) else 0


def temperature_crossings(line: Trajectory, breaks: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """The pieces, and the fractions of each, at which the temperature of a trajectory with known numbers crosses a
    break; also where it turns within a piece."""
    pieces = np.flatnonzero(~np.asarray(line.gap))
    if not line.lagged:
        begin, end = (np.searchsorted(breaks, of + _break_shift(breaks)) for of in line.ends())
        pieces = pieces[(begin != end)[pieces]]
    if not len(pieces) or not breaks:
        return pieces[:0], np.zeros(0)
    lower, _ = _smooth_panels(line, pieces, Rule(0, 0, breaks, (), 0, driven=False), ())
    row, column = np.nonzero((lower > EDGE) & (lower < 1.0 - EDGE) & (np.diff(lower, axis=1, prepend=-1.0) > EDGE))
    return pieces[row], lower[row, column]


def gauss_nodes(trajectory: Trajectory, model: SensorModel, rule: Rule | None = None) -> Nodes:
    """The nodes on which the model's terms are integrated. `rule`: that of its class, for traced numbers."""
    line = trajectory
    rule = rule_of(model, line) if rule is None else rule
    xp = namespace(line)
    count = line.piece_count
    if isinstance(line.moving, jax.Array):
        # With traced structure all pieces are integrated as standing ones, and moving ones are overwritten.
        standing = [(np.arange(count), rule)]
    else:
        where = np.asarray(~line.moving & ~line.gap)
        # Traced times may become long, so all pieces are divided alike.
        long = where & (np.asarray(line.duration * line.lag_rate) > _LAG_TIMES if xp is np else rule.lag_halves > 0)
        brief = np.flatnonzero(where & ~long), rule._replace(lag_halves=0)
        standing = [brief, (np.flatnonzero(long), rule)]
    kinds = [(pieces, its, False) for pieces, its in standing] + [(line.moving_pieces, rule, True)]
    groups = [_group(line, pieces, its, moving=moving) for pieces, its, moving in kinds if pieces.shape[0]]
    angle = running_sum(line.turned())
    begin, end = line.ends()
    return Nodes(tuple(groups), end - begin, xp.concatenate([xp.zeros(1), angle[:-1]]), angle)


def _group(line: Trajectory, pieces, rule: Rule, *, moving: bool) -> GaussNodes:
    count = pieces.shape[0]
    xp = namespace(line)
    x, w = quadrature(rule.moving if moving else rule.standing)
    rate_breaks = rule.rate_breaks if moving else ()
    if rule.temperature_breaks or rate_breaks or rule.lag_halves:
        lower, upper = _smooth_panels(line, pieces, rule, rate_breaks)
        width = (upper - lower)[..., None]
        v = xp.reshape(lower[..., None] + width * x[None, None], (count, -1))
        weight = xp.reshape(width * w[None, None], (count, -1))
    else:
        v, weight = (xp.broadcast_to(xp.asarray(values), (count, len(x))) for values in (x, w))
    weight = weight * line.duration[pieces][:, None]
    temperature = line.temperature(v, pieces) + _break_shift(rule.temperature_breaks)
    rate = line.rate(v, pieces) if moving else xp.zeros(v.shape)
    return GaussNodes(pieces, weight, rate, temperature, moving)


def _break_shift(breaks: tuple[float, ...]) -> float:
    """Shift of all breaks downwards, by a few rounding errors.

    A piece that ends at a break and the next one, which begins there, must agree on which of them crosses it, or the
    derivative of the crossing is lost. Pieces of plans in round numbers do end at breaks, but not at shifted ones.
    """
    return float(_BREAK_SHIFT * np.finfo(float).eps * (1.0 + max(abs(b) for b in breaks))) if breaks else 0.0


def _smooth_panels(line: Trajectory, pieces, rule: Rule, rate_breaks: tuple[float, ...]):
    """Sub-intervals `(k, m)`, lower and upper (fractions of each piece), on which neither variable crosses a break."""
    xp, count = namespace(line), pieces.shape[0]
    panels = _PANELS if rate_breaks else 1
    edges = np.union1d(np.linspace(0.0, 1.0, panels + 1), 0.5 ** np.arange(rule.lag_halves + 1.0))
    a, b = (xp.broadcast_to(xp.asarray(e), (count, len(edges) - 1)) for e in (edges[:-1], edges[1:]))

    def temperature(v):
        return line.temperature(v, pieces) + _break_shift(rule.temperature_breaks)

    def rate(v):
        return line.rate(v, pieces) + _break_shift(rate_breaks)

    def temperature_slope(v):
        duration, slope, excess = (f[pieces][:, None] for f in (line.duration, line.slope, line.excess))
        return duration * (slope - line.lag_rate * excess * xp.exp(-line.lag_rate * duration * v))

    def rate_slope(v):
        u_start, u_end = line.u_start[pieces][:, None], line.u_end[pieces][:, None]
        family = formulas.motion_acceleration(u_start + (u_end - u_start) * v)
        return (family @ line.terms[pieces][:, :, None])[..., 0] * (u_end - u_start)

    bounds = [a, b]
    for variable, slope, breaks in (
        (temperature, temperature_slope, rule.temperature_breaks),
        (rate, rate_slope, rate_breaks),
    ):
        if not breaks:
            continue
        # A turning point divides a part, so that no break is crossed twice in either of the two.
        turning = fixed(_root(slope, 0.0, a, b))
        for low, high in ((a, turning), (turning, b)):
            bounds += [_crossing(variable, slope, level, low, high) for level in breaks]
    ordered = xp.sort(xp.stack(bounds, axis=-1), axis=-1)
    flat = lambda values: xp.reshape(values, (count, -1))  # noqa: E731
    return flat(ordered[..., :-1]), flat(ordered[..., 1:])


def _root(variable, level: float, a, b):
    """Where `variable` crosses `level` between `a` and `b`, by bisection; `b` where it does not."""
    xp = namespace(a, b, variable(a))
    above_at_a = variable(a) >= level
    crosses = above_at_a != (variable(b) >= level)

    def halve(ends):
        low, high = ends
        middle = 0.5 * (low + high)
        same = (variable(middle) >= level) == above_at_a
        return xp.where(same, middle, low), xp.where(same, high, middle)

    low, high = repeated(_HALVINGS, halve, (a + 0.0 * variable(a), b + 0.0 * variable(a)))
    return xp.where(crosses, 0.5 * (low + high), b)


def _crossing(variable, slope, level: float, a: Float[AnyArray, "k n"], b: Float[AnyArray, "k n"]):
    """As `_root`; one Newton step of value zero adds the derivative of the implicit function."""
    place = fixed(_root(variable, level, a, b))
    xp = namespace(place)
    value, steep = variable(place), fixed(slope(place))
    crosses = (fixed(variable(a)) >= level) != (fixed(variable(b)) >= level)
    usable = crosses & (steep != 0.0)
    step = (value - fixed(value)) / xp.where(usable, steep, 1.0)
    return xp.where(crosses, place - xp.where(usable, step, 0.0), b)
