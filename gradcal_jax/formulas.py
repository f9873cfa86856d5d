"""Basis functions and motion shapes, written once for every array namespace.

The core (JAX), the simulated devices and `apply` (NumPy) call the same functions; this module imports neither. Every
function takes arrays with `__array_namespace__` and works elementwise, with one new last axis where stated.

**Motion.** Every smooth piece of every motion is a combination of one small family of functions of the fraction
`u ∈ [0, 1]` of its duration,

    rate(u) = Σ_m c_m f_m(u),   f = 1, u, u², u³, cos πu, sin πu, cos 2πu, sin 4πu, sin 6πu, sin 8πu

so a piece is one number for each of these terms (`MOTION_TERMS`), its angle is a closed form, and shapes mix in one
array without branches. `shape_pieces` gives the pieces of each named shape for unit peak rate.
"""

from collections import namedtuple
from importlib import import_module
from itertools import pairwise
from math import exp, expm1, floor, pi
from typing import Any, NamedTuple

Array = Any
EARTH_RATE = 7.292115e-5
"""rad/s, of the Earth against the stars (WGS 84)."""
# Over a shorter break of a log the temperature is continuous; after a longer one a run begins with a stable chamber,
# and the lag has decayed.
BRIDGED_S = 60.0

# --- bases ------------------------------------------------------------------------------------------------------------


def monomials(x: Array, degree: int) -> Array:
    """`1, x, …, x^degree` on a new last axis: `(...) -> (..., degree + 1)`."""
    xp = x.__array_namespace__()
    columns = [xp.ones_like(x)]
    for _ in range(degree):
        columns.append(columns[-1] * x)
    return xp.stack(columns, axis=-1)


def legendre(x: Array, degree: int) -> Array:
    """Legendre polynomials with P(1) = 1, `(...) -> (..., degree + 1)`; orthogonal on [-1, 1]."""
    xp = x.__array_namespace__()
    columns = [xp.ones_like(x), x]
    for n in range(2, degree + 1):
        columns.append(((2 * n - 1) * x * columns[-1] - (n - 1) * columns[-2]) / n)
    return xp.stack(columns[: degree + 1], axis=-1)


def bins(x: Array, edges: tuple[float, ...]) -> Array:
    """Indicator of each bin, `(...) -> (..., len(edges) - 1)`; a value outside belongs to the nearest bin."""
    xp = x.__array_namespace__()
    above = [xp.ones_like(x), *(xp.where(x >= e, 1.0, 0.0) for e in edges[1:-1]), xp.zeros_like(x)]
    return xp.stack([above[i] - above[i + 1] for i in range(len(edges) - 1)], axis=-1)


def b_spline(x: Array, knots: tuple[float, ...], degree: int) -> Array:
    """Clamped B-splines by the Cox–de Boor recursion, `(...) -> (..., len(knots) - 1 + degree)`.

    `knots` increase and include both ends, where they are repeated here. Outside them the value at the nearest end
    applies.
    """
    xp = x.__array_namespace__()
    x = xp.clip(x, knots[0], knots[-1])
    t = (knots[0],) * degree + tuple(knots) + (knots[-1],) * degree
    spans = bins(x, tuple(knots))
    zero = xp.zeros_like(x)
    values = [zero] * degree + [spans[..., i] for i in range(len(knots) - 1)] + [zero] * degree
    for d in range(1, degree + 1):
        raised: list[Array] = []
        for i in range(len(values) - 1):
            left, right = t[i + d] - t[i], t[i + d + 1] - t[i + 1]
            value = zero
            if left > 0.0:
                value = value + (x - t[i]) / left * values[i]
            if right > 0.0:
                value = value + (t[i + d + 1] - x) / right * values[i + 1]
            raised.append(value)
        values = raised
    return xp.stack(values, axis=-1)


# --- plays ------------------------------------------------------------------------------------------------------------

Clamps = tuple[Array, Array]
"""Lower and upper bounds of clamps: `x -> max(low, min(high, x))`."""


def then(first: Clamps, second: Clamps) -> Clamps:
    """The clamp that applies one after the other."""
    (a, b), (low, high) = first, second
    xp = (a + low).__array_namespace__()
    return xp.maximum(low, xp.minimum(high, a)), xp.maximum(low, xp.minimum(high, b))


