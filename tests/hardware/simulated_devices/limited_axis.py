"""An axis with hard ends."""

from collections.abc import Sequence
from typing import Any

from gradcal_jax.hardware.simulate.plants import AxisPlant


class LimitedAxis(AxisPlant):
    """A spin that would leave the travel ends abruptly at its end."""

    def __init__(self, ends_deg: tuple[float, float], start_s: float = 0.0) -> None:
        super().__init__(start_s=start_s)
        self.ends_deg = ends_deg

    def _replace(self, now_s: float, phases: Sequence[Any]) -> None:
        last = phases[-1]
        end_deg = self.ends_deg[last.rate_dps > 0.0]
        if last.rate_dps:
            at_s = last.start_s + max(0.0, (end_deg - last.position_deg) / last.rate_dps)
            phases = [*phases, type(last)(at_s, end_deg, 0.0, 0.0)]
        super()._replace(now_s, list(phases))
