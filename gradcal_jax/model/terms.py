"""Terms of the error model, each with its parameters' names, priors and columns.

A *term* is a source of error that is linear in a few parameters. Its columns are the contributions of each parameter's
unit to the integrated error over every piece of a motion (rad), a function of `nodes.BodyNodes` alone, so that plans
and logs use the same terms. A new source of error is one more class here.
"""

import importlib
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from typing import Any, Final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, placed
from gradcal_jax.model.bases import Basis, BSpline, Polynomial, tensor
from gradcal_jax.model.nodes import BodyNodes, NodeGroup

BIAS: Final = "bias"
SCALE_FACTOR: Final = "scale_factor"
CONSTANT: Final = Polynomial(0, 0.0, 1.0)
TEMPERATURE_GRADIENT: Final = "bias_temperature_gradient"
# Until its first turn an axis stands anywhere within its backlash. With a standard deviation of this many backlashes,
# several times the true one, the first turn tells hardly anything of their size: it would, if that were certain.
UNTOLD_BEGIN: Final = 2.0
# The smallest turn that has a direction, rad.
_SMALLEST_TURN = np.radians(0.1)
DISCREPANCY: Final = "{}_discrepancy"


class Term(PytreeModule):
    """A source of error that is linear in `size` parameters, of the SI `unit`; `name` identifies it in a model."""

    name: eqx.AbstractVar[str]
    unit: eqx.AbstractVar[str]

    @property
    def of_own_input(self) -> bool:
        """Whether it depends on no signal but the channel's own input."""
        return False

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 1

    def names(self) -> list[str]:
        """Names of the reported parameters."""
        return [self.name] if self.size == 1 else [f"{self.name}{k}" for k in range(self.size)]

    @abstractmethod
    def prior_rows(self) -> Float[AnyArray, "q size"]:
        """Whitened rows of the prior; none for a flat one."""

    @abstractmethod
    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        """Contribution of each parameter's unit to the integrated error over each piece, rad."""

    @property
    def to_reported(self) -> np.ndarray:
        """`(size, size)`: the engine's parameters to the reported ones."""
        return np.eye(self.size)


