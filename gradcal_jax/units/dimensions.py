"""The dimensions, and every unit's name with its SI value."""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Context, Decimal, localcontext
from types import MappingProxyType
from typing import Final, NamedTuple


class Powers(NamedTuple):
    """Exponents of rad, s, K and m, each *doubled* so that square roots stay whole numbers."""

    angle: int = 0
    time: int = 0
    temperature: int = 0
    length: int = 0


@dataclass(frozen=True)
class Dimension:
    """A kind of quantity: its name with an article, its SI unit, its customary unit, and an example."""

    name: str
    described: str
    si: str
    usual: str
    example: str
    powers: Powers


# Temperatures proper and temperature differences share their exponents; `parse` tells them apart by name.
_DIMENSIONS: Final = (
    Dimension("angle", "an angle", "rad", "deg", "30 arcsec", Powers(2)),
    Dimension("angular rate", "an angular rate", "rad/s", "deg/s", "10 deg/s", Powers(2, -2)),
    Dimension("angular acceleration", "an angular acceleration", "rad/s^2", "deg/s^2", "300 deg/s^2", Powers(2, -4)),
    Dimension("time", "a time", "s", "s", "10 s", Powers(0, 2)),
    Dimension("temperature", "a temperature", "degC", "degC", "20 degC", Powers(0, 0, 2)),
    Dimension("temperature difference", "a temperature difference", "K", "K", "50 K", Powers(0, 0, 2)),
    Dimension("temperature slope", "a temperature slope", "K/s", "K/min", "1 K/min", Powers(0, -2, 2)),
    Dimension(
        "angle random walk", "an angle random walk", "rad/sqrt(s)", "deg/sqrt(h)", "0.1 deg/sqrt(h)", Powers(2, -1)
    ),
    Dimension(
        "rate random walk", "a rate random walk", "rad/s/sqrt(s)", "deg/h/sqrt(h)", "2 deg/h/sqrt(h)", Powers(2, -3)
    ),
    Dimension("scale factor", "a scale factor", "1", "ppm", "80 ppm", Powers()),
    Dimension("scale factor slope", "a scale-factor slope", "1/K", "ppm/K", "10 ppm/K", Powers(0, 0, -2)),
    Dimension(
        "scale factor temperature-gradient sensitivity",
        "a scale-factor temperature-gradient sensitivity",
        "s/K",
        "ppm/(K/min)",
        "50 ppm/(K/min)",
        Powers(0, 2, -2),
    ),
    Dimension("bias slope", "a bias slope", "rad/s/K", "deg/h/K", "5 deg/h/K", Powers(2, -2, -2)),
    Dimension(
        "bias temperature-gradient sensitivity",
        "a bias temperature-gradient sensitivity",
        "rad/K",
        "deg/h/(K/min)",
        "5 deg/h/(K/min)",
        Powers(2, 0, -2),
    ),
    Dimension("acceleration slope", "an acceleration slope", "m/s^2/K", "ug/K", "50 ug/K", Powers(0, -4, -2, 2)),
    Dimension(
        "acceleration temperature-gradient sensitivity",
        "an acceleration temperature-gradient sensitivity",
        "m/s/K",
        "ug/(K/min)",
        "100 ug/(K/min)",
        Powers(0, -2, -2, 2),
    ),
    Dimension(
        "acceleration-sensitive drift",
        "an acceleration-sensitive drift",
        "rad/s/(m/s^2)",
        "deg/h/g",
        "10 deg/h/g",
        Powers(2, 2, 0, -2),
    ),
    Dimension(
        "acceleration-squared-sensitive drift",
        "an acceleration-squared-sensitive drift",
        "rad/s/(m/s^2)^2",
        "deg/h/g^2",
        "0.1 deg/h/g^2",
        Powers(2, 6, 0, -4),
    ),
    Dimension("second order", "a second-order coefficient", "1/(m/s^2)", "ug/g^2", "50 ug/g^2", Powers(0, 4, 0, -2)),
    Dimension("third order", "a third-order coefficient", "1/(m/s^2)^2", "ug/g^3", "5 ug/g^3", Powers(0, 8, 0, -4)),
    Dimension("acceleration", "an acceleration", "m/s^2", "mg", "5 mg", Powers(0, -4, 0, 2)),
    Dimension(
        "velocity random walk", "a velocity random walk", "m/s/sqrt(s)", "m/s/sqrt(h)", "0.1 m/s/sqrt(h)",
        Powers(0, -3, 0, 2),
    ),
    Dimension("frequency", "a frequency", "Hz", "Hz", "100 Hz", Powers(0, -2)),
    Dimension("length", "a length", "m", "m", "0.1 m", Powers(0, 0, 0, 2)),
)  # fmt: skip
DIMENSIONS: Final[Mapping[str, Dimension]] = MappingProxyType({dimension.name: dimension for dimension in _DIMENSIONS})

PRECISE: Final = Context(prec=60)
_PI: Final = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
_G: Final = Decimal("9.80665")


def _names() -> dict[str, tuple[Decimal, Powers]]:
    angle, time, temperature, length = Powers(2), Powers(0, 2), Powers(0, 0, 2), Powers(0, 0, 0, 2)
    rate, acceleration, frequency, ratio = Powers(2, -2), Powers(0, -4, 0, 2), Powers(0, -2), Powers()
    with localcontext(PRECISE):
        degree = _PI / 180
        rows: list[tuple[str, Decimal, Powers]] = [
            ("rad", Decimal(1), angle),
            ("mrad", Decimal("1e-3"), angle),
            ("urad", Decimal("1e-6"), angle),
            ("° deg degree degrees", degree, angle),
            ("mdeg", degree / 1000, angle),
            ("′ ' arcmin", degree / 60, angle),
            ('″ " arcsec', degree / 3600, angle),
            ("mas", degree / 3600000, angle),
            ("rev turn turns", 2 * _PI, angle),
            ("s sec second seconds", Decimal(1), time),
            ("ms", Decimal("1e-3"), time),
            ("us", Decimal("1e-6"), time),
            ("ns", Decimal("1e-9"), time),
            ("min minute minutes", Decimal(60), time),
            ("h hr hour hours", Decimal(3600), time),
            ("d day days", Decimal(86400), time),
            ("K degC °C", Decimal(1), temperature),
            ("degF °F", Decimal(5) / 9, temperature),
            ("mK", Decimal("1e-3"), temperature),
            ("m", Decimal(1), length),
            ("cm", Decimal("1e-2"), length),
            ("mm", Decimal("1e-3"), length),
            ("um", Decimal("1e-6"), length),
            ("dps", degree, rate),
            ("mdps", degree / 1000, rate),
            ("rpm", 2 * _PI / 60, rate),
            ("g", _G, acceleration),
            ("mg", _G / 1000, acceleration),
            ("ug", _G / 1000000, acceleration),
            ("Hz", Decimal(1), frequency),
            ("mHz", Decimal("1e-3"), frequency),
            ("kHz", Decimal("1e3"), frequency),
            ("MHz", Decimal("1e6"), frequency),
            ("ppm", Decimal("1e-6"), ratio),
            ("ppb", Decimal("1e-9"), ratio),
            ("%", Decimal("1e-2"), ratio),
            ("‰", Decimal("1e-3"), ratio),
            ("1", Decimal(1), ratio),
        ]
    return {name: (factor, powers) for names, factor, powers in rows for name in names.split()}


SYMBOLS: Final = _names()
# Alone, these are points on a scale with an offset; inside a compound they are differences.
CELSIUS: Final = frozenset({"degC", "°C"})
FAHRENHEIT: Final = frozenset({"degF", "°F"})
