"""What sensitivities are made of, of one axis and of a whole unit."""

from typing import NamedTuple


class Elasticity(NamedTuple):
    """`percent`: by how much the requirement's residual changes for one per cent more of `figure`."""

    requirement: str
    figure: str
    percent: float


class Sensitivities(NamedTuple):
    """Elasticities, and the residual of each requirement in its unit."""

    rows: tuple[Elasticity, ...]
    residuals: dict[str, tuple[float, str]]
