"""The checksums of all supported protocols, as pure functions of bytes.

Drivers and simulated devices share this module only, so that both cannot have the same mistake in a codec.
"""

from functools import reduce

import numpy as np
from numpy.typing import NDArray


class CrcOfRows:
    """A CRC by its parameters, of every row of bytes and of `zeros` zero bytes that are not sent.

    poly     polynomial without its highest power, not reflected
    init     value before the first byte
    xorout   value by which the result is changed
    reflect  whether bytes and result are reflected

    A CRC is linear: it is the exclusive or of what each byte at its place contributes, and of what `init` does.
    """

    def __init__(
        self, width: int, poly: int, init: int, xorout: int = 0, *, reflect: bool = False, zeros: int = 0
    ) -> None:
        if reflect:
            poly, init = (int(f"{value:0{width}b}"[::-1], 2) for value in (poly, init))
        self._xorout, self._reflect, self._mask, self._top = xorout, reflect, 2**width - 1, width - 8
        high = 1 if reflect else 2 ** (width - 1)
        register = np.arange(256) << (0 if reflect else self._top)
        for _ in range(8):
            carry = (register & high) != 0
            register = register >> 1 if reflect else register << 1 & self._mask
            register = np.where(carry, register ^ poly, register)
        # The register after one byte, from zero.
        self._after = register
        self._init, self._zeros = np.array(init), zeros
        # By the length of rows: what each byte contributes `(length · 256,)`, and what `init` does.
        self._parts: dict[int, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}

    def __call__(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """`(n, length) -> (n,)`."""
        length = rows.shape[1]
        if length not in self._parts:
            begun, parts = self._shifted(self._init), [self._after]
            while len(parts) < length + self._zeros:
                begun, parts = self._shifted(begun), [self._shifted(parts[0]), *parts]
            self._parts[length] = np.concatenate(parts[:length]), begun ^ self._xorout
        parts, begun = self._parts[length]
        places: NDArray[np.int64] = rows.T + 256 * np.arange(length, dtype=np.int64)[:, None]
        return np.bitwise_xor.reduce(parts.take(places), axis=0) ^ begun

    def _shifted(self, register: NDArray[np.int64]) -> NDArray[np.int64]:
        """The register after a zero byte."""
        if self._reflect:
            return register >> 8 ^ self._after[register & 255]
        return (register << 8 & self._mask) ^ self._after[register >> self._top]


_MODBUS = CrcOfRows(16, 0x8005, 0xFFFF, reflect=True)


def crc16_modbus(data: bytes) -> bytes:
    """Modbus RTU check; two bytes, low byte first."""
    return int(_MODBUS(np.frombuffer(data, np.uint8)[None])[0]).to_bytes(2, "little")


def xor8(data: bytes) -> int:
    return reduce(lambda left, right: left ^ right, data, 0)
