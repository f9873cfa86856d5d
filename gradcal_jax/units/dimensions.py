"""The dimensions: kinds of quantities."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from gradcal_jax.units.expressions import read_unit
from gradcal_jax.units.symbols import Powers


@dataclass(frozen=True)
class Dimension:
    """A kind of quantity: its name, its SI unit, its customary unit, and an example."""

    name: str
    si: str
    usual: str
    example: str

    @property
    def described(self) -> str:
        """Its name with an article: ``a scale-factor slope``."""
        words = re.sub(r"order$", "order coefficient", self.name.replace("scale factor ", "scale-factor "))
        words = re.sub(r"^(second|third) order", r"\1-order", words)
        return f"{'an' if words[0] in 'aeiou' else 'a'} {words}"

    @property
    def powers(self) -> Powers:
        """Of its SI unit. Temperatures and temperature differences share them; `parse` tells them apart by name."""
        return read_unit(self.si).powers


_DIMENSIONS: Final = (
    Dimension("angle", "rad", "deg", "30 arcsec"),
    Dimension("angular rate", "rad/s", "deg/s", "10 deg/s"),
    Dimension("angular acceleration", "rad/s^2", "deg/s^2", "300 deg/s^2"),
    Dimension("time", "s", "s", "10 s"),
    Dimension("temperature", "degC", "degC", "20 degC"),
    Dimension("temperature difference", "K", "K", "50 K"),
    Dimension("temperature slope", "K/s", "K/min", "1 K/min"),
    Dimension("angle random walk", "rad/sqrt(s)", "deg/sqrt(h)", "0.1 deg/sqrt(h)"),
    Dimension("rate random walk", "rad/s/sqrt(s)", "deg/h/sqrt(h)", "2 deg/h/sqrt(h)"),
    Dimension("scale factor", "1", "ppm", "80 ppm"),
    Dimension("scale factor slope", "1/K", "ppm/K", "10 ppm/K"),
    Dimension("scale factor temperature-gradient sensitivity", "s/K", "ppm/(K/min)", "50 ppm/(K/min)"),
    Dimension("bias slope", "rad/s/K", "deg/h/K", "5 deg/h/K"),
    Dimension("bias temperature-gradient sensitivity", "rad/K", "deg/h/(K/min)", "5 deg/h/(K/min)"),
    Dimension("acceleration slope", "m/s^2/K", "ug/K", "50 ug/K"),
    Dimension("acceleration temperature-gradient sensitivity", "m/s/K", "ug/(K/min)", "100 ug/(K/min)"),
    Dimension("acceleration-sensitive drift", "rad/s/(m/s^2)", "deg/h/g", "10 deg/h/g"),
    Dimension("acceleration-squared-sensitive drift", "rad/s/(m/s^2)^2", "deg/h/g^2", "0.1 deg/h/g^2"),
    Dimension("second order", "1/(m/s^2)", "ug/g^2", "50 ug/g^2"),
    Dimension("third order", "1/(m/s^2)^2", "ug/g^3", "5 ug/g^3"),
    Dimension("acceleration", "m/s^2", "mg", "5 mg"),
    Dimension("velocity random walk", "m/s/sqrt(s)", "m/s/sqrt(h)", "0.1 m/s/sqrt(h)"),
    Dimension("frequency", "Hz", "Hz", "100 Hz"),
    Dimension("length", "m", "m", "0.1 m"),
)
DIMENSIONS: Final[Mapping[str, Dimension]] = MappingProxyType({dimension.name: dimension for dimension in _DIMENSIONS})
