"""A board that prints `$IMU,gx,gy,gz,ax,ay,az,T,us*HH`: what a hundred sketches for a microcontroller do."""

import operator
from functools import reduce


class SimulatedTextUnit:
    """Silent for `boot_s` (s) from power on; then a greeting, and ten samples at once."""

    def __init__(self, sensor, clock, boot_s=0.0):
        self.sensor, self._clock, self._boot_s = sensor, clock, boot_s
        self.reboot()

    def reboot(self):
        self._speaks_s = self._clock.now() + self._boot_s
        self._banner = b"MPU-6050 ready\r\n"
        self.sensor.restart(self._speaks_s, round(1.0 / self.sensor.true_period_s))

    def receive(self, data):
        del data
        return []

    def next_emission_s(self):
        return self.sensor.next_time_s(10)

    def emit(self, now_s):
        count = self.sensor.due(now_s)
        first, samples = self.sensor.taken, self.sensor.take(count)
        lines, self._banner = [self._banner] if self._banner else [], b""
        for k in range(count):
            rate, force = samples.rate_dps[k], 9.80665 * samples.acceleration_g[k]
            stamp = round((first + k + 1) * 1e6 * round(self.sensor.true_period_s, 4)) % 2**32
            numbers = [*(f"{value:.4f}" for value in (*rate, *force)), f"{samples.temperature_c[k]:.2f}", str(stamp)]
            text = ",".join(["IMU", *numbers])
            check = reduce(operator.xor, text.encode())
            lines.append(f"${text}*{check:02X}\r\n".encode())
        return lines
