"""Text with units <-> SI numbers, for files, devices and messages only.

The grammar is strict: a text that does not follow it *exactly* is refused, with the nearest right spelling. (General
unit libraries read ``0.1 °/√h`` as degrees per hour, ``10 mg`` as milligrams and ``30″`` as a pure number.)

    quantity := number unit                                       "0.1 deg/sqrt(h)"
    unit     := factor ("·" factor)* ("/" factor)*                a product after a division needs parentheses
    factor   := (name | "(" unit ")") power? | "√" name | "√(" unit ")" | "sqrt(" unit ")" | "rt-" name
    power    := "^" k | superscript                               k a multiple of one half between -3 and 3

Every quantity has a *dimension*, one of the names in `DIMENSIONS`; angle is a dimension of its own, so that ``Hz`` is
no angular rate. SI means rad, s, m, K and °C for absolute temperatures; scale factors are plain ratios.

Decisions where practice is divided:

* Absolute temperatures are written in degC or degF. ``K`` is refused there, since a number in K next to a ``scale`` in
  K is nearly always a slip; differences are written in K, and ``degC`` is refused there for the same reason. Inside a
  compound (``ppm/°C``, ``degC/min``) K and °C mean the same.
* ``deg/h/sqrt(Hz)`` is 1/60 of ``deg/sqrt(h)``, as in IEEE 952 and all data sheets.
* ``g`` is standard gravity, ``mg`` and ``µg`` its parts; ``m`` is the metre, never the minute.
* A scale factor needs its unit too: ``ppm``, ``ppb``, ``%``, ``‰``, or ``1`` for a plain ratio (``0.01 1``).
* Zero needs a unit like any other number; nan and infinity are no quantities.

Arithmetic is decimal, with one rounding at the end: `parse` gives the float nearest to the text, and `format_quantity`
the shortest text that `parse` reads back as the same float.
"""

from gradcal_jax.units.quantities import (
    UnitError,
    convert,
    dimension_of,
    format_quantity,
    parse,
    parse_in,
    to_unit,
    unit_of,
)
from gradcal_jax.units.shown import (
    ARCSEC,
    DEG_PER_H,
    DEG_PER_S,
    DEG_PER_SQRT_H,
    PPM,
    G,
    count_text,
    time_text,
    times_text,
)
from gradcal_jax.units.symbols import DIMENSIONS, Dimension

__all__ = [
    "ARCSEC", "DEG_PER_H", "DEG_PER_S", "DEG_PER_SQRT_H", "DIMENSIONS", "PPM", "Dimension", "G", "UnitError",
    "convert", "count_text", "dimension_of", "format_quantity", "parse", "parse_in", "time_text", "times_text",
    "to_unit", "unit_of",
]  # fmt: skip
