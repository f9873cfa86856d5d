"""A calibration as a C header: constants with units and provenance, and a pure function in float32 with a self-test.

The header's text is `templates/calibration.h`.
"""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gradcal_jax.calibration.correction import SIGNALS, linear_part
from gradcal_jax.calibration.file import TEMPERATURE_RATE, CalibratedChannel, CalibratedTerm, Calibration
from gradcal_jax.calibration.polynomials import in_powers
from gradcal_jax.records.log import Floats
from gradcal_jax.spec import presets
from gradcal_jax.units import G

_POINTS, _FACTORS = 200, 4
# Rounds of a header, and the change, as a share of the largest value, at which they end.
_FEWEST, _MOST, _SETTLED = 6, 40, 3e-7


Sample = tuple[float, Floats, Floats]


def header(calibration: Calibration, rounds: int, sample: Sample, left_out: Sequence[str], lost: Sequence[str]) -> str:
    """The header's text. `rounds`, `sample`: of `settled`; `left_out`: coefficients that were set to zero; `lost`: what
    a header cannot carry, in words."""
    inputs, terms = inputs_of(calibration), list(_terms(calibration))
    at, raw, out = sample
    inverse = np.linalg.inv(_linear(calibration, inputs)[0])
    arrays: list[str] = []
    rows: list[str] = []
    for k, (channel, term) in enumerate(terms):
        (t0, ts), (w0, ws), table, _ = in_powers(channel, term)
        factors = [(inputs.index(n.strip("|")) + 1) * (-1 if n.startswith("|") else 1) for n in term.signals]
        signals = ", ".join(map(str, factors + [0] * (_FACTORS - len(factors))))
        numbers = f"{_listed((t0, 1.0 / ts, w0, 1.0 / ws))}, {len(table)}, {table.shape[1]}"
        arrays.append(f"static const float gradcal_c{k}[] = {{{_listed(table.ravel())}}};")
        rows.append(f"    {{{inputs.index(channel.input)}, {{{signals}}}, {numbers}, gradcal_c{k}}},")
    spans = {c.input: (*c.valid_temperature, *c.valid_rate) for c in calibration.channel}
    remarks = [f"{name}: {text}" for name, text in calibration.provenance.items()]
    remarks += ["SIMULATED: made from simulated data, not from a real sensor."] if calibration.simulated else []
    remarks += [f"set to zero, because they did not pass validation: {', '.join(left_out)}"] if left_out else []
    remarks += [f"lost: {words}" for words in lost]
    rounding = float(np.max(np.abs(inverse) @ np.abs(raw)))  # of raw counts far off zero
    return Template(presets.template("calibration.h")).substitute(
        serial_number=_comment(calibration.serial_number),
        remarks="".join(f" * {_comment(line)}\n" for line in remarks),
        frame=_comment(calibration.frame),
        channels=", ".join(f"[{k}] {_comment(_label(name))}" for k, name in enumerate(inputs)),
        count=len(inputs),
        terms=len(terms),
        across=sum(channel.misaligns(term) for channel, term in terms),
        factors=_FACTORS,
        rounds=rounds,
        arrays="\n".join(arrays),
        rows="\n".join(rows),
        ranges=",\n".join(f"    {{{_listed(spans.get(name, (0.0,) * 4))}}}" for name in inputs),
        inverse=",\n".join(f"    {{{_listed(row)}}}" for row in inverse),
        temperature=_literal(at),
        raw=_listed(raw),
        out=_listed(out),
        tolerance=_literal(max(4e-6 * float(np.max(np.abs(out))), 4e-7 * rounding, 1e-7)),
    )


def inputs_of(calibration: Calibration) -> list[str]:
    """The header's channels by their signals ("rate x"), in order: those that it corrects, and those on which these
    depend."""
    used = {channel.input: None for channel in calibration.channel}
    used |= {name.strip("|"): None for _, term in _terms(calibration) for name in term.signals}
    return [name for name in dict.fromkeys([*SIGNALS, *used]) if name in used]


