"""The points of a sweep: which keys take which values at point number i. The same file gives the same points."""

import math

import numpy as np

from gradcal_jax.files.sweep import Sweep, SweepFile


class Points:
    """All points of a sweep, counted from 0; of a grid the last axis changes fastest."""

    def __init__(self, sweep: Sweep | SweepFile):
        self.file = sweep.file if isinstance(sweep, Sweep) else sweep
        self._drawn = self._listed = None
        if self.file.samples is None:
            self._listed = [axis.listed() for axis in self.file.axis]
        else:
            self._drawn = _drawn(self.file.samples.method, self.file.samples.count, len(self.file.axis), self.file)

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of values along the axes of a grid; of drawn points `(count,)`."""
        if self._listed is not None:
            return tuple(len(values) for values in self._listed)
        assert self._drawn is not None
        return (len(self._drawn),)

    def __len__(self) -> int:
        return math.prod(self.shape)

    def values(self, index: int) -> tuple[object, ...]:
        """One value an axis, as the spec's file holds it."""
        if self._listed is not None:
            place = np.unravel_index(index, self.shape)
            return tuple(values[int(k)] for values, k in zip(self._listed, place, strict=True))
        assert self._drawn is not None
        return tuple(axis.at(float(u)) for axis, u in zip(self.file.axis, self._drawn[index], strict=True))

    def changes(self, index: int) -> dict[str, object]:
        """What is changed in the base: dotted keys and their values."""
        return {
            key: value for axis, value in zip(self.file.axis, self.values(index), strict=True) for key in axis.changes
        }


def _drawn(method: str, count: int, dimensions: int, file: SweepFile) -> np.ndarray:
    """Points of the unit cube `(count, dimensions)`."""
    from scipy.stats import qmc

    assert file.samples is not None
    if method == "latin hypercube":
        return qmc.LatinHypercube(dimensions, rng=np.random.default_rng(file.samples.seed)).random(count)
    # Drawn as a whole power of two, so that the sequence's balance does not depend on how many are asked for.
    sobol = qmc.Sobol(dimensions, rng=np.random.default_rng(file.samples.seed))
    return sobol.random_base2(max(0, math.ceil(math.log2(count))))[:count]