class Discrepancy(Term):
    """Functions that the structure of a map omits: those of a `whole` map of higher degrees at `where`, which the map
    lacks, each with standard deviation `std`."""

    whole: "Map"
    std: Float[AnyArray, ""]
    where: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    @property
    def of_own_input(self) -> bool:
        return True

    @property
    def size(self) -> int:
        return len(self.where)

    def names(self) -> list[str]:
        return [f"{self.name}{k}" for k in range(self.size)]

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        return namespace(self.std).eye(self.size) / self.std

    def values(self, temperature: Float[AnyArray, "*s"], rate: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s size"]:
        """The functions at temperatures (°C) and rates (rad/s)."""
        return self.whole.values(temperature, rate)[..., self.where]

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        return self.whole.columns(nodes)[:, self.where]


class Map(Term):
    """A function of temperature, and of the channel's own input with `rate`, times a product of `signals`, with priors.

    B(T) has no signals; M(T, ω) has one, and is a function of the rate (`by_rate`), too; a misalignment has the rate
    about another axis alone. Without `by_rate`, `rate` is the constant. `prior_std`: standard deviation of every
    *reported* coefficient, or of each (infinite: none). `common_std`: of an error common to the whole map, inseparable
    from its constant (turn-on bias of B). `smoothness_std`: of the difference of neighbouring coefficients. `beyond`:
    functions that the structure omits, a term of its own in a model. `symbol`: of the coefficients; `numbered`: even if
    there is one.
    """

    temperature: Basis
    rate: Basis = CONSTANT
    prior_std: Float[np.ndarray, "*sizes"] = eqx.field(converter=np.asarray, default=np.inf)
    smoothness_std: float = np.inf
    common_std: float = 0.0
    beyond: Discrepancy | None = None
    by_rate: bool = eqx.field(static=True, default=False)
    name: str = eqx.field(static=True, default=BIAS)
    symbol: str = eqx.field(static=True, default="a")
    unit: str = eqx.field(static=True, default="rad/s")
    signals: tuple[str, ...] = eqx.field(static=True, default=())
    numbered: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return self.temperature.size * self.rate.size

    @property
    def of_own_input(self) -> bool:
        return self.by_rate or not self.signals

    @property
    def whole(self) -> "Map":
        """The map with the functions that it omits."""
        return self if self.beyond is None else self.beyond.whole

    def names(self) -> list[str]:
        """As in the paper for polynomials: `a{k}` multiplies the k-th power of temperature in B; `b{j}{i}` the j-th
        power of rate and the i-th of temperature in M. Other bases count their functions: `a_bin3`, `b_spline2_1`.
        """
        t, w, symbol = self.temperature, self.rate, self.symbol
        if not self.by_rate:
            if t.size == 1 and not self.numbered:
                return [symbol]
            return [f"{symbol}{_ordinal(t, i)}" for i in range(t.size)]
        short = isinstance(t, Polynomial) and isinstance(w, Polynomial) and max(t.size, w.size) <= 10
        pairs = [(i, j) for i in range(t.size) for j in range(w.size)]
        return [f"{symbol}{j}{i}" if short else f"{symbol}{_ordinal(w, j)}_{_ordinal(t, i)}" for i, j in pairs]

    def values(self, temperature: Float[AnyArray, "*s"], rate: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s size"]:
        """The engine's functions at temperatures (°C) and rates (rad/s)."""
        return tensor(self.temperature(temperature), self.rate(rate))

    @property
    def to_reported(self) -> np.ndarray:
        return np.kron(self.temperature.to_reported, self.rate.to_reported)

    @property
    def constant(self) -> np.ndarray:
        """`(size,)`: engine coefficients of the map that is 1 everywhere."""
        return np.kron(self.temperature.constant, self.rate.constant)

    def differences(self) -> np.ndarray:
        """`(q, size)`: differences of neighbouring *reported* coefficients, along the axes that have neighbours."""

        def steps(basis: Basis) -> np.ndarray:
            # Coefficients of B-splines belong to places.
            count = basis.size if isinstance(basis, BSpline) else 1
            return np.diff(np.eye(count, basis.size), axis=0)

        t, w = self.temperature, self.rate
        both = [np.kron(steps(t), np.eye(w.size)), np.kron(np.eye(t.size), steps(w))]
        return np.concatenate(both) @ self.to_reported

    def shifts(self, by: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k s s"] | None:
        """S with `f(T + by) = f(T) S` for all T (°C), f its functions and then those that it omits; None unless these
        are polynomials of T."""
        whole = self.whole
        if not isinstance(whole.temperature, Polynomial):
            return None
        shifts = np.kron(whole.temperature.shifts(by), np.eye(whole.rate.size)[None])
        if self.beyond is None:
            return shifts
        order = np.append(np.setdiff1d(np.arange(whole.size), self.beyond.where), self.beyond.where)
        return shifts[:, order[:, None], order]

    def prior_rows(self) -> Float[np.ndarray, "q size"]:
        rows = [np.zeros((0, self.size))]
        if np.all(np.isfinite(self.prior_std)):
            rows.append(_prior_with_common(self.to_reported, self.constant, self.prior_std, self.common_std))
        if np.isfinite(self.smoothness_std):
            rows.append(self.differences() / self.smoothness_std)
        return np.concatenate(rows)

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        return nodes.of_pieces(lambda g: g.sums(self.temperature(g.temperature), self.drive(g)), self.size)

    def drive(self, group: NodeGroup) -> Float[AnyArray, "U q b"]:
        """Factors of the functions of temperature at the nodes: the signals, and functions of the channel's input."""
        product = group.product(self.signals)
        return self.rate(group.own_input) * product if self.by_rate else product


def make_map(
    temperature: Basis | None,
    rate: Basis | None = None,
    *,
    discrepancy: tuple[float, int, int] | None = None,
    **named: Any,
) -> Map:
    """A map from plain numbers (SI), `named` as its fields; None: the constant. `discrepancy` is (standard deviation,
    highest degree in T, highest degree in ω).

    Errors: `ValueError` for a discrepancy of a basis that is not polynomial, or of no higher degree than the basis.
    """
    bases = {"temperature": temperature or CONSTANT, "rate": rate or CONSTANT}
    of = Map(**bases, by_rate=rate is not None, **named)
    if discrepancy is None:
        return of
    if not (isinstance(of.temperature, Polynomial) and isinstance(of.rate, Polynomial)):
        raise ValueError(
            "a model discrepancy needs polynomial bases: for B-splines and bins, use a smoothness prior instead"
        )
    std, highest, fastest = discrepancy
    raised = of.temperature.raised(highest), of.rate.raised(fastest if of.by_rate else 0)
    beyond = np.ones([basis.size for basis in raised], bool)
    beyond[: of.temperature.size, : of.rate.size] = False
    if not np.any(beyond):
        raise ValueError("the discrepancy's degrees must exceed the model's, otherwise the discrepancy adds nothing")
    whole = replace(of, temperature=raised[0], rate=raised[1])
    where = tuple(np.flatnonzero(beyond).tolist())
    name = DISCREPANCY.format(of.name)
    return replace(of, beyond=Discrepancy(whole=whole, std=np.asarray(std), where=where, name=name, unit=of.unit))


def _prior_with_common(
    reported: np.ndarray, constant: np.ndarray, std: np.ndarray, common_std: float
) -> Float[np.ndarray, "size size"]:
    """Rows of the prior `D² + σ_c² v vᵀ` on the reported coefficients, `D = diag(σ)`, `v` of the constant function.

    With `u = D⁻¹v`, a rank-one update of the identity has the square root `1 − γ u uᵀ`, so no factorisation is needed:
    `(1 + c u uᵀ)^(-1/2) = 1 − (1 − 1/√(1 + c|u|²)) u uᵀ/|u|²`.
    """
    sizes = np.broadcast_to(std, constant.shape)
    u, rows = reported @ constant / sizes, reported / sizes[:, None]
    square = u @ u
    shrink = 1.0 - 1.0 / np.sqrt(1.0 + common_std**2 * square)
    return rows - shrink * (np.outer(u, u) / square @ rows)


def block_diagonal(blocks: Sequence[AnyArray]) -> AnyArray:
    """Blocks `(q_i, p_i)` along the diagonal of `(Σq, Σp)`, which is zero elsewhere."""
    parts, row, column = list[tuple[Any, AnyArray]](), 0, 0
    for block in blocks:
        below, right = row + block.shape[0], column + block.shape[1]
        parts.append(((slice(row, below), slice(column, right)), block))
        row, column = below, right
    return placed((row, column), *parts)


def _ordinal(basis: Basis, index: int) -> str:
    if isinstance(basis, Polynomial):
        return str(index)
    return f"_spline{index}" if basis.degree else f"_bin{index}"


class GradientOfBias(Term):
    """Sensitivity of the bias to dT/dt, (rad/s)/(K/s) or (m/s²)/(K/s): its column is the change of temperature.

    `std` `inf`: flat.
    """

    std: float
    name: str = eqx.field(static=True, default=TEMPERATURE_GRADIENT)
    unit: str = eqx.field(static=True, default="rad/K")

    @property
    def of_own_input(self) -> bool:
        return True

    def prior_rows(self) -> Float[np.ndarray, "q size"]:
        return np.eye(1)[: int(np.isfinite(self.std))] / self.std

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        return nodes.temperature_change[:, None]


def sides(before: Float[AnyArray, " P"], after: Float[AnyArray, " P"]) -> tuple[AnyArray, AnyArray]:
    """The side of its backlash, ±½, on which an axis stands by its last turn, before and after every piece; zero before
    the first turn."""
    xp, way = namespace(before, after), after - before
    sign = xp.where(abs(way) > _SMALLEST_TURN, xp.sign(way), 0.0)
    number = xp.where(sign != 0.0, np.arange(1, len(sign) + 1), 0)
    latest = np.maximum.accumulate(number) if xp is np else jax.lax.cummax(number)
    side = 0.5 * xp.concatenate([xp.zeros(1), sign])[latest]
    return xp.concatenate([xp.zeros(1), side[:-1]]), side


def waves(angle: Float[AnyArray, "*s"], orders: tuple[int, ...]) -> Float[AnyArray, "*s m"]:
    """Cosine and sine of each of `orders` cycles a turn."""
    xp = namespace(angle)
    phase = xp.stack([order * angle for order in orders], axis=-1)
    return xp.reshape(xp.stack([xp.cos(phase), xp.sin(phase)], axis=-1), (*angle.shape, -1))


SLOPE: Final = "dT/dt"
"""Factor of an error term that is no signal: the temperature's rate, K/s."""
ENTRY_POINTS: Final = "gradcal.terms"
"""Entry points by which other packages add terms: each names a module that defines them."""
_KNOWN: dict[str, "type[OwnTerm]"] = {}


class OwnTerm(Term):
    """An error of a channel that is linear in a few parameters and estimated beside the calibration, which does not
    correct it; `[[sensor.gyro.term]]`, by its factors or by `class = "NAME OF A SUBCLASS"`.

    A subclass gives `values`, functions of the temperature's path and of the motion whose products are integrated; it
    may also give `size`, `names`, `prior_rows`, or `columns` itself. `std`: standard deviation of each parameter before
    the calibration. `signals`: of the motion, which multiply a function of the path.
    """

    std: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="1")
    signals: tuple[str, ...] = eqx.field(static=True, default=())

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        # (Those of this program have keys of their own.)
        if not cls.__module__.startswith("gradcal_jax."):
            _KNOWN[cls.__name__] = cls

    @property
    def of_path(self) -> bool:
        """Whether it depends on the path of temperature."""
        return True

    @property
    def nuisances(self) -> list[str]:
        """Names of parameters that describe the recording and not the sensor."""
        return []

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        return namespace(self.std).eye(self.size) / self.std

    @abstractmethod
    def values(self, nodes: NodeGroup) -> tuple[Float[AnyArray, "k m a"], Float[AnyArray, "U q b"]]:
        """Functions of `nodes.temperature` (°C), `nodes.time` (s), `nodes.slope` (K/s), and functions of the motion
        (`nodes.signal("rate x")`), by jax.numpy; a·b is the number of parameters. `constant_function`: either."""

    def columns(self, nodes: BodyNodes) -> Float[AnyArray, "P size"]:
        # Functions are written by jax.numpy, and where nothing is differentiated the nodes are NumPy's.
        of = np.asarray if isinstance(nodes.temperature_change, np.ndarray) else lambda values: values
        return nodes.of_pieces(lambda g: g.sums(*map(of, self.values(g))), self.size)

    def in_service(self, sign: float, slope: float) -> float:
        """The factor of the first parameter, apart from signals, a long time after the temperature began to change in
        one direction (`sign`), at `slope` K/s."""
        return 0.0


class ProductTerm(OwnTerm):
    """The product of `signals` such as "rate x", "force y" or "|force z|", and of dT/dt (K/s) to the power
    `slopes`."""

    slopes: int = eqx.field(static=True, default=0)

    @property
    def of_own_input(self) -> bool:
        return not self.signals

    @property
    def of_path(self) -> bool:
        return self.slopes > 0

    def values(self, nodes: NodeGroup) -> tuple[Float[AnyArray, "k m 1"], Float[AnyArray, "U q 1"]]:
        of_path = constant_function(nodes.temperature)
        if self.slopes:
            assert nodes.slope is not None
            of_path = of_path * nodes.slope[..., None] ** self.slopes
        return of_path, nodes.product(self.signals)

    def in_service(self, sign: float, slope: float) -> float:
        return slope**self.slopes


def constant_function(like: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s 1"]:
    """The function that is 1 everywhere."""
    return namespace(like).ones((*like.shape, 1))


def known_terms() -> tuple[type[OwnTerm], ...]:
    """The classes of terms that are defined."""
    return tuple(_KNOWN.values())


def term_of_class(of: str, std: float, name: str, unit: str) -> OwnTerm:
    """The term of a class that was defined, or that another package brings. Errors: `ValueError` without it."""
    if of not in _KNOWN:
        for entry in entry_points(group=ENTRY_POINTS):
            importlib.import_module(entry.module)
    if of not in _KNOWN:
        raise ValueError(
            f'gradcal_jax.model.OwnTerm has no subclass "{of}": define this class, or import its module, before '
            "the spec is used. If commands or the workers of a sweep use the class, an installed package must name the "
            f'module of the class in an entry point of the group "{ENTRY_POINTS}"'
        )
    return _KNOWN[of](std=np.asarray(std), name=name, unit=unit)
