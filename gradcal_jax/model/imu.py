"""The model of a whole unit: a channel for each gyro and accelerometer, and the installation common to all.

Row of a channel i over a segment of the motion (a rest, or one move of one axis), in body components:

    gyro            ∫ω̃_i dt − ∫(Rᵀω_earth)_i dt − Σ_l a_li Δθ̃_l
    accelerometer   ∫f̃_i dt − ∫(Rᵀ(0, 0, g))_i dt

Each is linear in the channel's own terms (`terms`, signal × function of temperature), in the installation's
(`installation`), and in the encoders' errors at each standstill, which are noise. The parameter vector is the channels'
one after the other, then the installation's.

A sensor multiplies what it senses: M(T, ω) acts on the rate along its own axis of sensitivity, ω_i + Σ m_ij ω_j with
the misalignments m. About an ideal sensor this is a sum of terms; estimates use `with_misalignments`.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, placed
from gradcal_jax.model.bases import Basis
from gradcal_jax.model.installation import InstallationTerm
from gradcal_jax.model.nodes import AXIS_NAMES, INPUTS, BodyNodes, NodeGroup
from gradcal_jax.model.noise import Processes
from gradcal_jax.model.terms import (
    Discrepancy,
    GradientOfBias,
    Map,
    OwnTerm,
    Term,
    block_diagonal,
)

ChannelKind = Literal["gyro", "accelerometer"]
KINDS: tuple[ChannelKind, ...] = ("gyro", "accelerometer")


class Channel(PytreeModule):
    """A gyro or an accelerometer along the body's axis `axis`: a sum of `terms` in the order of its parameters, white
    noise (`angle_random_walk`, rad/√s; of an accelerometer m/s/√s), and slow noise.

    A gyro is always read, an accelerometer at rest.
    """

    terms: tuple[Term, ...]
    angle_random_walk: Float[AnyArray, ""]
    processes: Processes
    kind: ChannelKind = eqx.field(static=True)
    axis: int = eqx.field(static=True)

    def __check_init__(self):
        if not any(isinstance(term, Map) for term in self.terms):
            raise ValueError("nothing to calibrate: give the model a bias map, a scale-factor map, or both")

    @property
    def name(self) -> str:
        return f"{self.kind}_{AXIS_NAMES[self.axis]}"

    @property
    def index(self) -> int:
        """Its index among three gyros and three accelerometers."""
        return self.axis + 3 * KINDS.index(self.kind)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return sum(term.size for term in self.terms)

    def where(self, name: str) -> slice:
        """Indices of a term's parameters among the channel's; an empty slice for a term that it does not have."""
        begin = 0
        for term in self.terms:
            if term.name == name:
                return slice(begin, begin + term.size)
            begin += term.size
        return slice(begin, begin)

    def term(self, name: str) -> Term | None:
        """The term of that name, if there is one."""
        return next((term for term in self.terms if term.name == name), None)

    def map(self, name: str) -> Map | None:
        """The map of that name, if the channel has it."""
        term = self.term(name)
        return term if isinstance(term, Map) else None

    def names(self) -> list[str]:
        """Names of the reported parameters in order, without the channel's."""
        return [name for term in self.terms for name in term.names()]


class EncoderNoise(PytreeModule):
    """Error of each of `L` encoders, rad.

    For a table that is `held` the error is drawn once for each standstill, with variance `offset² + reading²/n` for its
    n readings, `every` s apart from its beginning on. Otherwise the angle may change at rest and is read at the end of
    each segment; `offset` is then drawn for each standstill (`has_offset`: where it is not zero) and `reading` for each
    reading, to which one on the move adds its rate times `timing` s. Where a held rate is the reference of a segment,
    its error is `rate`, relative.
    """

    offset: Float[AnyArray, " L"]
    reading: Float[AnyArray, " L"]
    every: Float[AnyArray, " L"]
    held: bool = eqx.field(static=True, default=True)
    timing: float | Float[AnyArray, " L"] = 0.0
    rate: float | Float[AnyArray, ""] = 0.0
    has_offset: bool = eqx.field(static=True, default=True)


