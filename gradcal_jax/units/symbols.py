"""Every unit's name with its SI value."""

from decimal import Context, Decimal, localcontext
from typing import Final, NamedTuple


class Powers(NamedTuple):
    """Exponents of rad, s, K and m, each *doubled* so that square roots stay whole numbers."""

    angle: int = 0
    time: int = 0
    temperature: int = 0
    length: int = 0


PRECISE: Final = Context(prec=60)
_PI: Final = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
_G: Final = Decimal("9.80665")
# What may stand before "m", "s" and so on: "mrad urad".
_PREFIXES: Final = {"n": "1e-9", "u": "1e-6", "m": "1e-3", "c": "1e-2", "k": "1e3", "M": "1e6"}


def _symbols() -> dict[str, tuple[Decimal, Powers]]:
    angle, time, temperature, length = Powers(2), Powers(0, 2), Powers(0, 0, 2), Powers(0, 0, 0, 2)
    rate, acceleration, frequency, ratio = Powers(2, -2), Powers(0, -4, 0, 2), Powers(0, -2), Powers()
    with localcontext(PRECISE):
        degree = _PI / 180
        # Names, the prefixes of the first one, its SI value, and what it measures.
        rows: list[tuple[str, str, Decimal, Powers]] = [
            ("rad", "mu", Decimal(1), angle),
            ("deg ° degree degrees", "m", degree, angle),
            ("′ ' arcmin", "", degree / 60, angle),
            ('″ " arcsec', "", degree / 3600, angle),
            ("mas", "", degree / 3600000, angle),
            ("rev turn turns", "", 2 * _PI, angle),
            ("s sec second seconds", "mun", Decimal(1), time),
            ("min minute minutes", "", Decimal(60), time),
            ("h hr hour hours", "", Decimal(3600), time),
            ("d day days", "", Decimal(86400), time),
            ("K degC °C", "m", Decimal(1), temperature),
            ("degF °F", "", Decimal(5) / 9, temperature),
            ("m", "cmu", Decimal(1), length),
            ("dps", "m", degree, rate),
            ("rpm", "", 2 * _PI / 60, rate),
            ("g", "mu", _G, acceleration),
            ("Hz", "mkM", Decimal(1), frequency),
            ("ppm", "", Decimal("1e-6"), ratio),
            ("ppb", "", Decimal("1e-9"), ratio),
            ("%", "", Decimal("1e-2"), ratio),
            ("‰", "", Decimal("1e-3"), ratio),
            ("1", "", Decimal(1), ratio),
        ]
        symbols = {name: (factor, powers) for names, _, factor, powers in rows for name in names.split()}
        for names, prefixes, factor, powers in rows:
            for prefix in prefixes:
                symbols[prefix + names.split()[0]] = factor * Decimal(_PREFIXES[prefix]), powers
    return symbols


SYMBOLS: Final = _symbols()
# Alone, these are points on a scale with an offset; inside a compound they are differences.
CELSIUS: Final = frozenset({"degC", "°C"})
FAHRENHEIT: Final = frozenset({"degF", "°F"})
