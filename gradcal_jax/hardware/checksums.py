"""The checksums of all supported protocols, as pure functions of bytes.

Drivers and simulated devices share this module only, so that both cannot have the same mistake in a codec.
"""

from functools import reduce

import numpy as np
from numpy.typing import NDArray


def crc16_modbus(data: bytes) -> bytes:
    """Modbus RTU check: polynomial A001 reflected, start FFFF; two bytes, low byte first."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ 0xA001 * (register & 1)
    return register.to_bytes(2, "little")


class CrcOfRows:
    """A CRC by its parameters, of every row of `length` bytes and of `zeros` zero bytes that are not sent.

    A CRC is affine over exclusive or: that of a message is that of as many zeros, changed by what each byte in its
    place changes alone. A block of frames is one look into a table of places and bytes.

    poly     polynomial without its highest power, not reflected
    init     value before the first byte
    xorout   value by which the result is changed
    reflect  whether bytes and result are reflected
    """

    def __init__(
        self, length: int, width: int, poly: int, init: int, xorout: int, *, reflect: bool = False, zeros: int = 0
    ) -> None:
        self._width, self._reflect = np.uint64(width), reflect
        self._mask = np.uint64(2**width - 1)
        if reflect:
            poly, init = (int(f"{value:0{width}b}"[::-1], 2) for value in (poly, init))
        self._of_byte = self._table(poly)
        change = self._of_byte
        for _ in range(zeros):
            change = self._advanced(change)
        self._by_place = np.empty((length, 256), np.uint64)
        for place in reversed(range(length)):
            self._by_place[place] = change
            change = self._advanced(change)
        start = np.array([init], np.uint64)
        for _ in range(length + zeros):
            start = self._advanced(start)
        self._constant = start[0] ^ np.uint64(xorout)

    def __call__(self, rows: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """`(n, length) -> (n,)`."""
        register = np.full(len(rows), self._constant)
        for place, changes in enumerate(self._by_place):
            register ^= changes[rows[:, place]]
        return register

    def _table(self, poly: int) -> NDArray[np.uint64]:
        """`(256,)`: the register after one byte, from zero."""
        high = np.uint64(1) if self._reflect else np.uint64(1) << self._width - np.uint64(1)
        register = np.arange(256, dtype=np.uint64)
        if not self._reflect:
            register = register << self._width - np.uint64(8)
        for _ in range(8):
            carry = (register & high) != 0
            shifted = register >> np.uint64(1) if self._reflect else register << np.uint64(1) & self._mask
            register = np.where(carry, shifted ^ np.uint64(poly), shifted)
        return register

    def _advanced(self, register: NDArray[np.uint64]) -> NDArray[np.uint64]:
        """The register after a zero byte."""
        if self._reflect:
            return register >> np.uint64(8) ^ self._of_byte[(register & np.uint64(255)).astype(np.int64)]
        top = (register >> self._width - np.uint64(8)).astype(np.int64)
        return (register << np.uint64(8) & self._mask) ^ self._of_byte[top]


def xor8(data: bytes) -> int:
    return reduce(lambda left, right: left ^ right, data, 0)
