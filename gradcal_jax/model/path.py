"""Hysteresis: a term that depends on past temperatures.

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

import equinox as eqx
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace, put
from gradcal_jax.formulas import running_clamps, then
from gradcal_jax.model.nodes import BodyNodes, NodeGroup
from gradcal_jax.model.terms import OwnTerm

FREE = 3.0


class Hysteresis(OwnTerm):
    """A play of half-width `width` K: the coefficient c (for each K), and the amplitude η of the initial state (in the
    unit of the error itself), with the priors `std` and `FREE·std·width`. See the head of the module."""

    width: Float[AnyArray, ""] = eqx.field(kw_only=True)

    @property
    def of_own_input(self) -> bool:
        return True

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

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        lowest, highest = self._before(nodes)

        def of_group(g: NodeGroup):
            xp, t = namespace(g.temperature), g.temperature
            within = running_clamps(t - self.width, t + self.width)
            low, high = then((lowest[g.pieces][:, None], highest[g.pieces][:, None]), within)
            behind, open_ = 0.5 * (low + high) - t, (high - low) / (2.0 * self.width)
            return g.sums(xp.stack([behind, open_], axis=-1), g.product(self.signals))

        return nodes.of_pieces(of_group, self.size)

    def values(self, nodes: NodeGroup):
        raise AssertionError("the functions of a play depend on all earlier temperatures")

    def in_service(self, sign: float, slope: float) -> float:
        return -sign * float(self.width)

    def _before(self, nodes: BodyNodes) -> tuple[Float[AnyArray, " P"], Float[AnyArray, " P"]]:
        """The extreme states (°C) before every piece."""
        start, history = nodes.temperature_before, nodes.history
        assert start is not None
        xp, w = namespace(start), self.width
        end = start + nodes.temperature_change
        low, high = xp.zeros(start.shape), xp.zeros(start.shape)
        for g in nodes.groups:
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
