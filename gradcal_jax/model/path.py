"""Terms that depend on the path of temperature and not on its present value alone, each linear in its parameters.

The play operator of half-width w (Krasnosel'skii and Pokrovskii, Systems with Hysteresis, 1989; Prandtl–Ishlinskii
models are sums of them) follows the temperature T with a slack of ±w:

    P(t) = max(T − w, min(T + w, P(t⁻))),        h(t) = P − T,    −w ≤ h ≤ w

On a long heating leg h = −w, on a long cooling leg h = w, and a reversal moves it from one to the other over 2w. For a
known course of temperature h is a known function of time, so a bias `c·h` is linear in c, rad/s/K. Between its two
extreme initial states, P(0) = T(0) ± w, the operator has the values lo ≤ P ≤ hi, which a traverse of 2w makes equal.
The term is

    c·[(hi + lo)/2 − T] + η·(hi − lo)/(2w)

exact for both extreme initial states (η = ±c·w), and linear between them. On a heating course the first function is
−w + w·(hi − lo)/(2w), so the first 2w of a one-way ramp observe the sum c·w + η alone. The prior of η is `FREE` times
that of c·w, wider than its range: what such a beginning says of c rests on the law of the play, and is given up.

`max(T − w, min(T + w, ·))` is a clamp. Clamps compose to clamps, so the states along a course are a running composition
(`running_clamps`), exact at reversals: nothing is smoothed, and nothing is rounded.
"""

from abc import abstractmethod

import equinox as eqx
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.formulas import running_clamps, then
from gradcal_jax.model.nodes import Nodes, OtherTemperature, SharedNodes
from gradcal_jax.model.terms import Term

FREE = 3.0
# dT/dt of a temperature that neither heats nor cools, K/s.
_STEADY = 0.1 / 60.0


class PathTerm(Term):
    """A function of the path of temperature, times a product of signals (`SignalMap`), with a prior of its parameter.

    `std`: of the first parameter.
    """

    std: eqx.AbstractVar[Float[AnyArray, ""]]
    signals: eqx.AbstractVar[tuple[str, ...]]
    si_unit: eqx.AbstractVar[str]

    @property
    def unit(self) -> str:
        return self.si_unit

    @abstractmethod
    def functions(self, nodes: Nodes) -> list[Float[AnyArray, "k m size"]]:
        """The functions of the path at the points of every group."""

    @property
    def nuisances(self) -> list[str]:
        """Names of parameters that describe the recording and not the sensor."""
        return []

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        return namespace(self.std).eye(self.size) / self.std

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        of_group = {id(g): values for g, values in zip(nodes.groups, self.functions(nodes), strict=True)}
        return nodes.integrals(lambda g: g.sums(of_group[id(g)], g.product(self.signals)), self.size)


def _shared(nodes: Nodes) -> list[SharedNodes]:
    """The groups of a body's nodes; only these know the path."""
    groups = [g for g in nodes.groups if isinstance(g, SharedNodes)]
    assert len(groups) == len(nodes.groups), (
        "terms that depend on past temperatures can only be used in the model of an IMU"
    )
    return groups


class Hysteresis(PathTerm):
    """A play of half-width `width` K: the coefficient c (for each K), and the amplitude η of the initial state (in the
    unit of the error itself), with the priors `std` and `FREE·std·width`. See the head of the module."""

    std: Float[AnyArray, ""]
    width: Float[AnyArray, ""]
    signals: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    si_unit: str = eqx.field(static=True)

    @property
    def size(self) -> int:
        return 2

    def names(self) -> list[str]:
        return [self.name, *self.nuisances]

    @property
    def nuisances(self) -> list[str]:
        return [f"{self.name}_start"]

    def prior_rows(self) -> Float[AnyArray, "size size"]:
        xp = namespace(self.std, self.width)
        return xp.diag(1.0 / xp.stack([self.std, FREE * self.std * self.width]))

    def functions(self, nodes: Nodes) -> list[Float[AnyArray, "k m size"]]:
        groups, (lowest, highest), result = _shared(nodes), self._before(nodes), []
        for g in groups:
            xp, t = namespace(g.temperature), g.temperature
            within = running_clamps(t - self.width, t + self.width)
            low, high = then((lowest[g.pieces][:, None], highest[g.pieces][:, None]), within)
            behind, open_ = 0.5 * (low + high) - t, (high - low) / (2.0 * self.width)
            result.append(xp.stack([behind, open_], axis=-1))
        return result

    def _before(self, nodes: Nodes) -> tuple[Float[AnyArray, " P"], Float[AnyArray, " P"]]:
        """The extreme states (°C) before every piece."""
        start, history = nodes.temperature_before, nodes.history
        assert start is not None
        xp, w = namespace(start), self.width
        end = start + nodes.temperature_change
        low, high = xp.zeros(start.shape), xp.zeros(start.shape)
        for g in _shared(nodes):
            # A piece as a whole: its points in order, then its end.
            a, b = running_clamps(g.temperature - w, g.temperature + w)
            last = end[g.pieces]
            a, b = then((a[:, -1], b[:, -1]), (last - w, last + w))
            low, high = put(low, g.pieces, a), put(high, g.pieces, b)
        earlier = start[:1] if history is None else xp.concatenate([history, start[:1]])
        low, high = xp.concatenate([earlier - w, low]), xp.concatenate([earlier + w, high])
        low, high = running_clamps(low, high)
        first = earlier.shape[0] - 1
        return low[first:-1], high[first:-1]


class TemperatureDifference(PathTerm):
    """What an `other` temperature, of the second thermometer, is less that of the maps."""

    std: Float[AnyArray, ""]
    other: OtherTemperature = eqx.field(static=True)
    signals: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    si_unit: str = eqx.field(static=True)

    def functions(self, nodes: Nodes) -> list[Float[AnyArray, "k m 1"]]:
        return [(g.temperature_at(self.other) - g.temperature)[..., None] for g in _shared(nodes)]


class GradientOfScale(PathTerm):
    """Sensitivity of the scale factor to dT/dt, a ratio for K/s."""

    std: Float[AnyArray, ""]
    signals: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    si_unit: str = eqx.field(static=True, default="s/K")

    def functions(self, nodes: Nodes) -> list[Float[AnyArray, "k m 1"]]:
        return [g.slope[..., None] for g in _shared(nodes) if g.slope is not None]