class ImuModel(PytreeModule):
    """A whole unit on its table: `channels`, `installation` terms, and the encoders' noise."""

    channels: tuple[Channel, ...]
    installation: tuple[InstallationTerm, ...]
    encoder: EncoderNoise

    def __check_init__(self):
        if not self.channels:
            raise ValueError("an IMU needs at least one gyro or accelerometer")

    @property
    def calibrated(self) -> int:
        """Number of the unit's own parameters, which precede those of its installation."""
        return sum(c.size for c in self.channels)

    @property
    def terms(self) -> list[Term]:
        """The terms of all channels, in the order of their parameters."""
        return [term for c in self.channels for term in c.terms]

    @property
    def discrepancy_stds(self) -> Float[np.ndarray, " p"]:
        """Prior standard deviation of each parameter that no calibration carries; zero for all others."""
        stds = [t.std if isinstance(t, Discrepancy) else 0.0 for t in self.terms]
        own = np.repeat(np.array(stds, dtype=float), [t.size for t in self.terms])
        return np.pad(own, (0, self.size - self.calibrated))

    @property
    def own_states(self) -> int:
        """Number of the noise states that are the unit's own: integrals and processes of its channels. Those of the
        encoders follow."""
        return sum(1 + c.processes.count for c in self.channels)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.calibrated + sum(term.size for term in self.installation)

    def located(self) -> Iterator[tuple[int, Channel, Term, slice]]:
        """Every term, with the number of its channel, the channel, and the indices of its parameters."""
        begin = 0
        for number, c in enumerate(self.channels):
            for term in c.terms:
                yield number, c, term, slice(begin, begin + term.size)
                begin += term.size

    def where(self, kind: ChannelKind, axis: int, name: str | None = None) -> slice:
        """Indices of the parameters of a channel, or of one of its terms; empty where there are none."""
        own = [(term.name, at) for _, c, term, at in self.located() if (c.kind, c.axis) == (kind, axis)]
        places = [at for of, at in own if name in (None, of)]
        return slice(places[0].start, places[-1].stop) if places else slice(0, 0)

    @property
    def knows_path(self) -> bool:
        """Whether any term depends on the path of temperature."""
        return any(isinstance(term, OwnTerm) and term.of_path for term in self.terms)

    def names(self) -> list[str]:
        """Names of the reported parameters in order: `gyro_x.b00`, `accelerometer_z.k2`, `azimuth`."""
        own = [f"{c.name}.{name}" for c in self.channels for name in c.names()]
        return own + [name for term in self.installation for name in term.names()]

    def units(self) -> list[str]:
        """SI units of the parameters."""
        shared = [term.unit for term in self.installation for _ in range(term.size)]
        return [term.unit for term in self.terms for _ in range(term.size)] + shared

    @property
    def to_reported(self) -> np.ndarray:
        """`(p, p)`: the engine's parameters to the reported ones."""
        blocks = [term.to_reported for term in self.terms]
        return block_diagonal([*blocks, np.eye(self.size - self.calibrated)])

    def misalignments(self) -> Iterator[tuple[int, Map, slice]]:
        """The terms by which a channel senses what acts across its axis: number of the channel, term, and the indices
        of its parameters."""
        for number, c, term, at in self.located():
            across = [(f"{INPUTS[c.kind]} {axis}",) for k, axis in enumerate(AXIS_NAMES) if k != c.axis]
            if isinstance(term, Map) and term.signals in across:
                yield number, term, at

    def with_misalignments(self, nodes: BodyNodes, parameters: Float[np.ndarray, " p"]) -> BodyNodes:
        """The nodes of an executed motion, of which each piece is a kind of its own, with what the sensors sense by
        their misalignments at the mean temperature of each piece."""
        if not (terms := list(self.misalignments())):
            return nodes
        groups, across_axes = list[NodeGroup](), np.zeros(np.shape(nodes.axes_before))
        for group in nodes.groups:
            across = np.zeros((*group.weight.shape, 2 * len(AXIS_NAMES)))
            for number, term, places in terms:
                functions = np.mean(term.temperature(group.temperature), axis=1)
                size, channel = (functions @ parameters[places])[:, None], self.channels[number]
                across[..., channel.index] += size * group.signal(term.signals[0])
                if channel.kind == "gyro":
                    other = AXIS_NAMES.index(term.signals[0][-1])
                    across_axes[group.kinds, :, channel.axis] += size * nodes.axes_before[group.kinds, :, other]
            groups.append(replace(group, across=across))
        return replace(nodes, groups=tuple(groups), across_axes=across_axes)

    def columns(self, nodes: BodyNodes) -> tuple[list[AnyArray], Float[AnyArray, "K 6 i"]]:
        """Contribution of each parameter's unit, rad or m/s: for each channel `(P, own)` over every piece (zero over
        moves if it is read at rest only), for the installation over a piece of each kind.
        """
        own = self.own_columns(nodes)
        xp = namespace(own, nodes.angle_before)
        none = xp.zeros((len(nodes.axis), 6, 0))
        return own, xp.concatenate([none, *(term.columns(nodes) for term in self.installation)], axis=-1)

    def own_columns(self, nodes: BodyNodes) -> list[AnyArray]:
        """The columns of each channel's own parameters over every piece, `(P, own)`."""
        views = [nodes.sensed_by(c.kind, c.axis) for c in self.channels]
        parts: list[tuple[Any, AnyArray]] = []
        for number, _, term, at in self.located():
            if not isinstance(term, Map):
                parts.append(((slice(None), at), term.columns(views[number])))
        # Terms of all channels with the same functions of temperature are integrated together.
        for k, group in enumerate(nodes.groups):
            alike: dict[Basis, list[tuple[np.ndarray, AnyArray]]] = {}
            for number, c, term, at in self.located():
                if isinstance(term, Map) and (c.kind == "gyro" or not group.moving):
                    places = np.arange(at.start, at.stop).reshape(term.temperature.size, -1)
                    drive = term.drive(views[number].groups[k])
                    alike.setdefault(term.temperature, []).append((places, drive))
            for basis, terms in alike.items():
                drive = namespace(group.weight).concatenate([d for _, d in terms], axis=-1)
                places = np.concatenate([at for at, _ in terms], axis=1).ravel()
                where: tuple = group.pieces[:, None], places
                if np.all(np.diff(places) == 1):  # (half the time)
                    where = group.pieces, slice(places[0], places[-1] + 1)
                parts.append((where, group.sums(basis(group.temperature), drive)))
        columns = placed((len(nodes.kind), self.calibrated), *parts)
        ends = np.cumsum([0, *(c.size for c in self.channels)])
        return [columns[:, a:b] for a, b in pairwise(ends)]

    def shifts(self, by: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k p p"] | None:
        """S with `columns at T + by = (columns at T) S` for each `by` (K); None unless all are polynomials of T."""
        result, every = np.tile(np.eye(self.size), (len(by), 1, 1)), np.arange(self.size)
        for _, c, term, at in self.located():
            if isinstance(term, Map):
                own, places = term.shifts(by), every[at]
                if own is None:
                    return None
                if term.beyond is not None:
                    places = np.append(places, every[self.where(c.kind, c.axis, term.beyond.name)])
                result[:, places[:, None], places] = own
            elif not isinstance(term, Discrepancy | GradientOfBias):
                return None
        return result

    def prior_rows(self) -> Float[AnyArray, "q p"]:
        """Whitened rows of the priors."""
        blocks = [term.prior_rows() for term in self.terms]
        return block_diagonal(blocks + [namespace(self).diag(1.0 / term.stds) for term in self.installation])
