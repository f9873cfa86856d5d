"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The header's text is `templates/calibration.h`.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from gradcal_jax.calibration.correction import SIGNALS, linear_part
from gradcal_jax.calibration.file import TEMPERATURE_RATE, CalibratedChannel, CalibratedTerm, Calibration
from gradcal_jax.calibration.losses import ExportOptions, Target, within_ranges
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
    """A term of a header: the number of its channel; whether it is a misalignment; the numbers, from 1, of the signals
    that multiply it, negative for a magnitude; centre and inverse scale of temperature and of rate; and the
    coefficients `(n_T, n_ω)` of their powers."""

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
        terms = [(c, term) for c in channels for term in c.term if TEMPERATURE_RATE not in term.signals]
        used = {c.input for c in channels} | {name.strip("|") for _, term in terms for name in term.signals}
        self.inputs = [*(name for name in SIGNALS if name in used), *sorted(used.difference(SIGNALS))]
        self.terms = sorted((self._term(*of) for of in terms), key=lambda term: not term.across)
        low, high = calibration.valid_temperature
        matrix, bias = linear_part(channels, 0.5 * (low + high), self.inputs)
        self.inverse = np.linalg.inv(matrix)
        # Of each channel: lowest and highest temperature, and rate.
        self.ranges = np.zeros((len(self.inputs), 4), _F)
        for channel in channels:
            self.ranges[self.inputs.index(channel.input)] = (*channel.valid_temperature, *channel.valid_rate)
        temperature, true = within_ranges(calibration, self.inputs, _POINTS)
        self.temperature, self.raw = temperature.astype(_F), (true @ matrix.T + bias).astype(_F)
        self.rounds = self._rounds_needed(self.raw, self.temperature)

    def _term(self, channel: CalibratedChannel, term: CalibratedTerm) -> HeaderTerm:
        sides: list[float] = []
        for basis in (term.temperature, term.rate):
            if isinstance(basis, SplineKeys):
                raise ValueError(
                    f"a C header holds polynomials, and {term.name} of {channel.label} has knots: estimate it with "
                    "a degree, or export to csv"
                )
            sides += [0.0, 1.0] if basis is None else [basis.centre, 1.0 / basis.scale]
        numbers = [self.inputs.index(name.strip("|")) + 1 for name in term.signals]
        factors = [-n if "|" in name else n for n, name in zip(numbers, term.signals, strict=True)]
        table = np.array(list(term.coefficients.values()), _F)
        rows = 1 if term.temperature is None else term.temperature.size
        place = self.inputs.index(channel.input)
        return HeaderTerm(place, channel.misaligns(term), factors, np.array(sides, _F), table.reshape(rows, -1))

    def corrected(self, raw: Floats | Floats32, temperature_c: Floats | Floats32) -> Floats:
        """The inputs `(n, channels)` for readings, computed in float32 as in C."""
        reading, temperature = raw.astype(_F), temperature_c.astype(_F)
        out = np.zeros_like(reading)
        for _ in range(self.rounds):
            out = self._round(out, reading, temperature)
        return out.astype(np.float64)

    def _round(self, out: Floats32, reading: Floats32, temperature: Floats32) -> Floats32:
        """The inputs after one more round."""
        along, error, inverse = out.copy(), np.zeros_like(out), self.inverse.astype(_F)
        for of, across, factors, (t0, t1, w0, w1), table in self.terms:
            low, high, slow, fast = self.ranges[of]
            x = (np.clip(temperature, low, high) - t0) * t1
            w = (np.clip(along[:, of], slow, fast) - w0) * w1
            value = _polyval(x, _polyval(w, table.T), tensor=False)
            for number in factors:
                k = abs(number) - 1
                signal = (along if k == of else out)[:, k]
                value = value * (np.abs(signal) if number < 0 else signal)
            error[:, of] += value
            if across:
                along[:, of] += value
        left = reading - out - error
        out = out.copy()
        for j in range(len(self.inputs)):
            out += inverse[:, j] * left[:, j : j + 1]
        return out

    def _rounds_needed(self, reading: Floats32, temperature: Floats32) -> int:
        """As many as large errors need."""
        out = np.zeros_like(reading)
        for number in range(1, _MOST):
            before, out = out, self._round(out, reading, temperature)
            change, size = np.max(np.abs(out - before), axis=0), np.max(np.abs(out), axis=0)
            if number >= _FEWEST and np.all(change <= _SETTLED * size):
                return number
        return _MOST


def c_header(calibration: Calibration, options: ExportOptions) -> Target:
    """The header's text and function. Raises `ValueError` for bases other than polynomials."""
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
    return Target(text, header.corrected, notes, header.inputs)


def _literals(values: Iterable[float]) -> str:
    """Literals of C in float32."""
    texts = [f"{np.float32(value):.9g}" for value in values]
    return ", ".join((text if any(c in text for c in ".en") else text + ".0") + "f" for text in texts)


def _comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
