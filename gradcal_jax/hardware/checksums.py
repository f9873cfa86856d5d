"""The checksums of all supported protocols, as pure functions of bytes.

Drivers and simulated devices share this module only, so that both cannot have the same mistake in a codec.
"""

import binascii
import zlib
from functools import cache, reduce

import numpy as np
from numpy.typing import NDArray

_BIT_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def crc16_modbus(data: bytes) -> bytes:
    """Modbus RTU check: polynomial A001 reflected, start FFFF; two bytes, low byte first."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ 0xA001 * (register & 1)
    return register.to_bytes(2, "little")


def crc32_mpeg2(data: bytes) -> int:
    """CRC-32/MPEG-2 (polynomial 04C11DB7, start FFFFFFFF, no reflection, no final inversion) of STIM300 datagrams.

    It is the ordinary CRC-32 of the bit-reversed bytes, un-inverted and bit-reversed: the C loop of `zlib` is about
    fourteen times as fast as a table in Python.
    """
    ordinary = zlib.crc32(data.translate(_BIT_REVERSED)) ^ 0xFFFFFFFF
    return int.from_bytes(ordinary.to_bytes(4, "little").translate(_BIT_REVERSED), "big")


def crc32_mpeg2_of_rows(rows: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """`crc32_mpeg2` of every row, `(n, k) -> (n,)`.

    A CRC is affine over exclusive or: that of a message is that of as many zeros, changed by what each byte in its
    place changes alone. A block of datagrams is one look into a table of places and bytes.
    """
    table, of_zeros = _crc32_by_place(rows.shape[1])
    return np.bitwise_xor.reduce(table[np.arange(rows.shape[1]), rows], axis=1) ^ of_zeros


@cache
def _crc32_by_place(length: int) -> tuple[NDArray[np.uint32], np.uint32]:
    """`(length, 256)`: what a byte in a place changes of the CRC of zeros; and that CRC."""
    of_zeros = crc32_mpeg2(bytes(length))
    changes = [
        [crc32_mpeg2(bytes(place) + bytes([byte]) + bytes(length - place - 1)) ^ of_zeros for byte in range(256)]
        for place in range(length)
    ]
    return np.array(changes, np.uint32).reshape(length, 256), np.uint32(of_zeros)


def crc8_stim300(data: bytes) -> int:
    """CRC-8 of STIM300 Utility Mode: polynomial 07, start FF, over everything up to and including the last comma."""
    register = 0xFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register << 1 ^ 0x07 * (register >> 7)) & 0xFF
    return register


def crc16_vectornav(data: bytes) -> int:
    """CRC-16 of VectorNav binary packets (polynomial 1021, start 0); zero over a packet with its CRC, without the sync
    byte."""
    return binascii.crc_hqx(data, 0)


def xor8(data: bytes) -> int:
    return reduce(lambda left, right: left ^ right, data, 0)


def lrc_zaber(data: bytes) -> int:
    """Two's complement of the byte sum, low byte (Zaber ASCII, of the characters after the first)."""
    return -sum(data) & 0xFF
