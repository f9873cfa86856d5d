"""The motion of a body on a table of several axes: the axis that each piece turns, and the nodes of the body.

One axis turns at a time; all others stand. Pieces, rates and temperatures are a `Trajectory`, as for a single axis; the
geometry yields the body's rate, specific force and attitude at every instant.

**Geometry.** Nested table axes on the rotating Earth; stages from outside in, body to East-North-Up:

    R = exp[τ×] · base · Rot(e₁,θ₁) · exp[δ₁d₁×] · Rot(e₂,θ₂) · … · mounting · exp[μ×]

τ tilt of the base and its azimuth, δ_l the non-orthogonality of the axes l and l+1 about `d_l = e_{l+1} × e_l`, μ the
error of the mounting. One rule gives the effect of each of them: a small rotation p (body components) inserted at a
stage adds `f × p` to the specific force and `ω_outer × p (+ ṗ along an axis that moves)` to the rate, ω_outer being
the rate outside that stage: the Earth's plus that of the outer axes.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.polynomial.legendre import legvander

from gradcal_jax.arrays import AnyArray, PytreeModule, cross, namespace, once, size_class, taken
from gradcal_jax.formulas import EARTH_RATE, play_states
from gradcal_jax.model import BodyNodes, NodeGroup
from gradcal_jax.motion.gauss import EDGE, crossings, temperature_crossings, turning_points
from gradcal_jax.motion.trajectory import Trajectory, quadrature


class Geometry(PytreeModule):
    """A table of `L` axes, outermost first, and the mountings of the body on it.

    `axes`: directions at zero, each in the frame of the next outer axis (the first: in that of the base). `base`: base
    to East-North-Up. `mountings`: body to the innermost axis, one for each mounting. `latitude` rad, `gravity` m/s².
    """

    axes: Float[AnyArray, "L 3"]
    base: Float[AnyArray, "3 3"]
    mountings: Float[AnyArray, "K 3 3"]
    latitude: Float[AnyArray, ""]
    gravity: Float[AnyArray, ""]

    @property
    def axis_count(self) -> int:
        return self.axes.shape[0]

    def earth_rate(self) -> Float[AnyArray, " 3"]:
        """The Earth's rate, East-North-Up, rad/s."""
        xp = namespace(self.latitude)
        return EARTH_RATE * xp.stack([xp.zeros(()), xp.cos(self.latitude), xp.sin(self.latitude)])


class Frames(NamedTuple):
    """The stages in the body's frame. `attitude` `(…, 3, 3)`: body to East-North-Up. Body components of the axes,
    `axes` `(…, L, 3)`, and of `d_l`, `crosses` `(…, L − 1, 3)`.
    """

    attitude: AnyArray
    axes: AnyArray
    crosses: AnyArray


def frames(geometry: Geometry, angles: Float[AnyArray, "*s L"], mounting: AnyArray) -> Frames:
    """The stages at the axes' `angles` (rad), for the mountings with the numbers `mounting` `(*s,)`."""
    xp = namespace(geometry, angles)
    inner = namespace(geometry.mountings, mounting).asarray(geometry.mountings)[mounting]
    axes, crosses = [], []
    for k in reversed(range(geometry.axis_count)):
        direction = geometry.axes[k]
        axes.append(_seen(inner, direction))
        if k + 1 < geometry.axis_count:
            crosses.append(_seen(inner, cross(geometry.axes[k + 1], direction)))
        inner = rotation(direction, angles[..., k]) @ inner
    none = xp.zeros((*angles.shape[:-1], 0, 3))
    outside_in = xp.stack(axes[::-1], axis=-2), xp.stack(crosses[::-1], axis=-2) if crosses else none
    return Frames(geometry.base @ inner, *outside_in)


def _seen(inner: AnyArray, direction: AnyArray) -> AnyArray:
    """A direction of a stage in components of the body: `innerᵀ direction`."""
    return (direction[None, :] @ inner)[..., 0, :]


