"""Numeric arrays of MATLAB v5 files (`save` with -v6 or -v7), read with every length checked.

Source: MathWorks, "MAT-File Format", level 5. SciPy's reader is not used, because it ends the process on some damaged
files, and a lab computer's files are sometimes damaged.

    file     128 bytes of header: text, version, "IM" or "MI" for the byte order; then elements
    element  8 bytes of tag: type, length; data padded to 8 bytes, except in compressed elements, which follow closely
             (or 4 bytes of tag with up to 4 bytes of data)
    matrix   an element made of elements: flags and class, dimensions, name, real part, imaginary part
"""

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Order = Literal["<", ">"]
_NUMBERS: Final[Mapping[int, str]] = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
"""Types of elements that hold numbers, with NumPy's names."""
_MATRIX: Final = 14
_COMPRESSED: Final = 15
_CLASSES: Final[Mapping[int, str]] = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
"""Classes of matrices that hold numbers; characters, cells, structures, objects and sparse matrices are ignored."""
_COMPLEX: Final = 0x08


def read_matlab(path: Path) -> dict[str, NDArray[Any]]:
    """Every real numeric array of a file by name; those with one row or column as vectors.

    **Raises:** `ValueError` with the place, for violations of the format.
    """
    content = path.read_bytes()
    if len(content) < 128 or content[126:128] not in (b"IM", b"MI"):
        raise ValueError("there is no header of a MATLAB v5 file")
    order: Order = "<" if content[126:128] == b"IM" else ">"
    arrays: dict[str, NDArray[Any]] = {}
    for kind, data in _elements(memoryview(content)[128:], order):
        if kind == _COMPRESSED:
            try:
                data = memoryview(zlib.decompress(data))
            except zlib.error as error:
                raise ValueError(f"a compressed element is damaged: {error}") from None
            inside = next(_elements(data, order), None)
            if inside is None:
                continue
            kind, data = inside
        if kind == _MATRIX:
            name, array = _matrix(data, order)
            if array is not None:
                arrays[name] = array
    return arrays


def _elements(data: memoryview, order: Order) -> Iterator[tuple[int, memoryview]]:
    """(type, data) of the elements in a stretch of bytes."""
    at = 0
    while len(data) - at >= 8:
        kind, length = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:  # a small element: length and type share four bytes, the data are the next four
            kind, length, start = kind & 0xFFFF, kind >> 16, at + 4
            if length > 4:
                raise ValueError(f"a small element at byte {at} is {length} bytes long")
            following = at + 8
        else:
            start = at + 8
            following = start + length if kind == _COMPRESSED else start + -(-length // 8) * 8
        if start + length > len(data):
            raise ValueError(f"an element at byte {at} is longer than the file")
        yield kind, data[start : start + length]
        at = following


def _matrix(data: memoryview, order: Order) -> tuple[str, NDArray[Any] | None]:
    """Name and array of a matrix; `None` unless it is an array of real numbers."""
    parts = _elements(data, order)
    flags = _numbers(next(parts, None), order)
    shape = _numbers(next(parts, None), order)
    name = _numbers(next(parts, None), order).astype(np.uint8).tobytes().decode("ascii", "replace")
    if len(flags) == 0 or flags.dtype.kind != "u" or shape.dtype.kind != "i" or np.any(shape < 0):
        raise ValueError(f"the head of matrix '{name}' is damaged")
    kind = _CLASSES.get(int(flags[0]) & 0xFF)
    if kind is None or int(flags[0]) >> 8 & _COMPLEX:
        return name, None
    values = _numbers(next(parts, None), order)
    size = math.prod(shape.tolist())
    if len(shape) < 2 or len(values) != size:
        raise ValueError(f"matrix '{name}' holds {len(values)} numbers where its shape needs {size}")
    # Whole numbers may be stored more narrowly than their class.
    array = values.astype(kind).reshape(shape.tolist(), order="F")
    return name, array.ravel() if 1 in array.shape else array


def _numbers(element: tuple[int, memoryview] | None, order: Order) -> NDArray[Any]:
    if element is None:
        raise ValueError("a matrix is cut off")
    kind, data = element
    # Names are bytes of text in files of other programs (types 16 to 18); only the first 8 bits of each are used.
    name = _NUMBERS.get(kind, "u1" if kind == 16 else None)
    if name is None:
        raise ValueError(f"an element of type {kind} stands where numbers are expected")
    if len(data) % np.dtype(name).itemsize:
        raise ValueError(f"an element of {len(data)} bytes does not hold whole numbers")
    return np.frombuffer(data, np.dtype(name).newbyteorder(order))
