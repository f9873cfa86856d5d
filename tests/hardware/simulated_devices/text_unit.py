"""A board that prints `$IMU,gx,gy,gz,ax,ay,az,T,us*HH`: what a hundred sketches for a microcontroller do."""

from dataclasses import dataclass

from gradcal_jax.hardware.clock import Clock
from gradcal_jax.hardware.simulate.imu import SampledSensor


@dataclass
class TextUnitOptions:
    every: int = 10
    """Samples that it prints at once."""
    boot_s: float = 0.0
    banner: bytes = b"MPU-6050 ready\r\n"


class SimulatedTextUnit:
    def __init__(self, sensor: SampledSensor, clock: Clock, options: TextUnitOptions | None = None) -> None:
        self.sensor, self.options, self._clock = sensor, options or TextUnitOptions(), clock
        self.reboot()

    def reboot(self) -> None:
        self._speaks_s = self._clock.now() + self.options.boot_s
        self._banner = self.options.banner
        self.sensor.restart(self._speaks_s, round(1.0 / self.sensor.true_period_s))

    def receive(self, data: bytes) -> list[bytes]:
        del data
        return []

    def next_emission_s(self) -> float | None:
        return self.sensor.next_time_s(self.options.every)

    def emit(self, now_s: float) -> list[bytes]:
        count = self.sensor.due(now_s)
        first, samples = self.sensor.taken, self.sensor.take(count)
        lines, self._banner = [self._banner] if self._banner else [], b""
        for k in range(count):
            rate, force = samples.rate_dps[k], 9.80665 * samples.acceleration_g[k]
            stamp = round((first + k + 1) * 1e6 * round(self.sensor.true_period_s, 4)) % 2**32
            numbers = [*(f"{value:.4f}" for value in (*rate, *force)), f"{samples.temperature_c[k]:.2f}", str(stamp)]
            text = ",".join(["IMU", *numbers])
            check = 0
            for letter in text.encode():
                check ^= letter
            lines.append(f"${text}*{check:02X}\r\n".encode())
        return lines
