"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The header's text is `templates/calibration.h`.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from gradcal_jax.calibration.equation import SIGNALS, Equation, Map, PlacedTerm, clipped, linear_part, placed_terms
from gradcal_jax.calibration.file import TEMPERATURE_RATE, Calibration
from gradcal_jax.calibration.losses import Export, losses_of, within_ranges
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.spec.bases import SplineKeys

Floats32 = NDArray[np.float32]
_F = np.float32
_polyval: Any = polyval  # (its types are for other shapes)
_POINTS = 200
# Rounds of a header, and the change, as a share of the largest value, at which they end.
_FEWEST, _MOST, _SETTLED = 6, 40, 3e-7


class HeaderTerm(NamedTuple):
    """A term of a header, as `PlacedTerm`: centre and inverse scale of temperature and of rate; and the coefficients
    `(n_T, n_ω)` of their powers."""

    of: int
    across: bool
    factors: list[int]
    sides: Floats32
    table: NDArray[Any]


class Header:
    """The function of a header: `inputs` are its channels by their signals ("rate x"), in order: those that it
    corrects, and those on which these depend. Raises `ValueError` for bases other than polynomials."""

    def __init__(self, calibration: Calibration) -> None:
        channels = calibration.channel
        signals = {name.strip("|") for channel in channels for term in channel.term for name in term.signals}
        used = signals.union(channel.input for channel in channels) - {TEMPERATURE_RATE}
        self.inputs = sorted(used, key=[*SIGNALS, *sorted(used)].index)
        self._placed = placed_terms(channels, self.inputs)
        self.terms = [_header_term(placed) for placed in self._placed]
        low, high = calibration.valid_temperature
        matrix, bias = linear_part(channels, 0.5 * (low + high), self.inputs)
        self.inverse = np.linalg.inv(matrix)
        # Of each channel: lowest and highest temperature, and rate.
        self.ranges = np.zeros((len(self.inputs), 4), _F)
        for channel in channels:
            self.ranges[self.inputs.index(channel.input)] = (*channel.valid_temperature, *channel.valid_rate)
        temperature, true = within_ranges(calibration, self.inputs, _POINTS)
        self.temperature, self.raw = temperature.astype(_F), (true @ matrix.T + bias).astype(_F)
        self.rounds = self._solve(self.raw, self.temperature, _FEWEST, _MOST)[1]

    def corrected(self, raw: Floats | Floats32, temperature_c: Floats | Floats32) -> Floats:
        """The inputs `(n, channels)` for readings, computed in float32 as in C."""
        out, _ = self._solve(raw.astype(_F), temperature_c.astype(_F), self.rounds, self.rounds)
        return out.T.astype(np.float64)

    def _solve(self, raw: Floats32, temperature: Floats32, fewest: int, most: int) -> tuple[Floats32, int]:
        """The inputs, and as many rounds as large errors need."""
        maps: list[Map] = []
        for placed, term in zip(self._placed, self.terms, strict=True):
            within = clipped(temperature, placed.channel.valid_temperature)
            maps.append(partial(_map, term, within))
        solving, inverse = Equation(self._placed, maps), self.inverse.astype(_F)
        out, _, rounds = solving.solve(raw.T, inverse, fewest=fewest, most=most, settled=_SETTLED)
        return out, rounds


def _header_term(placed: PlacedTerm) -> HeaderTerm:
    channel, term, of, across, factors = placed
    sides: list[float] = []
    for basis in term.bases:
        if isinstance(basis, SplineKeys):
            raise ValueError(
                f"a C header holds polynomials, and {term.name} of {channel.label} has knots: estimate it with "
                "a degree, or export to csv"
            )
        sides += [basis.centre, 1.0 / basis.scale]
    return HeaderTerm(of, across, factors, np.array(sides, _F), term.table.astype(_F))


def _map(term: HeaderTerm, temperature: Floats32, rate: Floats32) -> Floats32:
    t0, t1, w0, w1 = term.sides
    x, w = (temperature - t0) * t1, (rate - w0) * w1
    return _polyval(x, _polyval(w, term.table.T), tensor=False)


def c_header(calibration: Calibration) -> Export:
    """The header's text, and what single precision loses. Raises `ValueError` for bases other than polynomials."""
    header = Header(calibration)
    raw, temperature = header.raw[:1], header.temperature[:1]
    out = header.corrected(raw, temperature)
    rounding = np.max(np.abs(header.inverse) @ np.abs(raw[0]))  # of raw counts far off zero
    values: dict[str, Any] = {
        "calibration": calibration,
        "header": header,
        "temperature": temperature,
        "raw": raw[0],
        "out": out[0],
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