def running_clamps(low: Array, high: Array) -> Clamps:
    """Compositions of all clamps `(…, n)` up to and including each one, along the last axis, in log₂ n rounds."""
    xp, step = (low + high).__array_namespace__(), 1
    while step < low.shape[-1]:
        more = then((low[..., :-step], high[..., :-step]), (low[..., step:], high[..., step:]))
        low, high = (
            xp.concatenate([old[..., :step], new], axis=-1) for old, new in zip((low, high), more, strict=True)
        )
        step *= 2
    return low, high


def play_states(temperature: Array, width: float | Array) -> Clamps:
    """The two extreme states `(n,)` (°C) of a play of half-width `width` (K) at turning points of a monotone course or
    finer samples of any course `(n,)` (°C): see `model.path`."""
    return running_clamps(temperature - width, temperature + width)


# --- motion -----------------------------------------------------------------------------------------------------------

MOTION_TERMS = ("u0", "u1", "u2", "u3", "cos1", "sin1", "cos2", "sin4", "sin6", "sin8")
"""Powers of u, and waves by their number of half periods."""


def _waves(u: Array) -> tuple[Array, ...]:
    """Sines and cosines of πu, 2πu, 4πu, 6πu and 8πu; only the first are computed by the library, which is slow."""
    xp = u.__array_namespace__()
    s1, c1 = xp.sin(pi * u), xp.cos(pi * u)
    s2, c2 = 2.0 * s1 * c1, c1 * c1 - s1 * s1
    s4, c4 = 2.0 * s2 * c2, c2 * c2 - s2 * s2
    return s1, c1, s2, c2, s4, c4, s4 * c2 + c4 * s2, c4 * c2 - s4 * s2, 2.0 * s4 * c4, c4 * c4 - s4 * s4


def motion_rate(u: Array) -> Array:
    """The motion family at the fraction `u` of a piece, `(...) -> (..., terms)`."""
    xp = u.__array_namespace__()
    s1, c1, _, c2, s4, _, s6, _, s8, _ = _waves(u)
    return xp.stack([xp.ones_like(u), u, u * u, u * u * u, c1, s1, c2, s4, s6, s8], axis=-1)


def motion_angle(u: Array) -> Array:
    """Integral of the motion family from 0 to `u`, `(...) -> (..., terms)`; times the duration it is an angle."""
    xp = u.__array_namespace__()
    s1, c1, s2, c2, s4, *_ = _waves(u)
    powers = [u, u * u / 2, u * u * u / 3, u * u * u * u / 4]
    # 1 − cos 2x = 2 sin² x, without cancellation.
    s3 = s2 * c1 + c2 * s1
    waves = [s1 / pi, (1.0 - c1) / pi, s2 / (2 * pi), s2 * s2 / (2 * pi), s3 * s3 / (3 * pi), s4 * s4 / (4 * pi)]
    return xp.stack([*powers, *waves], axis=-1)


class Ramps(NamedTuple):
    """A turn with two equal ramps and a constant rate between them: the terms of the rate on the first ramp, `rising`
    from 0 to 1 with the mean 1/2 (on the second ramp the rate is 1 less of it); and `steepness`, the peak acceleration
    times the ramp's duration over the peak rate."""

    rising: tuple[float, ...]
    steepness: float


_terms = namedtuple("_terms", MOTION_TERMS, defaults=[0.0] * len(MOTION_TERMS))
CONSTANT = _terms(u0=1.0)
RAMPS = {
    "cosine ramps": Ramps(_terms(u0=0.5, cos1=-0.5), pi / 2),
    "linear ramps": Ramps(_terms(u1=1.0), 1.0),
}
"""A shape with ramps needs nothing but its row here."""
SHAPES = (*RAMPS, "hand")


def shape_pieces(shape: str, *, unevenness: float = 0.0, stands: bool = False) -> list[tuple[str, tuple[float, ...]]]:
    """The smooth pieces of a shape for unit peak rate, as `(what, coefficients)`.

    `what` is "ramp" (lasts the ramp time), "flat" (what the two ramps leave) or "turn" (likewise, of a rate that
    varies). `stands`: a turn by hand that stands for the ramp time before and after turning. Errors: `ValueError` for
    an unknown shape.
    """
    if shape in RAMPS:
        rising = RAMPS[shape].rising
        falling = tuple(whole - part for whole, part in zip(CONSTANT, rising, strict=True))
        return [("ramp", rising), ("flat", CONSTANT), ("ramp", falling)]
    if shape != "hand":
        raise ValueError(f"unknown motion shape {shape!r}; known: {', '.join(SHAPES)}")
    # ½(1 − cos 2πu)(1 + e·sin 6πu), expanded: alternating rates.
    e = unevenness
    turn = ("turn", _terms(u0=0.5, cos2=-0.5, sin4=-e / 4, sin6=e / 2, sin8=-e / 4))
    still = ("ramp", _terms())
    return [still, turn, still] if stands else [turn]


