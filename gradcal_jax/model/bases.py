"""Bases: functions of one variable in interchangeable forms.

A basis maps a temperature (°C) or a rate (rad/s) to the values of its functions. The *engine* computes in
well-conditioned coordinates (Legendre polynomials); *reported* coefficients are those of the paper's normalised
monomials. `to_reported @ engine = reported` connects them.
"""

from abc import abstractmethod
from functools import lru_cache

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import legendre as np_legendre

from gradcal_jax import formulas
from gradcal_jax.arrays import AnyArray, PytreeModule, namespace


class Basis(PytreeModule):
    """A finite set of functions of one variable, of a polynomial `degree` between its breaks."""

    degree: eqx.AbstractVar[int]

    @abstractmethod
    def __call__(self, x: Float[AnyArray, "..."]) -> Float[AnyArray, "... size"]:
        """Values of the engine's functions at `x`, on a new last axis."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of functions."""

    @property
    def to_reported(self) -> np.ndarray:
        """`(size, size)`: engine coefficients to reported ones."""
        return np.eye(self.size)

    @property
    def constant(self) -> np.ndarray:
        """`(size,)`: engine coefficients of the function that is 1 everywhere."""
        return np.ones(self.size)

    @property
    def breaks(self) -> tuple[float, ...]:
        """Points at which the functions are not smooth; a quadrature must not extend across them."""
        return ()


@lru_cache(maxsize=64)
def _monomials(degree: int) -> np.ndarray:
    """`(size, size)`: coefficients of orthogonal polynomials to those of monomials; a shared read-only array."""
    matrix = np.zeros((degree + 1, degree + 1))
    for k, unit in enumerate(np.eye(degree + 1)):
        monomials = np_legendre.leg2poly(unit)
        matrix[: len(monomials), k] = monomials
    matrix.flags.writeable = False
    return matrix


class Polynomial(Basis):
    """Polynomials up to `degree` in `(x − centre)/scale`; reported as its monomials (paper, eqs. 4, 11)."""

    degree: int = eqx.field(static=True)
    centre: float = eqx.field(static=True)
    scale: float = eqx.field(static=True)

    def __check_init__(self):
        if self.degree < 0:
            raise ValueError(f"the degree of a polynomial must be 0 or more, not {self.degree}")
        if not self.scale > 0.0:
            raise ValueError(
                f"the scale of a polynomial must be positive, not {self.scale}: use half the range of the variable"
            )

    def __call__(self, x: Float[AnyArray, "..."]) -> Float[AnyArray, "... size"]:
        return formulas.legendre((x - self.centre) / self.scale, self.degree)

    @property
    def size(self) -> int:
        return self.degree + 1

    @property
    def to_reported(self) -> np.ndarray:
        return _monomials(self.degree)

    @property
    def constant(self) -> np.ndarray:
        return np.eye(self.size)[0]

    def raised(self, degree: int) -> "Polynomial":
        """The polynomials up to a higher degree."""
        return Polynomial(max(degree, self.degree), self.centre, self.scale)

    def shifts(self, by: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k size size"]:
        """S with `basis(x + by) = basis(x) S` for all x."""
        x = self.centre + self.scale * np.linspace(-1.0, 1.0, self.size)
        return np.linalg.solve(self(x)[None], self(x + by[:, None]))


class BSpline(Basis):
    """Clamped B-splines of `degree` on `knots` (both ends included). Those of degree 0 are bins, piecewise constants:
    the paper's mean values over carefully selected ranges."""

    knots: tuple[float, ...] = eqx.field(static=True)
    degree: int = eqx.field(static=True, default=3)

    def __check_init__(self):
        if self.degree < 0 or len(self.knots) < 2 or list(self.knots) != sorted(set(self.knots)):
            raise ValueError("a B-spline needs a degree of 0 or more, and at least two knots in increasing order")

    def __call__(self, x: Float[AnyArray, "..."]) -> Float[AnyArray, "... size"]:
        return formulas.b_spline(x, self.knots, self.degree)

    @property
    def size(self) -> int:
        return len(self.knots) - 1 + self.degree

    @property
    def breaks(self) -> tuple[float, ...]:
        return self.knots if self.degree else self.knots[1:-1]


def tensor(first: Float[AnyArray, "... a"], second: Float[AnyArray, "... b"]) -> Float[AnyArray, "... ab"]:
    """Values of a tensor basis, the second factor fastest: `(..., a), (..., b) -> (..., a·b)`."""
    product = first[..., :, None] * second[..., None, :]
    return namespace(product).reshape(product, (*product.shape[:-2], -1))
