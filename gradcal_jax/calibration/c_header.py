"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The header's text is `templates/calibration.h`.
"""

from collections.abc import Iterable
from string import Template
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from gradcal_jax.calibration.correction import SIGNALS, linear_part
from gradcal_jax.calibration.file import TEMPERATURE_RATE, CalibratedChannel, CalibratedTerm, Calibration
from gradcal_jax.calibration.losses import ExportOptions, Target, within_ranges
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.spec.bases import SplineKeys

_POINTS, _FACTORS = 200, 4
# Rounds of a header, and the change, as a share of the largest value, at which they end.
_FEWEST, _MOST, _SETTLED = 6, 40, 3e-7


class _Term(NamedTuple):
    """A term of a header: the numbers of its channel and of its signals, centre and inverse scale of temperature and of
    rate, and the coefficients `(n_T, n_ω)` of their powers."""

    of: int
    channel: CalibratedChannel
    term: CalibratedTerm
    sides: list[float]
    table: NDArray[Any]


class Header:
    """The function of a header: `inputs` are its channels by their signals ("rate x"), in order: those that it
    corrects, and those on which these depend."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        terms = [(c, term) for c in calibration.channel for term in c.term if TEMPERATURE_RATE not in term.signals]
        terms = sorted(terms, key=lambda of: not of[0].misaligns(of[1]))
        used = {c.input for c in calibration.channel} | {name.strip("|") for _, t in terms for name in t.signals}
        self.inputs = [*(name for name in SIGNALS if name in used), *sorted(used.difference(SIGNALS))]
        self.terms: list[_Term] = []
        for channel, term in terms:
            sides: list[float] = []
            for basis in (term.temperature, term.rate):
                if isinstance(basis, SplineKeys):
                    raise ValueError(
                        f"a C header holds polynomials, and {term.name} of {channel.label} has knots: estimate it with "
                        "a degree, or export to csv"
                    )
                sides += [0.0, 1.0] if basis is None else [float(basis.centre), 1.0 / float(basis.scale)]
            size = 1 if term.temperature is None else term.temperature.size
            table = np.array(list(term.coefficients.values())).reshape(size, -1)
            self.terms.append(_Term(self.inputs.index(channel.input), channel, term, sides, table))
        low, high = calibration.valid_temperature
        self.matrix, self.bias = linear_part(calibration.channel, 0.5 * (low + high), self.inputs)
        self.inverse = np.linalg.inv(self.matrix)

    def corrected(self, raw: Floats, temperature_c: Floats, rounds: int | None = None) -> tuple[Floats, int]:
        """The results `(n, channels)`, computed in float32 as in C, after so many rounds (None: as many as large errors
        need), and the number of rounds."""
        f = np.float32
        reading, temperature, inverse = raw.astype(f), temperature_c.astype(f), self.inverse.astype(f)
        out, number, settled = np.zeros_like(reading), 0, False
        while number < (rounds or _MOST) and not settled:
            before, along, error = out.copy(), out.copy(), np.zeros_like(out)
            for place, channel, term, (t0, t1, w0, w1), table in self.terms:
                low, high, slow, fast = map(f, (*channel.valid_temperature, *channel.valid_rate))
                x = (np.clip(temperature, low, high) - f(t0)) * f(t1)
                w = (np.clip(along[:, place], slow, fast) - f(w0)) * f(w1)
                value = polyval(x, polyval(w, table.astype(f).T), tensor=False)
                for name in term.signals:
                    factor = self.inputs.index(name.strip("|"))
                    signal = (along if factor == place else out)[:, factor]
                    value = value * (np.abs(signal) if name.startswith("|") else signal)
                error[:, place] += value
                if channel.misaligns(term):
                    along[:, place] += value
            left = reading - out - error
            for j in range(len(self.inputs)):
                out += inverse[:, j] * left[:, j : j + 1]
            number += 1
            change, size = np.max(np.abs(out - before), axis=0), np.max(np.abs(out), axis=0)
            settled = rounds is None and number >= _FEWEST and bool(np.all(change <= _SETTLED * size))
        return out.astype(np.float64), number


def c_header(calibration: Calibration, options: ExportOptions) -> Target:
    """The header's text and function. Raises `ValueError` for bases other than polynomials."""
    header = Header(calibration)
    temperature, true = within_ranges(calibration, header.inputs, _POINTS)
    temperature = temperature.astype(np.float32).astype(np.float64)
    raw = (true @ header.matrix.T + header.bias).astype(np.float32).astype(np.float64)
    out, rounds = header.corrected(raw, temperature)
    notes = ("float32, no allocation, no division; channels in the order of the header",)
    text = _text(header, rounds, temperature[0], raw[0], out[0])

    def corrected(raw: Floats, temperature_c: Floats) -> Floats:
        return header.corrected(raw, temperature_c, rounds)[0]

    return Target(text, corrected, notes, header.inputs)


def _text(header: Header, rounds: int, at: float, raw: Floats, out: Floats) -> str:
    """The header, whose self-test is of the reading `raw` at the temperature `at`, with the result `out`."""
    calibration, inputs = header.calibration, header.inputs
    arrays: list[str] = []
    rows: list[str] = []
    for k, (place, _, term, sides, table) in enumerate(header.terms):
        factors = [(inputs.index(n.strip("|")) + 1) * (-1 if n.startswith("|") else 1) for n in term.signals]
        signals = ", ".join(map(str, factors + [0] * (_FACTORS - len(factors))))
        numbers = f"{_listed(sides)}, {len(table)}, {table.shape[1]}"
        arrays.append(f"static const float gradcal_c{k}[] = {{{_listed(table.ravel())}}};")
        rows.append(f"    {{{place}, {{{signals}}}, {numbers}, gradcal_c{k}}},")
    spans = {c.input: (*c.valid_temperature, *c.valid_rate) for c in calibration.channel}
    remarks = [f"{name}: {text}" for name, text in calibration.provenance.items()]
    remarks += ["SIMULATED: made from simulated data, not from a real sensor."] * calibration.simulated
    rounding = float(np.max(np.abs(header.inverse) @ np.abs(raw)))  # of raw counts far off zero
    return Template(presets.template("calibration.h")).substitute(
        serial_number=_comment(calibration.serial_number),
        remarks="".join(f" * {_comment(line)}\n" for line in remarks),
        frame=_comment(calibration.frame),
        channels=", ".join(f"[{k}] {_comment(name)}" for k, name in enumerate(inputs)),
        count=len(inputs),
        terms=len(header.terms),
        across=sum(channel.misaligns(term) for _, channel, term, *_ in header.terms),
        factors=_FACTORS,
        rounds=rounds,
        arrays="\n".join(arrays),
        rows="\n".join(rows),
        ranges=",\n".join(f"    {{{_listed(spans.get(name, (0.0,) * 4))}}}" for name in inputs),
        inverse=",\n".join(f"    {{{_listed(row)}}}" for row in header.inverse),
        temperature=_literal(at),
        raw=_listed(raw),
        out=_listed(out),
        tolerance=_literal(max(4e-6 * float(np.max(np.abs(out))), 4e-7 * rounding, 1e-7)),
    )


def _literal(value: float) -> str:
    """A float32 literal of C."""
    text = f"{np.float32(value):.9g}"
    return (text if any(c in text for c in ".en") else text + ".0") + "f"


def _listed(values: Iterable[float]) -> str:
    return ", ".join(map(_literal, values))


def _comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
