"""The best residual for each duration, and the shortest plan for each residual."""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np

from gradcal_jax.api.optimise import optimise
from gradcal_jax.api.search_results import Optimised, SearchStep
from gradcal_jax.display import summary
from gradcal_jax.files.spec_sections import Spec

_BLIND: Final = "no plan found for this duration observes all requirements: try more moves in each visit"


class FrontierPoint(NamedTuple):
    """A ramp of `motion` s, without soaks, with its best plan, or the `reason` why there is none."""

    motion: float
    plan: Optimised | None
    reason: str

    __repr__ = summary


def frontier(
    spec: Spec,
    times: list[float],
    *,
    steps: int | None = None,
    watch: Callable[[float, SearchStep], None] = lambda _, __: None,
) -> Iterator[FrontierPoint]:
    """Optimise for each of `times` (s, without soaks); `watch` is called at every step. Errors: as `optimise`."""
    for time in times:
        try:
            for event in optimise(spec, steps=steps, motion=time):
                if isinstance(event, Optimised):
                    yield (
                        FrontierPoint(time, event, event.sentence)
                        if np.isfinite(event.now)
                        else FrontierPoint(time, None, _BLIND)
                    )
                else:
                    watch(time, event)
        except ValueError as error:
            if len(times) == 1:
                raise
            yield FrontierPoint(time, None, str(error))


def shortest(points: list[FrontierPoint], target: float) -> float | None:
    """The motion time (s) at which the frontier crosses `target`, between its points; None where it does not.

    Between points the logarithm of the residual is taken as linear in that of the time.
    """
    known = sorted((p.motion, p.plan.now) for p in points if p.plan is not None and np.isfinite(p.plan.now))
    # A longer plan can do what a shorter one does and then wait, so the frontier never rises.
    best = np.minimum.accumulate([value for _, value in known]) if known else np.array([])
    for k in range(len(known)):
        if best[k] <= target:
            if k == 0 or best[k] == best[k - 1]:
                return known[k][0]
            (early, late), (high, low) = np.log([known[k - 1][0], known[k][0]]), np.log([best[k - 1], best[k]])
            return float(np.exp(early + (late - early) * (high - np.log(target)) / (high - low)))
    return None