def rotation(axis: Float[AnyArray, " 3"], angle: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s 3 3"]:
    """Rotation by `angle` (rad) about a unit vector (Rodrigues)."""
    xp = namespace(axis, angle)
    parts = np.eye(3), cross(axis[None, :], np.eye(3)).T, axis[:, None] * axis[None, :]
    one, skew, outer = (xp.reshape(part, (*(1,) * np.ndim(angle), 3, 3)) for part in parts)
    c, s = xp.cos(angle)[..., None, None], xp.sin(angle)[..., None, None]
    return c * one + s * skew + (1.0 - c) * outer


# Nodes for cubic polynomials in temperature and rate, smallest number for a turn, and nodes per rad: sines of an angle
# that changes by x rad within a piece need about x/2, with a margin.
_LEAST_NODES = 12
_FEWEST = 16
_NODES_PER_RAD = 0.75
# Angles that differ by less (rad) are the same pose.
_SAME_POSE = 1e-9
# Places for each node at which a crossing is looked for; bisections that locate it, to 2^-45 of their distance.
_FINE, _HALVINGS = 16, 45
# A rate's distance from a break that is rounding, as a share of the largest break.
_ROUNDING = 1e-14
# Divisions by plays nearer than this to an end of a piece, as a share of it, divide nothing: a play is continuous.
_PLAY_EDGE = 1e-9


class TableMotion(PytreeModule):
    """`line`: the pieces, `(P,)`; `axis`: the axis that each turns (−1: all stand); `mounting`: its number.

    `start_angles` rad: of the axes at the begin of the motion. Pieces of one `kind` differ only in temperature and by
    whole turns; `example` is a piece of each of the `K` kinds, and `nodes` its number of nodes. `history` °C: turning
    points of the temperature before the motion, in order. `divisions`: the divisions of the plan's line by which the
    pieces arose, in order (`Trajectory.divided`). `waves`: the fastest wave in a column, in cycles a turn; 0: columns
    depend on the angles at the ends of pieces alone; None: on none. `least`: nodes of a turning piece without waves.
    """

    line: Trajectory
    axis: Int[AnyArray, " P"]
    mounting: Int[AnyArray, " P"]
    geometry: Geometry
    start_angles: Float[AnyArray, " L"]
    kind: Int[np.ndarray, " P"]
    example: Int[np.ndarray, " K"]
    nodes: Int[np.ndarray, " K"]
    history: Float[AnyArray, " H"] | None = None
    divisions: tuple[tuple[np.ndarray, np.ndarray], ...] = ()
    waves: int | None = eqx.field(static=True, default=3)
    least: int = eqx.field(static=True, default=_FEWEST)

    @once
    def angles(self) -> tuple[Float[AnyArray, "P L"], Float[AnyArray, "P L"]]:
        """Angles of all axes (rad) as each piece begins and as it ends."""
        xp = namespace(self.line.duration, self.line.terms, self.start_angles)
        after = xp.cumsum(xp.where(self.turns, self.line.turned()[:, None], 0.0), axis=0) + self.start_angles[None]
        return xp.concatenate([self.start_angles[None], after[:-1]]), after

    @property
    def turns(self) -> Bool[AnyArray, "P L"]:
        """Which axis every piece turns."""
        return self.axis[:, None] == np.arange(self.geometry.axis_count)[None, :]


class Turns(NamedTuple):
    """Turns of a table's only axis: temperature (°C), rate and size (rad/s, rad), and the part of each that a radian of
    backlash takes away; `(n,)` each."""

    temperature_c: np.ndarray
    rate: np.ndarray
    size: np.ndarray
    lost: np.ndarray


def turns_of(motion: TableMotion) -> Turns | None:
    """The turns of the only axis of a table; None: it has several axes, or does not turn, or only rates are read."""
    line = motion.line
    if motion.geometry.axis_count != 1 or line.rates:
        return None
    before, after = (np.asarray(angles)[:, 0] for angles in motion.angles())
    sign = np.sign(after - before)
    # Pieces of one turn follow each other in one direction.
    begins = np.flatnonzero((sign != 0.0) & (np.concatenate([[0.0], sign[:-1]]) != sign))
    if not len(begins):
        return None
    ends = np.concatenate([begins[1:], [len(sign)]])
    moving = np.where(sign != 0.0, np.asarray(line.duration), 0.0)
    lasting = np.array([np.sum(moving[b:e]) for b, e in zip(begins, ends, strict=True)])
    way, back = after[ends - 1] - before[begins], np.concatenate([[0.0], sign[begins[:-1]]]) == -sign[begins]
    return Turns(np.asarray(line.level)[begins], way / lasting, np.abs(way), back / np.abs(way))


def nodes_of_turn(turned: Float[np.ndarray, " K"], waves: int) -> Int[np.ndarray, " K"]:
    """Nodes that pieces need which turn so far (rad), with waves of so many cycles a turn."""
    return _LEAST_NODES + np.ceil(_NODES_PER_RAD * turned * waves).astype(int)


def table_motion(
    line: Trajectory,
    axis: Int[np.ndarray, " P"],
    mounting: Int[np.ndarray, " P"],
    geometry: Geometry,
    start_angles: Float[np.ndarray, " L"],
    waves: int | None = 3,
    least: int = _FEWEST,
) -> TableMotion:
    """A motion whose numbers are known. `waves`, `least`: see `TableMotion`."""
    each = np.arange(line.piece_count)
    before, after = TableMotion(line, axis, mounting, geometry, start_angles, each, each, each).angles()
    pose = np.round(np.mod(before, 2.0 * np.pi) / _SAME_POSE) % np.round(2.0 * np.pi / _SAME_POSE)
    # Standing pieces are alike wherever they lie in their rest.
    within = np.where(line.turning(), [line.u_start, line.u_end], 0.0)
    terms = line.terms.T[np.any(line.terms, axis=0)]
    of_motion = np.round(np.stack([line.duration, *within, *terms]) / _SAME_POSE)
    # The encoder's error is interpolated between standstills over the whole move of a piece.
    first = np.flatnonzero(np.diff(line.segment, prepend=line.segment[0] - 1))
    segment = np.repeat(np.arange(len(first)), np.diff(first, append=line.piece_count))
    ends = np.append(first[1:], line.piece_count) - 1
    of_move = np.round(
        np.concatenate([(before - before[first][segment]).T, (after[ends] - before[first])[segment].T]) / _SAME_POSE
    )
    of_angles = [] if waves is None else [pose.T, of_move]
    key = np.concatenate([np.stack([axis, mounting, line.moving]), of_motion, *of_angles])
    example, kind = _alike(key)
    turned = np.abs(line.turned()[example])
    nodes = nodes_of_turn(turned, waves or 0)
    # A standing piece has a constant attitude and one node. Few sizes: each costs more than some additional nodes.
    sizes = np.array([least, *(size_class(4 * least * 2**k) for k in range(12))])
    nodes = np.where(axis[example] < 0, 1, sizes[np.searchsorted(sizes, nodes)] if waves else least)
    return TableMotion(line, axis, mounting, geometry, start_angles, kind, example, nodes, waves=waves, least=least)


def _alike(key: Float[np.ndarray, "c P"]) -> tuple[np.ndarray, np.ndarray]:
    """The first column of each kind of equal columns, and the kind of every column."""
    # Most follow one that is equal.
    begins = np.append(True, np.any(key[:, 1:] != key[:, :-1], axis=0))
    at = np.flatnonzero(begins)
    columns = np.ascontiguousarray((key[:, at] + 0.0).T)
    # (As bytes: sorting columns of floats takes ten times as long.)
    whole = columns.view(np.dtype((np.void, columns.itemsize * columns.shape[1])))[:, 0]
    _, example, kind = np.unique(whole, return_index=True, return_inverse=True)
    return at[example], kind[np.cumsum(begins) - 1]


def divided_motion(
    motion: TableMotion, temperature_breaks: tuple[float, ...], rate_breaks: dict[int, tuple[float, ...]]
) -> TableMotion:
    """The motion with its pieces divided where functions of temperature or rate are not smooth (bins, B-splines).

    `temperature_breaks` °C; `rate_breaks` rad/s of the gyro along each of the body's axes, against the stars: the
    Earth's rate belongs to what it measures. Numbers must be known.
    """
    if not temperature_breaks and not rate_breaks:
        return motion
    pieces, at = temperature_crossings(motion.line, temperature_breaks)
    kinds, of_kinds = _rate_crossings(motion, rate_breaks)
    for kind in np.unique(kinds):
        alike, own = np.flatnonzero(motion.kind == kind), of_kinds[kinds == kind]
        pieces = np.concatenate([pieces, np.repeat(alike, len(own))])
        at = np.concatenate([at, np.tile(own, len(alike))])
    return _divided(motion, pieces, at, EDGE)


def _divided(motion: TableMotion, pieces: np.ndarray, at: np.ndarray, edge: float) -> TableMotion:
    """The motion with `pieces` divided at the fractions `at`, of those within `edge` at the first."""
    if not len(pieces):
        return motion
    order = np.lexsort((at, pieces))
    pieces, at = pieces[order], at[order]
    apart = (np.diff(pieces, prepend=-1) != 0) | (np.diff(at, prepend=-1.0) > edge)
    division = pieces[apart], at[apart]
    line, source = motion.line.divided(*division)
    of_pieces = motion.axis[source], motion.mounting[source], motion.geometry, motion.start_angles
    made = table_motion(line, *of_pieces, motion.waves, motion.least)
    return replace(made, history=motion.history, divisions=(*motion.divisions, division))


def motion_divided_by_plays(motion: TableMotion, widths: tuple[float, ...]) -> TableMotion:
    """The motion with its pieces divided where the temperature turns, and where plays of these half-widths (K) begin or
    cease to follow it, so that they are smooth on every piece. Numbers must be known."""
    turning, at = turning_points(motion.line)
    inside = (at > _PLAY_EDGE) & (at < 1.0 - _PLAY_EDGE)
    motion = _divided(motion, turning[inside], at[inside], 0.0)
    line, (begin, end) = motion.line, motion.line.ends()
    pieces, places = [np.zeros(0, int)], [np.zeros(0)]
    earlier = begin[:1] if motion.history is None else np.append(motion.history, begin[0])
    whole = np.zeros(len(begin)), np.ones(len(begin))
    for width in widths:
        # The states before each piece; the pieces are monotone.
        states = play_states(np.concatenate([earlier, end]), width)
        for state in (np.asarray(of)[len(earlier) - 1 : -1] for of in states):
            crossed, at = crossings(line, state + np.where(end > begin, width, -width), *whole)
            pieces.append(crossed)
            places.append(at)
    piece, place = np.concatenate(pieces), np.concatenate(places)
    inside = (place > _PLAY_EDGE) & (place < 1.0 - _PLAY_EDGE)
    return _divided(motion, piece[inside], place[inside], _PLAY_EDGE)


def _rate_crossings(motion: TableMotion, breaks: dict[int, tuple[float, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """The kinds of pieces, and the fractions of them, at which the rate along a body axis crosses one of its breaks."""
    before, _ = motion.angles()
    kinds, places = [np.zeros(0, int)], [np.zeros(0)]
    for count in np.unique(motion.nodes[motion.nodes > 1]) if breaks else ():
        every = np.flatnonzero(motion.nodes == count)
        # So fine that a turning point between two of its places hardly leaves the side of both.
        grid = np.linspace(0.0, 1.0, _FINE * int(count) + 1)
        seen = _body_rate(motion, every, before, np.broadcast_to(grid, (len(every), len(grid))))
        for axis, levels in breaks.items():
            slack = _ROUNDING * max(map(abs, levels), default=0.0)
            for level in levels:
                above = seen[..., axis] >= level - slack
                row, k = np.nonzero(above[:, 1:] != above[:, :-1])
                low, high = grid[k], grid[k + 1]
                for _ in range(_HALVINGS):
                    middle = 0.5 * (low + high)
                    now = _body_rate(motion, every[row], before, middle[:, None])[:, 0, axis] >= level - slack
                    low, high = np.where(now == above[row, k], [middle, high], [low, middle])
                kinds.append(every[row])
                places.append(0.5 * (low + high))
    kind, place = np.concatenate(kinds), np.concatenate(places)
    inside = (place > EDGE) & (place < 1.0 - EDGE)
    return kind[inside], place[inside]


def _body_rate(motion: TableMotion, kinds: np.ndarray, before, v: np.ndarray) -> np.ndarray:
    """The body's rate (rad/s, against the stars) at fractions `v` `(n, q)` of examples of the `kinds` `(n,)`."""
    angle, joint, mounting = _posed(motion, kinds, before, v)
    stages = frames(motion.geometry, angle, mounting)
    earth = (motion.geometry.earth_rate()[None, :] @ stages.attitude)[..., 0, :]
    return earth + np.sum(joint[..., None] * stages.axes, axis=-2)


def _posed(motion: TableMotion, kinds: np.ndarray, before, v):
    """Angles (rad), rates (rad/s) of all axes and the mounting at fractions `v` `(n, q)` of examples of `kinds`."""
    xp, example = namespace(before, motion.line.duration), motion.example[kinds]
    own = motion.turns[example][:, None, :]
    began, mounting = taken(before, example)[:, None, :], xp.broadcast_to(motion.mounting[example][:, None], v.shape)
    if xp is np and not np.any(own):
        still = np.broadcast_to(began, (*v.shape, own.shape[-1]))
        return still, np.zeros(still.shape), mounting
    since, rate = motion.line.angle(v, example), motion.line.rate(v, example)
    return began + xp.where(own, since[..., None], 0.0), xp.where(own, rate[..., None], 0.0), mounting


def body_nodes(motion: TableMotion, points: int) -> BodyNodes:
    """The nodes of a unit's terms, with functions of temperature interpolated from `points` points on each piece."""
    example = motion.example
    all_before, all_after = motion.angles()
    before, after = taken(all_before, example), taken(all_after, example)
    begin, end = motion.line.ends()
    groups = tuple(
        _group(motion, np.flatnonzero(motion.nodes == n), int(n), points, all_before) for n in np.unique(motion.nodes)
    )
    axis, mounting = motion.axis[example], motion.mounting[example]
    axes = frames(motion.geometry, before, mounting).axes
    path = begin, motion.history
    return BodyNodes(groups, motion.kind, end - begin, before, after, axes, axis, mounting, *path)


def _group(motion: TableMotion, kinds: np.ndarray, count: int, points: int, before) -> NodeGroup:
    line, geometry, xp = motion.line, motion.geometry, namespace(before, motion.line.duration, motion.geometry)
    example = motion.example[kinds]
    x, w = quadrature(count)
    v = xp.broadcast_to(xp.asarray(x), (len(kinds), count))
    angle, joint, mounting = _posed(motion, kinds, before, v)
    number = np.full(len(motion.example), -1)
    number[kinds] = np.arange(len(kinds))
    kind = number[motion.kind]
    pieces = np.flatnonzero(kind >= 0)
    at, of_points = quadrature(points)
    places = xp.broadcast_to(xp.asarray(at), (len(pieces), points))
    temperatures = line.temperature(places, pieces)
    # A single node stands for what is constant along the piece.
    share = of_points[None] if count == 1 else lagrange(at, x)
    weight = xp.asarray(w)[None] * taken(line.duration, example)[:, None]
    since = places * taken(line.duration, pieces)[:, None]
    path = taken(line.start, pieces)[:, None] + since, line.temperature_slope(since, pieces)
    numbers = kinds, pieces, kind[pieces]
    return body_group(geometry, numbers, temperatures, share, weight, angle, joint, mounting, path)


def body_group(
    geometry: Geometry,
    pieces: tuple[np.ndarray, np.ndarray, np.ndarray],
    temperature: Float[AnyArray, "k m"],
    share: Float[np.ndarray, "q m"],
    weight: Float[AnyArray, "U q"],
    angle: Float[AnyArray, "U q L"],
    joint: Float[AnyArray, "U q L"],
    mounting: Int[AnyArray, "U q"],
    path: tuple[Any, Any] = (None, None),
) -> NodeGroup:
    """A group of nodes at which the table's axes stand at `angle` (rad) and turn at `joint` (rad/s).

    `pieces`: numbers of the kinds, of the pieces, and of each piece's kind among the former; `path`: time and
    slope. The rest: see `NodeGroup`.
    """
    xp = namespace(geometry, angle, joint)
    stages = frames(geometry, angle, mounting)
    earth, up = (geometry.earth_rate()[None, :] @ stages.attitude)[..., 0, :], stages.attitude[..., 2, :]
    turning = joint[..., None] * stages.axes
    below = xp.cumsum(turning, axis=-2)
    rate, outer = earth + below[..., -1, :], earth[..., None, :] + below - turning
    seen = rate, geometry.gravity * up, earth, up, stages.attitude, stages.axes, stages.crosses
    time, slope = path
    seen = *seen, outer, joint, angle
    return NodeGroup(*pieces, temperature, share, weight, *seen, time=time, slope=slope)


def lagrange(points: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The interpolating polynomials of `points` `(m,)` in [0, 1], at the places `at` `(q,)`: `(q, m)`."""
    of = lambda x: legvander(2.0 * x - 1.0, len(points) - 1)  # noqa: E731
    return np.linalg.solve(of(points).T, of(at).T).T