def rounds_in_single(calibration: Calibration, raw: Floats, temperature_c: Floats) -> Iterator[Floats]:
    """The results of the header's function, computed in float32 as there, after each of its rounds: `(n, channels)`."""
    f, inputs = np.float32, inputs_of(calibration)
    terms = [(inputs.index(c.input), c, term, in_powers(c, term)) for c, term in _terms(calibration)]
    reading, temperature = raw.astype(f), temperature_c.astype(f)
    out, inverse = np.zeros_like(reading), np.linalg.inv(_linear(calibration, inputs)[0]).astype(f)
    while True:
        along, error = out.copy(), np.zeros_like(out)
        for place, channel, term, ((t0, ts), (w0, ws), table, _) in terms:
            low, high, slow, fast = (f(float(v)) for v in (*channel.valid_temperature, *channel.valid_rate))
            x = (np.clip(temperature, low, high) - f(t0)) * f(1.0 / ts)
            w = (np.clip(along[:, place], slow, fast) - f(w0)) * f(1.0 / ws)
            value = _evaluated(table, x, w)
            for name in term.signals:
                number = inputs.index(name.strip("|"))
                signal = (along if number == place else out)[:, number]
                value = value * (np.abs(signal) if name.startswith("|") else signal)
            error[:, place] += value
            if channel.misaligns(term):
                along[:, place] += value
        left = reading - out - error
        for j in range(len(inputs)):
            out += inverse[:, j] * left[:, j : j + 1]
        yield out.astype(np.float64)


def _terms(calibration: Calibration) -> Iterable[tuple[CalibratedChannel, CalibratedTerm]]:
    """The terms that a header has, misalignments first: no dT/dt."""
    carried = [(c, term) for c in calibration.channel for term in c.term if TEMPERATURE_RATE not in term.signals]
    return sorted(carried, key=lambda of: not of[0].misaligns(of[1]))


def _evaluated(table: NDArray[Any], x: Any, w: Any) -> Any:
    """Σ table[i, j] xⁱ wʲ in float32, in the order of the header's loops."""
    total: Any = np.zeros(x.shape, np.float32)
    for line in table[::-1]:
        row: Any = np.zeros(x.shape, np.float32)
        for value in line[::-1]:
            row = row * w + np.float32(value)
        total = total * x + row
    return total


def _linear(calibration: Calibration, inputs: Sequence[str]) -> tuple[Floats, Floats]:
    """The linear part at the middle temperature; the inverse of its matrix is the divisor of each channel's error."""
    low, high = (float(t) for t in calibration.valid_temperature)
    return linear_part(calibration.channel, 0.5 * (low + high), inputs)


def after_rounds(calibration: Calibration, raw: Floats, temperature_c: Floats, rounds: int) -> Floats:
    """The result `(n, channels)` of the header's function."""
    return next(itertools.islice(rounds_in_single(calibration, raw, temperature_c), rounds - 1, None))


def settled(calibration: Calibration, inputs: Sequence[str]) -> tuple[int, Sample]:
    """How many rounds the header takes; and a temperature and a reading, no round numbers, with the header's result."""
    rng = np.random.default_rng(0)
    low, high = (float(t) for t in calibration.valid_temperature)
    temperature = rng.uniform(low, high, _POINTS).astype(np.float32).astype(np.float64)
    rates = {c.input: tuple(map(float, c.valid_rate)) for c in calibration.channel if c.kind == "gyro"}
    common = tuple(map(float, calibration.valid_rate))
    true: list[Floats] = []
    for kind, other in (("rate", common), ("force", (-G, G))):
        names = [name for name in inputs if name.startswith(kind)]
        ends = np.array([rates.get(name, other) for name in names]).reshape(-1, 2)
        true.append(rng.uniform(ends[:, 0], ends[:, 1], (_POINTS, len(names))))
    matrix, bias = _linear(calibration, inputs)
    raw = (np.concatenate(true, axis=1) @ matrix.T + bias).astype(np.float32).astype(np.float64)
    rounds, in_header = 0, np.zeros_like(raw)
    for now in itertools.islice(rounds_in_single(calibration, raw, temperature), _MOST):
        change, rounds, in_header = np.max(np.abs(now - in_header), axis=0), rounds + 1, now
        if rounds >= _FEWEST and np.all(change <= _SETTLED * np.max(np.abs(now), axis=0)):
            break
    return rounds, (float(temperature[0]), raw[0], in_header[0])


def _label(signal: str) -> str:
    return signal.replace("rate ", "gyro ", 1).replace("force ", "accelerometer ", 1)


def _literal(value: float) -> str:
    """A float32 literal of C."""
    text = f"{np.float32(value):.9g}"
    return (text if any(c in text for c in ".en") else text + ".0") + "f"


def _listed(values: Iterable[float]) -> str:
    return ", ".join(_literal(v) for v in values)


def _comment(text: str) -> str:
    """Text that cannot end a comment."""
    return text.replace("*/", "* /").replace("\n", " ")
