"""Every unit's name with its SI value, and the dimensions: kinds of quantities."""

from collections.abc import Mapping
from decimal import Context, Decimal, localcontext
from fractions import Fraction
from types import MappingProxyType
from typing import Final, NamedTuple

Powers = tuple[int | Fraction, ...]
"""Exponents of rad, s, K and m."""
PRECISE: Final = Context(prec=60)
_PI: Final = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
# What may stand before "m", "s" and so on: "mrad urad".
_PREFIXES: Final = {"n": "1e-9", "u": "1e-6", "m": "1e-3", "c": "1e-2", "k": "1e3", "M": "1e6"}
_RATIO, _ANGLE, _TIME = (0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0)
_KELVIN, _LENGTH = (0, 0, 1, 0), (0, 0, 0, 1)
_RATE, _ACCELERATION, _FREQUENCY = (1, -1, 0, 0), (0, -2, 0, 1), (0, -1, 0, 0)
# Names, the prefixes of the first one, its SI value as a ratio (of π, where it is an angle of a part of a turn), and
# what it measures.
_ROWS: Final[tuple[tuple[str, str, Decimal | int | str, Decimal | int, Powers], ...]] = (
    ("rad", "mu", 1, 1, _ANGLE),
    ("deg ° degree degrees", "m", _PI, 180, _ANGLE),
    ("′ ' arcmin", "", _PI, 10800, _ANGLE),
    ('″ " arcsec', "", _PI, 648000, _ANGLE),
    ("mas", "", _PI, 648000000, _ANGLE),
    ("rev turn turns", "", 2 * _PI, 1, _ANGLE),
    ("s sec second seconds", "mun", 1, 1, _TIME),
    ("min minute minutes", "", 60, 1, _TIME),
    ("h hr hour hours", "", 3600, 1, _TIME),
    ("d day days", "", 86400, 1, _TIME),
    ("K degC °C", "m", 1, 1, _KELVIN),
    ("degF °F", "", 5, 9, _KELVIN),
    ("m", "cmu", 1, 1, _LENGTH),
    ("dps", "m", _PI, 180, _RATE),
    ("rpm", "", _PI, 30, _RATE),
    ("g", "mu", "9.80665", 1, _ACCELERATION),
    ("Hz", "mkM", 1, 1, _FREQUENCY),
    ("ppm", "", 1, 1000000, _RATIO),
    ("ppb", "", 1, 1000000000, _RATIO),
    ("%", "", 1, 100, _RATIO),
    ("‰", "", 1, 1000, _RATIO),
    ("1", "", 1, 1, _RATIO),
)


def _symbols() -> dict[str, tuple[Decimal, Powers]]:
    symbols: dict[str, tuple[Decimal, Powers]] = {}
    with localcontext(PRECISE):
        for names, prefixes, top, bottom, powers in _ROWS:
            factor, first = Decimal(top) / bottom, names.split()[0]
            prefixed = {prefix + first: (factor * Decimal(_PREFIXES[prefix]), powers) for prefix in prefixes}
            symbols = prefixed | symbols | dict.fromkeys(names.split(), (factor, powers))
    return symbols


SYMBOLS: Final = _symbols()
# Alone, these are points on a scale with an offset; inside a compound they are differences.
ZERO_OF_SCALE: Final = {"degC": 0, "°C": 0, "degF": 32, "°F": 32}


class Dimension(NamedTuple):
    """A kind of quantity: its name, its SI unit, and an example in its customary unit."""

    name: str
    si: str
    example: str

    @property
    def usual(self) -> str:
        """Its customary unit."""
        return self.example.partition(" ")[2]

    @property
    def described(self) -> str:
        """Its name with an article."""
        return f"{'an' if self.name[0] in 'aeiou' else 'a'} {self.name}"


_DIMENSIONS: Final = (
    Dimension("angle", "rad", "0.05 deg"),
    Dimension("angular rate", "rad/s", "10 deg/s"),
    Dimension("angular acceleration", "rad/s^2", "300 deg/s^2"),
    Dimension("time", "s", "10 s"),
    Dimension("temperature", "degC", "20 degC"),
    Dimension("temperature difference", "K", "50 K"),
    Dimension("temperature slope", "K/s", "1 K/min"),
    Dimension("angle random walk", "rad/sqrt(s)", "0.1 deg/sqrt(h)"),
    Dimension("rate random walk", "rad/s/sqrt(s)", "2 deg/h/sqrt(h)"),
    Dimension("scale factor", "1", "80 ppm"),
    Dimension("scale factor slope", "1/K", "10 ppm/K"),
    Dimension("scale factor temperature-gradient sensitivity", "s/K", "50 ppm/(K/min)"),
    Dimension("bias slope", "rad/s/K", "5 deg/h/K"),
    Dimension("bias temperature-gradient sensitivity", "rad/K", "5 deg/h/(K/min)"),
    Dimension("acceleration slope", "m/s^2/K", "50 ug/K"),
    Dimension("acceleration temperature-gradient sensitivity", "m/s/K", "100 ug/(K/min)"),
    Dimension("acceleration-sensitive drift", "rad/s/(m/s^2)", "10 deg/h/g"),
    Dimension("second-order coefficient", "1/(m/s^2)", "50 ug/g^2"),
    Dimension("acceleration", "m/s^2", "5 mg"),
    Dimension("velocity random walk", "m/s/sqrt(s)", "0.1 m/s/sqrt(h)"),
    Dimension("frequency", "Hz", "100 Hz"),
    Dimension("length", "m", "0.1 m"),
)
DIMENSIONS: Final[Mapping[str, Dimension]] = MappingProxyType({dimension.name: dimension for dimension in _DIMENSIONS})
