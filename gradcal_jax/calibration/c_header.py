"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The header's text is `templates/calibration.h`.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from gradcal_jax.calibration.equation import SIGNALS, Equation, Map, PlacedTerm, clipped, linear_part, placed_terms
from gradcal_jax.calibration.file import TEMPERATURE_RATE, Calibration
from gradcal_jax.calibration.losses import Export, losses_of, within_ranges
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.tables.text_template import rendered

Floats32 = NDArray[np.float32]
_F = np.float32
_polyval: Any = polyval  # (its types are for other shapes)
_POINTS = 200
# Rounds of a header, and the change, as a share of the largest value, at which they end.
_FEWEST, _MOST, _SETTLED = 6, 40, 3e-7


class Header:
    """The function of a header: `inputs` are its channels by their signals ("rate x"), in order: those that it
    corrects, and those on which these depend. Raises `ValueError` for bases other than polynomials."""

    def __init__(self, calibration: Calibration) -> None:
        channels = calibration.channel
        signals = {name.strip("|") for channel in channels for term in channel.term for name in term.signals}
        used = signals.union(channel.input for channel in channels) - {TEMPERATURE_RATE}
        self.inputs = sorted(used, key=[*SIGNALS, *sorted(used)].index)
        self.terms = placed_terms(channels, self.inputs)
        low, high = calibration.valid_temperature
        matrix, bias = linear_part(channels, 0.5 * (low + high), self.inputs)
        self.inverse = np.linalg.inv(matrix)
        # Of each channel: lowest and highest temperature, and rate.
        self.ranges = np.zeros((len(self.inputs), 4), _F)
        for channel in channels:
            self.ranges[self.inputs.index(channel.input)] = (*channel.valid_temperature, *channel.valid_rate)
        temperature, true = within_ranges(calibration, self.inputs, _POINTS)
        self.temperature, self.raw = temperature.astype(_F), (matrix @ true + bias[:, None]).astype(_F)
        self.rounds = self._solve(self.raw, self.temperature, _FEWEST, _MOST)[1]

    def corrected(self, raw: Floats | Floats32, temperature_c: Floats | Floats32) -> Floats:
        """The inputs `(channels, n)` for readings, computed in float32 as in C."""
        out, _ = self._solve(raw.astype(_F), temperature_c.astype(_F), self.rounds, self.rounds)
        return out.astype(np.float64)

    def _solve(self, raw: Floats32, temperature: Floats32, fewest: int, most: int) -> tuple[Floats32, int]:
        """The inputs, and as many rounds as large errors need."""
        solving = Equation(self.terms, [_map_of(placed, temperature) for placed in self.terms])
        inverse = self.inverse.astype(_F)
        out, _, rounds = solving.solve(raw, inverse, fewest=fewest, most=most, settled=_SETTLED)
        return out, rounds


def _map_of(placed: PlacedTerm, temperature: Floats32) -> Map:
    """The map of a term, as Horner's rule computes it in float32."""
    t0, t1, w0, w1 = np.array(placed.sides, _F)
    x = (clipped(temperature, placed.channel.valid_temperature) - t0) * t1
    table = placed.table.astype(_F).T
    return lambda rate: _polyval(x, _polyval((rate - w0) * w1, table), tensor=False)


def c_header(calibration: Calibration) -> Export:
    """The header's text, and what single precision loses. Raises `ValueError` for bases other than polynomials."""
    header = Header(calibration)
    raw, temperature = header.raw[:, :1], header.temperature[:1]
    out = header.corrected(raw, temperature)
    rounding = np.max(np.abs(header.inverse) @ np.abs(raw[:, 0]))  # of raw counts far off zero
    values: dict[str, Any] = {
        "calibration": calibration,
        "header": header,
        "temperature": temperature,
        "raw": raw[:, 0],
        "out": out[:, 0],
        "tolerance": [max(4e-6 * np.max(np.abs(out)), 4e-7 * rounding, 1e-7)],
        "floats": _literals,
        "comment": _comment,
    }
    text = rendered(presets.template("calibration.h"), values)
    notes = ("float32, no allocation, no division; channels in the order of the header",)
    return Export(text, losses_of(calibration, header.inputs, header.corrected), notes)


def _literals(values: Iterable[float]) -> str:
    """Literals of C in float32."""
    texts = [f"{np.float32(value):.9g}" for value in values]
    return ", ".join((text if any(c in text for c in ".en") else text + ".0") + "f" for text in texts)


def _comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
