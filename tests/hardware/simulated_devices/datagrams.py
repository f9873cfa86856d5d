"""All datagrams of a STIM300 in Normal Mode, byte for byte, from the data sheet."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.hardware.checksums import crc32_mpeg2_of_rows
from gradcal_jax.hardware.simulate.imu import SensorSamples

# Identifier, and number of bytes that the CRC includes and the line does not, by the code of `$sd`, which also gives
# the contents.
_KINDS: Final = {
    0: (0x90, 2, ""),
    1: (0x91, 0, "a"),
    2: (0x92, 0, "i"),
    3: (0x93, 2, "ai"),
    4: (0x94, 3, "t"),
    5: (0xA5, 2, "at"),
    6: (0xA6, 2, "it"),
    7: (0xA7, 1, "ait"),
}


def datagrams(
    samples: SensorSamples,
    first: int,
    starting: NDArray[np.bool_],
    *,
    rate_hz: float,
    kind: int = 5,
    range_g: int = 10,
    rate_increments: bool = False,
    force_increments: bool = False,
    latency_us: int = 506,
) -> NDArray[np.uint8]:
    """A row for each sample, of which `first` is the number since the unit began and `starting` the start-up bit."""
    identifier, unsent, contents = _KINDS[kind]
    count = samples.time_s.shape[0]
    status = np.where(starting, 0x40, 0).astype(np.uint8)[:, None]
    gyro = samples.rate_dps / (rate_hz if rate_increments else 1.0) * 2.0 ** (21 if rate_increments else 14)
    parts = [np.full((count, 1), identifier, np.uint8), _int24(gyro), status | _overload(gyro)]
    force, scale = samples.acceleration_g, 2.0 ** {5: 20, 10: 19, 30: 18, 80: 16}[range_g]
    if force_increments:
        scale = 2.0 ** {5: 23, 10: 22, 30: 21, 80: 19}[range_g]
        force = force * 9.80665 / rate_hz
    if "a" in contents:
        parts += [_int24(force * scale), status]
    if "i" in contents:
        parts += [_int24(samples.acceleration_g * 2.0**22), status]
    if "t" in contents:
        raw = np.clip(np.rint(samples.temperature_c * 256.0), -32768, 32767).astype(">i2")
        sensors = np.ascontiguousarray(np.repeat(raw[:, None], 3, axis=1)).view(np.uint8).reshape(count, 6)
        parts += [part for _ in contents for part in (sensors, status)]
    number: NDArray[np.int64] = first + np.arange(count, dtype=np.int64)
    counter = ((number + 1) * round(2000.0 / rate_hz) % 256).astype(np.uint8)[:, None]
    latency = np.frombuffer(latency_us.to_bytes(2, "big"), np.uint8)
    parts += [counter, np.tile(latency, (count, 1))]
    bodies = np.concatenate(parts, axis=1)
    crc = crc32_mpeg2_of_rows(np.hstack([bodies, np.zeros((count, unsent), np.uint8)]))
    return np.hstack([bodies, crc.astype(">u4")[:, None].view(np.uint8)])


def _int24(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(n, 3) numbers -> (n, 9) big-endian bytes of the nearest 24-bit integers, clipped to the range."""
    # A sensor that the unit lacks has no number: zero.
    whole = np.clip(np.rint(np.nan_to_num(values)), -(2**23), 2**23 - 1).astype(">i4")
    return np.ascontiguousarray(whole).view(np.uint8).reshape(-1, 3, 4)[:, :, 1:].reshape(-1, 9)


def _overload(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Status bit 4 and the channel's bit where a value is beyond the 24 bits."""
    beyond = np.abs(values) >= 2**23 - 1
    bits = (beyond * np.array([1, 2, 4])).sum(axis=1)
    return np.where(bits, 0x10 | bits, 0).astype(np.uint8)[:, None]