def repetitions(duration: float, own: float, period: float) -> tuple[int, float]:
    """Number of cycles of `period`, of which the first `own` are its moves, in `duration`, and the remaining time.

    A cycle counts when its moves still fit; the axis stands in the time after the last one's moves.
    """
    rounding = 1e-9
    room = duration * (1.0 + rounding) - own
    if room < 0.0 or period <= 0.0:
        return 0, duration
    count = int(room / period + rounding) + 1
    return count, max(0.0, duration - (count - 1) * period - own)


def reading_count(duration: float, every: float) -> int:
    """Number of readings, `every` apart, within `duration`; rounding does not lose the last one."""
    return floor(duration / every * (1.0 + 1e-9) + 1e-9)


def reading_times(duration: float, every: float | None) -> list[float]:
    """Times of these readings from the start; none for `every=None`."""
    if every is None:
        return []
    return [min(k * every, duration) for k in range(1, reading_count(duration, every) + 1)]


# --- temperature ------------------------------------------------------------------------------------------------------


def lagged_temperature(t: Array, start: Array, slope: Array, excess: Array, lag_rate: Array) -> Array:
    """Sensor temperature `t` seconds into a stretch on which the chamber moves at a constant slope.

    The chamber is at `start + slope·t`; the sensor follows `dT/dt = (T_chamber − T)·lag_rate`, so its deviation from
    the steady state `T_chamber − slope/lag_rate` decays. `excess` is that deviation at t = 0, in K, and `start` the
    start of the *steady state*: without a lag it is the chamber's start, and `excess = 0`.
    """
    xp = t.__array_namespace__()
    return start + slope * t + excess * xp.exp(-lag_rate * t)


def lag_filter(interval_s: float, lag_s: float) -> tuple[list[float], list[float]]:
    """A first-order lag behind samples `interval_s` apart with linear interpolation: numerator and denominator of the
    recursion, as `scipy.signal.lfilter` takes them. (A plain recursion would lag by half a sample.)
    """
    ratio = interval_s / lag_s
    keep, share = exp(-ratio), -expm1(-ratio) / ratio
    return [1.0 - share, share - keep], [1.0, -keep]


def followed(temperature_c: Array, time_s: Array, starts: Array, lag_s: float) -> Array:
    """The temperature of the maps: the measured one `(n,)`, whose unbroken stretches begin at the rows `starts`, with a
    first-order lag. It begins in equilibrium, also after every long break; over a short break the temperature is
    interpolated linearly. NumPy."""
    if lag_s <= 0.0:
        return temperature_c
    # Imported where it is used: it imports all of SciPy's statistics.
    signal: Any = import_module("scipy.signal")
    result = 0.0 * temperature_c
    for first, end in pairwise([*starts.tolist(), len(temperature_c)]):
        result[first] = temperature_c[first]
        if first and (gap := float(time_s[first] - time_s[first - 1])) <= BRIDGED_S:
            (now, before), (_, kept) = lag_filter(gap, lag_s)
            result[first] = now * temperature_c[first] + before * temperature_c[first - 1] - kept * result[first - 1]
        if end - first > 1:
            interval = float(time_s[end - 1] - time_s[first]) / (end - 1 - first)
            numerator, denominator = lag_filter(interval, lag_s)
            state = [numerator[1] * temperature_c[first] - denominator[1] * result[first]]
            late: Any = signal.lfilter(numerator, denominator, temperature_c[first + 1 : end], zi=state)
            result[first + 1 : end] = late[0]
    return result


def runs(where: Array) -> Array:
    """Runs of true values: `(n,) -> (runs, 2)`, first index and the index after the last."""
    xp = where.__array_namespace__()
    outside = xp.zeros(1, dtype=bool)
    padded = xp.concat([outside, where, outside])
    return xp.reshape(xp.nonzero(padded[1:] != padded[:-1])[0], (-1, 2))
