"""The information of a cycle that a plan repeats on one ramp, from three of its cycles.

The noise of every cycle is the same, and only the temperature of its columns differs: a polynomial at a shifted
temperature is a polynomial, so that the columns of a cycle are those of another times a small matrix S. The first
cycle, one within and the last one are filtered reading by reading from any state of the noise (`whitening.passage`).
These passages then follow one another as often as there are cycles (`through`), a few small products each: exactly the
information of all readings.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, fixed
from gradcal_jax.information.noise_steps import NoiseSteps
from gradcal_jax.information.whitening import Passage, passage
from gradcal_jax.model.build import BuiltImu
from gradcal_jax.spec.schedule import PlanSchedule

# Cycles that are filtered reading by reading: the first, one within, the last.
FILTERED = 3
# Cycles from which on this saves time.
_MANY = 6


class RepeatedCycle(NamedTuple):
    """`cycles` that begin at `begins` °C on a ramp of `slope` K/s, `period` s after one another."""

    cycles: int
    begins: float
    slope: float
    period: float

    def gram(self, built: BuiltImu, steps: NoiseSteps, columns: Float[AnyArray, "N p"]) -> Float[AnyArray, "p p"]:
        """The Gram matrix of all cycles, by the steps and columns of the filtered ones."""
        # Of those within, one is filtered where the second one is, and the last one where the third one is.
        filtered = np.minimum(np.arange(self.cycles), 1)
        filtered[-1] = FILTERED - 1
        shifts = built.model.shifts(self.slope * self.period * (np.arange(self.cycles) - filtered))
        assert shifts is not None
        # (All in one program: a third of the time to compile.)
        passages = jax.vmap(partial(_of_cycle, steps))(*_by_cycle(steps[:5]), *_by_cycle([columns]))
        nothing = jnp.zeros((columns.shape[1], columns.shape[1])), jnp.zeros((len(steps.initial), columns.shape[1]))
        begin = Passage(*nothing, jnp.asarray(steps.initial))

        def go_on(known, now):
            return through(known, jax.tree.map(lambda x: x[now[0]], passages), now[1]), None

        return jax.lax.scan(go_on, begin, (filtered, jnp.asarray(shifts)))[0].product


def repeated_cycle(
    schedule: PlanSchedule, builts: Sequence[BuiltImu], cycles: int, period: float
) -> RepeatedCycle | None:
    """The cycle of `period` s that is all of a plan, in so many `cycles`; None where these differ in more than a
    polynomial of temperature."""
    ramps = [s for s in schedule.segments if s.used]
    lags = any(b.spec.sensor.lag is not None or b.gears or b.model.shifts(np.zeros(1)) is None for b in builts)
    if len(schedule.stretches) > 1 or len(ramps) > 1 or cycles < _MANY or lags:
        return None
    return RepeatedCycle(cycles, ramps[0].temperature_start, ramps[0].slope, period)


def through(known: Passage, after: Passage, shift: Float[AnyArray, "p p"]) -> Passage:
    """What is known after a passage from any state of the noise, with columns times `shift`."""
    p, state, covariance = len(shift), known.after, known.left
    own, both, of_state = after.product[:p, :p], after.product[:p, p:], after.product[p:, p:]
    missing = both.T @ shift - of_state @ state
    # The covariance of the state before, given the readings after: (I + P J)⁻¹ P.
    size = fixed(jnp.sqrt(jnp.diagonal(covariance)))
    size = jnp.where(size > 0.0, size, 1.0)
    sizes = size[:, None] * size[None, :]
    scaled = covariance / sizes
    smoothed = jnp.linalg.solve(jnp.eye(len(size)) + scaled @ (of_state * sizes), scaled) * sizes
    cross = shift.T @ both @ state
    seen = shift.T @ own @ shift - cross - cross.T + state.T @ of_state @ state - missing.T @ smoothed @ missing
    begin, onward = state + smoothed @ missing, -after.after[:, p:]
    return Passage(
        known.product + 0.5 * (seen + seen.T),
        after.after[:, :p] @ shift + onward @ begin,
        onward @ (0.5 * (smoothed + smoothed.T)) @ onward.T + after.left,
    )


def _by_cycle(of_steps: Sequence[AnyArray]) -> list[AnyArray]:
    return [jnp.reshape(x, (FILTERED, -1, *x.shape[1:])) for x in of_steps]


def _of_cycle(
    like: NoiseSteps,
    transition: AnyArray,
    covariance: AnyArray,
    observation: AnyArray,
    variance: AnyArray,
    used: AnyArray,
    columns: AnyArray,
) -> Passage:
    """The passage of a cycle, whose readings follow one another as the first of those of `like` do."""
    stays = None if like.stays is None else like.stays[: len(columns)]
    steps = NoiseSteps(transition, covariance, observation, variance, used, like.initial, stays)
    return passage(steps, columns)
