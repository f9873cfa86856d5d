"""`[[sensor.gyro.bias.shape]]` and the like: the prior of a map by functions that the IMUs of a type have in common.

With coefficients `s_j` of shape j, the coefficients of the map have the covariance `Σ s_j s_jᵀ` about zero: a mean map
is one shape, what the type varies in are others, and what may be beyond them are as many as there are coefficients.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

from pydantic import Field

from gradcal_jax.files.problems import Problem
from gradcal_jax.files.quantity import Of, Quantity, Rate
from gradcal_jax.files.section import Section


class BiasShape(Section):
    """A function with a random factor for each IMU of a type, of mean 0 and variance 1."""

    axis: Literal["x", "y", "z"] | None = None
    """Its channel; absent: all channels."""
    coefficients: Annotated[tuple[Rate, ...], Field(min_length=1, max_length=40_000)]
    """Its coefficients, in the order of a calibration file."""


class ScaleFactorShape(BiasShape):
    """The same, for the scale factor."""

    coefficients: Annotated[tuple[Annotated[Quantity, Of("scale factor")], ...], Field(min_length=1, max_length=40_000)]


class SpecificForceShape(BiasShape):
    """The same, for an accelerometer."""

    coefficients: Annotated[tuple[Annotated[Quantity, Of("acceleration")], ...], Field(min_length=1, max_length=40_000)]


def shape_problems(shapes: Sequence[BiasShape], size: int, prior: Quantity | None) -> Iterator[Problem]:
    """What is wrong with the shapes of a map with `size` coefficients."""
    if not shapes:
        return
    if prior is not None:
        yield Problem(("shape",), 'is a prior, like "prior"; leave one of them out')
    for k, shape in enumerate(shapes):
        if len(shape.coefficients) != size:
            message = f"expected {size}, as many as the bases have functions"
            yield Problem(("shape", k, "coefficients"), message, len(shape.coefficients))
            return
    import numpy as np

    for axis in ("x", "y", "z"):
        rows = np.array([shape.coefficients for shape in shapes if shape.axis in (None, axis)], dtype=float)
        largest = np.max(np.abs(rows), axis=0, initial=0.0)
        if len(rows) and np.linalg.matrix_rank(rows / np.where(largest > 0.0, largest, 1.0)) < size:
            message = (
                f"the shapes of {axis} do not span all {size} coefficients; add shapes for the other deviations "
                "of the map"
            )
            yield Problem(("shape",), message)
