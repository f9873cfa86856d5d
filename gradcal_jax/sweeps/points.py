"""The points of a sweep: the values of the keys at point number i. The same file gives the same points."""

import math

import numpy as np

from gradcal_jax.sweeps.sweep_file import Samples, Sweep


class Points:
    """All points of a sweep, counted from 0; of a grid the last axis changes fastest."""

    def __init__(self, sweep: Sweep):
        self.axis, samples = sweep.file.axis, sweep.file.samples
        self._sections = sweep.sections
        self._drawn = None if samples is None else _drawn(samples, len(self.axis))
        self._listed = [axis.listed() for axis in self.axis] if samples is None else []

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of values along the axes of a grid; of drawn points `(count,)`."""
        return tuple(len(values) for values in self._listed) if self._drawn is None else (len(self._drawn),)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def values(self, index: int) -> tuple[object, ...]:
        """One value an axis, as the spec's file holds it."""
        if self._drawn is None:
            place = np.unravel_index(index, self.shape)
            return tuple(values[int(k)] for values, k in zip(self._listed, place, strict=True))
        return tuple(axis.at(float(u)) for axis, u in zip(self.axis, self._drawn[index], strict=True))

    def changes(self, index: int) -> dict[str, object]:
        """The changes of the base: dotted keys and their values; whole sections first."""
        of_axes = sorted(zip(self.axis, self.values(index), strict=True), key=lambda one: one[0].section is None)
        return {
            key: value if axis.section is None else self._sections[axis.section, str(value)]
            for axis, value in of_axes
            for key in axis.changes
        }


def _drawn(samples: Samples, dimensions: int) -> np.ndarray:
    """Points of the unit cube `(count, dimensions)`."""
    from scipy.stats import qmc

    count, rng = samples.count, np.random.default_rng(samples.seed)
    if samples.method == "latin hypercube":
        return qmc.LatinHypercube(dimensions, rng=rng).random(count)
    # A full power of two is drawn, so that the sequence's balance does not depend on the number of points.
    return qmc.Sobol(dimensions, rng=rng).random_base2(max(0, math.ceil(math.log2(count))))[:count]
