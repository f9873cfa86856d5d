"""How a log is estimated, and the lag of the maps that was found."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

from gradcal_jax.estimation import HUBER

LONGEST_LAG_S = 1800.0


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


class Lag(NamedTuple):
    """The lag of the maps, s; `std`: its standard deviation where it was fitted."""

    seconds: float
    std: float | None = None

    @property
    def doubts(self) -> list[str]:
        """What speaks against a fitted lag, in sentences."""
        if self.std is None:
            return []
        said: list[str] = []
        if self.seconds > 0.99 * LONGEST_LAG_S:
            said.append(
                f"the lag reaches the longest allowed value, {self.seconds:.0f} s: the data do not determine it"
            )
        if self.seconds < 2.0 * self.std:
            said.append(
                f"no lag of the maps is significant: the estimate is {self.seconds:.2g} s, its uncertainty "
                f"(1σ) {self.std:.2g} s"
            )
        return said

    @property
    def sentences(self) -> list[str]:
        """What is said of a fitted lag."""
        if self.std is None or self.doubts:
            return self.doubts
        return [f"the maps follow the temperature {self.seconds:.4g} s late (1σ {self.std:.2g} s)"]
