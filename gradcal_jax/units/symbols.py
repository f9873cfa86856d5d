"""Every unit's name with its SI value, and the dimensions: kinds of quantities."""

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
# Names, what may stand before the first of them, its value in SI as a ratio, and its exponents of rad, s, K and m.
_UNITS: Final = """
rad                      | m u   | 1            |  1  0  0  0
deg ° degree degrees     | m     | π/180        |  1  0  0  0
′ ' arcmin               |       | π/10800      |  1  0  0  0
″ " arcsec               |       | π/648000     |  1  0  0  0
mas                      |       | π/648000000  |  1  0  0  0
rev turn turns           |       | π/0.5        |  1  0  0  0
s sec second seconds     | m u n | 1            |  0  1  0  0
min minute minutes       |       | 60           |  0  1  0  0
h hr hour hours          |       | 3600         |  0  1  0  0
d day days               |       | 86400        |  0  1  0  0
K degC °C                | m     | 1            |  0  0  1  0
degF °F                  |       | 5/9          |  0  0  1  0
m                        | c m u | 1            |  0  0  0  1
dps                      | m     | π/180        |  1 -1  0  0
rpm                      |       | π/30         |  1 -1  0  0
g                        | m u   | 9.80665      |  0 -2  0  1
Hz                       | m k M | 1            |  0 -1  0  0
ppm                      |       | 1/1000000    |  0  0  0  0
ppb                      |       | 1/1000000000 |  0  0  0  0
%                        |       | 1/100        |  0  0  0  0
‰                        |       | 1/1000       |  0  0  0  0
1                        |       | 1            |  0  0  0  0
"""


def _rows(table: str) -> list[list[str]]:
    """The cells of a table in text."""
    return [[cell.strip() for cell in line.split("|")] for line in table.strip().splitlines()]


def _symbols() -> dict[str, tuple[Decimal, Powers]]:
    symbols: dict[str, tuple[Decimal, Powers]] = {}
    with localcontext(PRECISE):
        for names, prefixes, value, exponents in _rows(_UNITS):
            own, powers = names.split(), tuple(map(int, exponents.split()))
            top, _, bottom = value.partition("/")
            factor = (_PI if top == "π" else Decimal(top)) / Decimal(bottom or 1)
            prefixed = {prefix + own[0]: (factor * Decimal(_PREFIXES[prefix]), powers) for prefix in prefixes.split()}
            symbols = prefixed | symbols | dict.fromkeys(own, (factor, powers))
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


_DIMENSIONS: Final = """
angle                                          | rad           | 0.05 deg
angular rate                                   | rad/s         | 10 deg/s
angular acceleration                           | rad/s^2       | 300 deg/s^2
time                                           | s             | 10 s
temperature                                    | degC          | 20 degC
temperature difference                         | K             | 50 K
temperature slope                              | K/s           | 1 K/min
angle random walk                              | rad/sqrt(s)   | 0.1 deg/sqrt(h)
rate random walk                               | rad/s/sqrt(s) | 2 deg/h/sqrt(h)
scale factor                                   | 1             | 80 ppm
scale factor slope                             | 1/K           | 10 ppm/K
scale factor temperature-gradient sensitivity  | s/K           | 50 ppm/(K/min)
bias slope                                     | rad/s/K       | 5 deg/h/K
bias temperature-gradient sensitivity          | rad/K         | 5 deg/h/(K/min)
acceleration slope                             | m/s^2/K       | 50 ug/K
acceleration temperature-gradient sensitivity  | m/s/K         | 100 ug/(K/min)
acceleration-sensitive drift                   | rad/s/(m/s^2) | 10 deg/h/g
second-order coefficient                       | 1/(m/s^2)     | 50 ug/g^2
acceleration                                   | m/s^2         | 5 mg
velocity random walk                           | m/s/sqrt(s)   | 0.1 m/s/sqrt(h)
frequency                                      | Hz            | 100 Hz
length                                         | m             | 0.1 m
"""
DIMENSIONS: Final = MappingProxyType({row[0]: Dimension(*row) for row in _rows(_DIMENSIONS)})
