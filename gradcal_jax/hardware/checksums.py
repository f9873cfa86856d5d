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
    """

    def __init__(
        self, width: int, poly: int, init: int, xorout: int = 0, *, reflect: bool = False, zeros: int = 0
    ) -> None:
        if reflect:
            poly, init = (int(f"{value:0{width}b}"[::-1], 2) for value in (poly, init))
        self._init, self._xorout, self._reflect, self._zeros = init, np.int64(xorout), reflect, zeros
        self._mask, self._top = np.int64(2**width - 1), np.int64(width - 8)
        one, high = np.int64(1), np.int64(1 if reflect else 2 ** (width - 1))
        register = np.arange(256, dtype=np.int64)
        if not reflect:
            register <<= self._top
        for _ in range(8):
            carry = (register & high) != 0
            register = register >> one if reflect else register << one & self._mask
            register = np.where(carry, register ^ np.int64(poly), register)
        # The register after one byte, from zero.
        self._after = register

    def __call__(self, rows: NDArray[np.uint8]) -> NDArray[np.int64]:
        """`(n, length) -> (n,)`."""
        register = np.full(len(rows), self._init, np.int64)
        eight = np.int64(8)
        for column in (*rows.T.astype(np.int64), *np.zeros((self._zeros, 1), np.int64)):
            if self._reflect:
                register = register >> eight ^ self._after[(register & np.int64(255)) ^ column]
            else:
                register = (register << eight & self._mask) ^ self._after[register >> self._top ^ column]
        return register ^ self._xorout


_MODBUS = CrcOfRows(16, 0x8005, 0xFFFF, reflect=True)


def crc16_modbus(data: bytes) -> bytes:
    """Modbus RTU check; two bytes, low byte first."""
    return int(_MODBUS(np.frombuffer(data, np.uint8)[None])[0]).to_bytes(2, "little")


def xor8(data: bytes) -> int:
    return reduce(lambda left, right: left ^ right, data, 0)
