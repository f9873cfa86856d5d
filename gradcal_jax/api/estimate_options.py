"""How a log is estimated."""

from dataclasses import dataclass
from typing import Literal

from gradcal_jax.estimation import HUBER


@dataclass(frozen=True)
class Options:
    """Options of an estimate; `api.log_flow.estimate` explains each."""

    earth_rate: float | None = None
    """Earth rate along the sensor's axis, rad/s; it is subtracted. None: the spec's, or else none."""
    robust: bool = False
    threshold: float = HUBER
    lag: float | Literal["fit"] = 0.0
    """Lag of the maps behind the measured temperature, s; "fit": estimated."""
    smoothness: Literal["spec", "auto"] = "spec"
    clock: Literal["sensor", "host"] | None = None
    """None: the spec's, or else the computer's where the log has both."""
    read_every: float | None = None
    """s, of a log with the angle at every row; None: as the spec says, or else every second."""
    table_axis: str | None = None
    neighbours_k: float | None = None
    """Also group moves of one rate within this temperature difference, without a structure; K."""
    temperature_c: float | None = None
    """Temperature of a log without a thermometer, °C."""
