"""The datagrams of a simulated STIM300 in Normal Mode with rates, forces and temperatures, byte for byte, from the data
sheet."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ..checksums import crc32_mpeg2_of_rows
from .sensor import SensorSamples

RATES_HZ: Final = (125.0, 250.0, 500.0, 1000.0, 2000.0)
# Identifier of rates, forces and temperatures, and the bytes that its CRC includes and the line does not.
_IDENTIFIER: Final = 0xA5
_UNSENT: Final = 2
_LATENCY_US: Final = 506


def datagrams(samples: SensorSamples, first: int, rate_hz: float) -> NDArray[np.uint8]:
    """A row for each sample, of which `first` is the number since the unit began; of a range of 10 g."""
    count = samples.time_s.shape[0]
    none = np.zeros((count, 1), np.uint8)
    gyro = samples.rate_dps * 2.0**14
    second = samples.temperature_c if samples.second_c is None else samples.second_c
    gyros, forces = (_int16(of) for of in (samples.temperature_c, second))
    number: NDArray[np.int64] = first + np.arange(count, dtype=np.int64)
    counter = ((number + 1) * round(2000.0 / rate_hz) % 256).astype(np.uint8)[:, None]
    latency = np.tile(np.frombuffer(_LATENCY_US.to_bytes(2, "big"), np.uint8), (count, 1))
    parts = [
        none + np.uint8(_IDENTIFIER),
        _int24(gyro),
        _overload(gyro),
        _int24(samples.acceleration_g * 2.0**19),
        none,
    ]
    bodies = np.concatenate([*parts, gyros, none, forces, none, counter, latency], axis=1)
    crc = crc32_mpeg2_of_rows(np.hstack([bodies, np.zeros((count, _UNSENT), np.uint8)]))
    return np.hstack([bodies, crc.astype(">u4")[:, None].view(np.uint8)])


def _int16(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(n,) temperatures -> (n, 6) bytes of three channels of them."""
    raw = np.clip(np.rint(values * 256.0), -32768, 32767).astype(">i2")
    return np.ascontiguousarray(np.repeat(raw[:, None], 3, axis=1)).view(np.uint8).reshape(-1, 6)


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
