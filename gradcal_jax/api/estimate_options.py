"""How a log is estimated."""

from dataclasses import dataclass
from typing import Literal

from gradcal_jax.estimation import HUBER


@dataclass(frozen=True)
class Options:
    """What the caller may choose; `api.log_flow.estimate` explains each."""

    earth_rate: float = 0.0
    """Of the Earth, along the sensor's axis, rad/s; it is taken off."""
    robust: bool = False
    threshold: float = HUBER
    lag: float | Literal["fit"] = 0.0
    """Of the maps behind the measured temperature, s; "fit" finds it."""
    smoothness: Literal["spec", "auto"] = "spec"
    clock: Literal["sensor", "host"] = "sensor"
    read_every: float = 1.0
    table_axis: str | None = None
    neighbours_k: float | None = None
    """Beside the map: moves of one rate within so many kelvins taken together, without a structure."""
    temperature_c: float | None = None
    """At which a log without a thermometer was recorded."""
