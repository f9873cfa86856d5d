"""From rows of numbers to samples: units, the unit's own time by a counter or a time that it sends, and what that shows
to be lost.

A counter that wraps early shows losses modulo its modulus, and the log adds the rest by the host's clock; a time or a
long counter shows them all, and that the unit restarted. Without a stamp the rate of samples alone shows a loss. A
sample whose stamp is that of the one before came twice, and is left out.
"""

from collections.abc import Mapping
from functools import cache
from typing import Final, Literal

import numpy as np

from gradcal_jax import units
from gradcal_jax.hardware.roles import Flags, Floats, ImuBatch, Integers

_LONG = 1 << 16
SECONDS: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
# The quantities of a sample, with their units in this program: a tenth of a percent of g0 is a mg.
QUANTITIES: Final = {
    "gyro": ("deg/s", 1.0),
    "acceleration": ("mg", 1e-3),
    "temperature": ("degC", 1.0),
}
Stamped = Literal["count", "time", ""]


def converted(quantity: str, values: Floats, unit: str) -> Floats:
    """Values of a quantity, from a description's unit to deg/s, g0 or degC."""
    zero, step = _scale(quantity, unit)
    return values * step + zero


@cache
def _scale(quantity: str, unit: str) -> tuple[float, float]:
    wanted, factor = QUANTITIES[quantity]
    zero = units.convert(0.0, unit, wanted) * factor
    return zero, units.convert(1.0, unit, wanted) * factor - zero


class SampleDecoder:
    """The part of every decoder behind its codec.

    stamped  what stamps a sample: "count", "time", or "" for nothing
    rate_hz  samples per second
    tick_s   duration of one step of the stamp, s
    modulus  value at which the stamp restarts at 0; None: it never restarts
    """

    def __init__(self, stamped: Stamped, rate_hz: float, tick_s: float, modulus: int | None) -> None:
        self._stamped, self._modulus = stamped, modulus
        self.sample_s = 1.0 / rate_hz
        self.resolution_s = tick_s if stamped else self.sample_s
        self._step = self.sample_s / self.resolution_s
        self._short = stamped == "count" and modulus is not None and modulus < _LONG
        self.round_samples = round((modulus or 0) / self._step) if self._short else 0
        # The newest stamp, and the steps from the first one to it.
        self._newest: tuple[float, float] | None = None
        self.bad_bytes = 0
        self._disturbed = False

    def _noise(self, count: int) -> None:
        """So many bytes belong to no sample."""
        self.bad_bytes += count
        self._disturbed = self._disturbed or count > 0

    def _batch(
        self,
        host_time_s: float | Floats,
        stamps: Floats,
        values: Mapping[str, Floats],
        disturbed: Flags,
        status: Integers | int = 0,
        starts: Flags | bool = False,
    ) -> ImuBatch:
        """`stamps` `(n,)`; `values` `(n, 3)` by quantity, of what the unit sends; `disturbed`, `status` and `starts`
        `(n,)`: the last says where the unit itself reports a restart."""
        if not self._stamped:
            stamps = (0.0 if self._newest is None else self._newest[0]) + np.arange(1.0, 1.0 + len(stamps))
        newest, ticks = self._newest or (float(stamps[0]) - self._step, 0.0)
        steps = np.diff(stamps, prepend=newest)
        kept = steps != 0.0
        steps, count = steps[kept], int(np.count_nonzero(kept))
        restarted: Flags = steps < 0.0
        if self._modulus is not None:
            steps = np.mod(steps, float(self._modulus))
            restarted = np.zeros(count, np.bool_) if self._short else steps > 0.5 * self._modulus
        steps = np.where(restarted, self._step, steps)
        counts = ticks + np.cumsum(steps)
        if count:
            self._newest = float(stamps[-1]), float(counts[-1])
        absent = np.full((len(stamps), 3), np.nan)
        gyro, acceleration, temperature = (values.get(name, absent)[kept] for name in QUANTITIES)
        host, status, starts = (np.broadcast_to(of, len(stamps))[kept] for of in (host_time_s, status, starts))
        return ImuBatch(
            host,
            counts * self.resolution_s,
            gyro,
            acceleration,
            temperature,
            status,
            gap_before=np.maximum(np.rint(steps / self._step).astype(np.int64) - 1, 0),
            disturbed=disturbed[kept] & bool(self.round_samples),
            restarted=restarted | starts,
        )
