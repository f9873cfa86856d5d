"""A simulated unit that sends the frames of the description "stim300", and takes no commands."""

import numpy as np

from gradcal_jax.hardware.checksums import CrcOfRows
from gradcal_jax.hardware.simulate.lab import datagrams


class SimulatedFrames:
    """One unit; `sensor` gives its samples, at `rate_hz`. `burst_s` is the time between bursts of bytes to the host. In
    its first second a bit of its status is set."""

    _CRC = CrcOfRows(32, 0x04C11DB7, 0xFFFFFFFF, 0, zeros=2)

    def __init__(self, sensor, clock, *, rate_hz=125.0, burst_s=0.016):
        self.sensor, self.rate_hz, self.burst_s = sensor, rate_hz, burst_s
        self._clock = clock
        self.reboot()

    def reboot(self):
        """Power on: the counter begins anew."""
        self._booted_s = self._clock.now()
        self.sensor.restart(self._clock.now(), self.rate_hz)

    def receive(self, data):
        return []

    def next_emission_s(self):
        ahead = max(1, round(self.burst_s / self.sensor.true_period_s))
        return self.sensor.next_time_s(ahead)

    def emit(self, now_s):
        count = self.sensor.due(now_s)
        if not count:
            return []
        first = self.sensor.taken
        samples = self.sensor.take(count)
        rows = datagrams(samples, first, self.rate_hz)
        rows[samples.time_s - self._booted_s < 1.0, 10] |= 0x40
        rows[:, 38:] = self._CRC(rows[:, :38]).astype(">u4")[:, None].view(np.uint8)
        return [row.tobytes() for row in rows]
