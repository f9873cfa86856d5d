"""Terms of the error model, each with its parameters' names, priors and columns.

A *term* is a source of error that is linear in a few parameters. Its columns are the contributions of each parameter's
unit to the integrated error over every piece of a trajectory (rad), a function of `nodes.Nodes` alone, so that plans
and logs use the same terms. A new source of error is one more class here.
"""

import importlib
from abc import abstractmethod
from collections.abc import Sequence
from importlib.metadata import entry_points
from typing import Any, ClassVar, Final

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, PytreeModule, namespace, placed
from gradcal_jax.model.bases import Basis, HigherPolynomials, Polynomial, tensor
from gradcal_jax.model.nodes import NodeGroup, Nodes, OtherTemperature, SharedNodes

BIAS: Final = "bias"
SCALE_FACTOR: Final = "scale_factor"
TEMPERATURE_GRADIENT: Final = "bias_temperature_gradient"
HARMONICS: Final = "harmonics"
# Until its first turn an axis stands anywhere within its backlash. With a standard deviation of this many backlashes,
# several times the true one, the first turn tells hardly anything of their size: it would, if that were certain.
UNTOLD_BEGIN: Final = 2.0
# The smallest turn that has a direction, rad.
_SMALLEST_TURN = np.radians(0.1)
DISCREPANCY: Final = "{}_discrepancy"


class Term(PytreeModule):
    """A source of error that is linear in `size` parameters; `name` identifies it in a model."""

    name: eqx.AbstractVar[str]

    @property
    @abstractmethod
    def unit(self) -> str:
        """SI unit of its parameters."""

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
    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        """Contribution of each parameter's unit to the integrated error over each piece, rad."""

    @property
    def to_reported(self) -> np.ndarray:
        """`(size, size)`: the engine's parameters to the reported ones."""
        return np.eye(self.size)


class Discrepancy(Term):
    """Functions that the structure of a map omits: the next Legendre polynomials, each with standard deviation `std`.

    Legendre polynomials, since the prior is on these functions. Without `rate` they
    are functions of temperature alone.
    """

    temperature: HigherPolynomials
    rate: HigherPolynomials | None
    std: Float[AnyArray, ""]
    name: str = eqx.field(static=True)
    late: OtherTemperature | None = eqx.field(static=True, default=None)

    @property
    def unit(self) -> str:
        return "rad/s" if self.rate is None else "1"

    @property
    def size(self) -> int:
        extra = self.temperature.size
        if self.rate is None:
            return extra
        return extra * (self.rate.lowest + self.rate.size) + self.temperature.lowest * self.rate.size

    def names(self) -> list[str]:
        return [f"{self.name}{k}" for k in range(self.size)]

    def degrees(self) -> list[tuple[int, int]]:
        """Degrees in temperature and in rate of each function, in the order of `values`; 0 for a map without rate."""
        low, high = self.temperature.lowest, self.temperature.lowest + self.temperature.size
        if self.rate is None:
            return [(i, 0) for i in range(low, high)]
        beyond, every = self.rate.lowest, self.rate.lowest + self.rate.size
        first = [(i, j) for i in range(low, high) for j in range(every)]
        return first + [(i, j) for i in range(low) for j in range(beyond, every)]

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        return namespace(self.std).eye(self.size) / self.std

    def _factors(self, temperature, rate) -> list[tuple]:
        """Pairs of sets of functions whose products the structure omits."""
        extra_t = self.temperature
        if self.rate is None:
            # In the rates' shape: the nodes of a unit's rates differ from those of its temperature.
            return [(extra_t(temperature), namespace(temperature).ones((*rate.shape, 1)))]
        all_t, all_w = extra_t.from_zero(temperature), self.rate.from_zero(rate)
        within_t, beyond_t = all_t[..., : extra_t.lowest], all_t[..., extra_t.lowest :]
        return [(beyond_t, all_w), (within_t, all_w[..., self.rate.lowest :])]

    def values(self, temperature: Float[AnyArray, "*s"], rate: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s size"]:
        """The functions at temperatures (°C) and rates (rad/s)."""
        factors = [tensor(*pair) for pair in self._factors(temperature, rate)]
        return namespace(temperature).concatenate(factors, axis=-1)

    def shifts(self, own: "Map", by: Float[np.ndarray, " k"]) -> Float[np.ndarray, "k s s"]:
        """S with `f(T + by) = f(T) S` for all T (°C), f the functions of the map and then its own."""
        axes = [
            np.zeros(1)
            if basis is None
            else basis.centre + basis.scale * np.linspace(-1.0, 1.0, basis.lowest + basis.size)
            for basis in (self.temperature, self.rate)
        ]
        t, w = (x.ravel() for x in np.meshgrid(*axes, indexing="ij"))
        at = lambda t: np.concatenate([own.values(t, w), self.values(t, w)], axis=-1)  # noqa: E731
        return np.linalg.solve(at(t)[None], np.stack([at(t + b) for b in by]))

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        def of_group(group: NodeGroup):
            drive = 1.0 if self.rate is None else group.rate[..., None]
            pairs = self._factors(group.temperature, group.rate)
            parts = [group.sums(t, w * drive) for t, w in pairs if t.shape[-1] and w.shape[-1]]
            return namespace(group.weight).concatenate(parts, axis=-1)

        return nodes.at(self.late).integrals(of_group, self.size, moving_only=self.rate is not None)


class Map(Term):
    """A calibrated function: `B(T)` (`rate` is None, rad/s) or `M(T, ω)`, which the rate multiplies, with its priors.

    `prior_std`: standard deviation of every *reported* coefficient, or of each, rad/s for B and 1 for M; `inf` is flat.
    `common_std`: of an error common to the whole map, inseparable from its constant (turn-on bias of B).
    `smoothness_std`: standard deviation of the difference of neighbouring coefficients; `inf` is none.
    `beyond`: functions that the structure omits, a term of its own in a model.
    `late`: the temperature that the map follows; None: the sensor's own.
    """

    temperature: Basis
    rate: Basis | None
    prior_std: Float[AnyArray, "*sizes"]
    smoothness_std: Float[AnyArray, ""]
    common_std: Float[AnyArray, ""]
    beyond: Discrepancy | None = None
    name: str = eqx.field(static=True, default=BIAS)
    has_prior: bool = eqx.field(static=True, default=False)
    has_smoothness: bool = eqx.field(static=True, default=False)
    late: OtherTemperature | None = eqx.field(static=True, default=None)

    @property
    def unit(self) -> str:
        return "rad/s" if self.rate is None else "1"

    @property
    def size(self) -> int:
        return self.temperature.size * (1 if self.rate is None else self.rate.size)

    def names(self) -> list[str]:
        """As in the paper for polynomials: `a{k}` multiplies the k-th power of temperature in B; `b{j}{i}` the j-th
        power of rate and the i-th of temperature in M. Other bases count their functions: `a_bin3`, `b_spline2_1`.
        """
        t, w = self.temperature, self.rate
        if w is None:
            return [f"a{_ordinal(t, i)}" for i in range(t.size)]
        short = isinstance(t, Polynomial) and isinstance(w, Polynomial) and max(t.size, w.size) <= 10
        pairs = [(i, j) for i in range(t.size) for j in range(w.size)]
        return [f"b{j}{i}" if short else f"b{_ordinal(w, j)}_{_ordinal(t, i)}" for i, j in pairs]

    def values(self, temperature: Float[AnyArray, "*s"], rate: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s size"]:
        """The engine's functions at temperatures (°C) and rates (rad/s)."""
        at_temperature = self.temperature(temperature)
        return at_temperature if self.rate is None else tensor(at_temperature, self.rate(rate))

    @property
    def to_reported(self) -> np.ndarray:
        of_temperature = self.temperature.to_reported
        return of_temperature if self.rate is None else np.kron(of_temperature, self.rate.to_reported)

    @property
    def constant(self) -> np.ndarray:
        """`(size,)`: engine coefficients of the map that is 1 everywhere."""
        of_temperature = self.temperature.constant
        return of_temperature if self.rate is None else np.kron(of_temperature, self.rate.constant)

    def differences(self) -> np.ndarray:
        """`(q, size)`: differences of neighbouring *reported* coefficients, along the axes that have neighbours."""

        def steps(basis: Basis) -> np.ndarray:
            return np.diff(np.eye(basis.size), axis=0) if basis.has_neighbours else np.zeros((0, basis.size))

        if self.rate is None:
            return steps(self.temperature) @ self.to_reported
        n_t, n_w = self.temperature.size, self.rate.size
        both = [np.kron(steps(self.temperature), np.eye(n_w)), np.kron(np.eye(n_t), steps(self.rate))]
        return np.concatenate(both) @ self.to_reported

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        xp, rows = namespace(self.prior_std, self.smoothness_std, self.common_std), []
        if self.has_prior:
            rows.append(_prior_with_common(self.to_reported, self.constant, self.prior_std, self.common_std))
        if self.has_smoothness:
            rows.append(xp.asarray(self.differences()) / self.smoothness_std)
        return xp.concatenate(rows) if rows else xp.zeros((0, self.size))

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        def of_group(g: NodeGroup):
            return g.sums(self.temperature(g.temperature), self.drive(g))

        return nodes.at(self.late).integrals(of_group, self.size, moving_only=self.rate is not None)

    def columns_with_beyond(self, nodes: Nodes) -> tuple[Float[AnyArray, "P size"], Float[AnyArray, "P extra"]]:
        """The map's columns and the discrepancy's, computed together where its polynomials continue the map's."""
        beyond = self.beyond
        assert beyond is not None
        pairs = [(self.temperature, beyond.temperature), (self.rate, beyond.rate)]
        if not all(_continued(*pair) for pair in pairs):
            return self.columns(nodes), beyond.columns(nodes)
        in_t, in_w = beyond.temperature.lowest, 1 if beyond.rate is None else beyond.rate.lowest

        def of_group(g: NodeGroup):
            xp, w = namespace(g.weight), beyond.rate
            of_rate = xp.ones((*g.rate.shape, 1)) if w is None else g.rate[..., None] * w.from_zero(g.rate)
            every = g.sums(beyond.temperature.from_zero(g.temperature), of_rate)
            every = xp.reshape(every, (len(every), -1, of_rate.shape[-1]))
            parts = (every[:, :in_t, :in_w], every[:, in_t:], every[:, :in_t, in_w:])
            return xp.concatenate([xp.reshape(part, (len(every), -1)) for part in parts], axis=1)

        both = nodes.at(self.late).integrals(of_group, self.size + beyond.size, moving_only=self.rate is not None)
        return both[:, : self.size], both[:, self.size :]

    def drive(self, group: NodeGroup) -> AnyArray:
        """Factor of the functions of temperature at the nodes: 1 for B, `χ(ω)·ω` for M."""
        if self.rate is None:
            return namespace(group.rate).ones((*group.rate.shape, 1))
        return self.rate(group.rate) * group.rate[..., None]


def _prior_with_common(reported: np.ndarray, constant: np.ndarray, std, common_std) -> Float[AnyArray, "size size"]:
    """Rows of the prior `D² + σ_c² v vᵀ` on the reported coefficients, `D = diag(σ)`, `v` of the constant function.

    With `u = D⁻¹v`, a rank-one update of the identity has the square root `1 − γ u uᵀ`, so no factorisation is needed:
    `(1 + c u uᵀ)^(-1/2) = 1 − (1 − 1/√(1 + c|u|²)) u uᵀ/|u|²`.
    """
    xp = namespace(std, common_std)
    sizes = xp.broadcast_to(xp.asarray(std), constant.shape)
    u, rows = reported @ constant / sizes, reported / sizes[:, None]
    square = u @ u
    shrink = 1.0 - 1.0 / xp.sqrt(1.0 + common_std**2 * square)
    return rows - shrink * (xp.outer(u, u) / square @ rows)


def block_diagonal(blocks: Sequence[AnyArray]) -> AnyArray:
    """Blocks `(q_i, p_i)` along the diagonal of `(Σq, Σp)`, which is zero elsewhere."""
    parts, row, column = list[tuple[Any, AnyArray]](), 0, 0
    for block in blocks:
        below, right = row + block.shape[0], column + block.shape[1]
        parts.append(((slice(row, below), slice(column, right)), block))
        row, column = below, right
    return placed((row, column), *parts)


def _continued(own: Basis | None, higher: HigherPolynomials | None) -> bool:
    """Whether higher polynomials continue those of a map, in the engine's form."""
    if own is None or higher is None:
        return own is higher
    if not isinstance(own, Polynomial):
        return False
    return (own.size, own.centre, own.scale) == (higher.lowest, higher.centre, higher.scale)


def _ordinal(basis: Basis, index: int) -> str:
    if isinstance(basis, Polynomial):
        return str(index)
    return f"_{type(basis).__name__.lower().removeprefix('b').replace('ins', 'bin')}{index}"


class SignalMap(Term):
    """A function of temperature times a product of signals: misalignment, sensitivity to acceleration, second order.

    `signals`: names in the nodes (`SharedNodes.signal`), "|…|" for a magnitude; none: the function itself. `std`: of
    every *reported* coefficient, or of each; `inf` is flat. `symbol`: name of the coefficients. `common_std`,
    `late`: as of `Map`.
    """

    temperature: Basis
    std: Float[AnyArray, "*sizes"]
    signals: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    symbol: str = eqx.field(static=True)
    si_unit: str = eqx.field(static=True)
    has_prior: bool = eqx.field(static=True, default=True)
    common_std: float | Float[AnyArray, ""] = 0.0
    late: OtherTemperature | None = eqx.field(static=True, default=None)

    @property
    def unit(self) -> str:
        return self.si_unit

    @property
    def size(self) -> int:
        return self.temperature.size

    def names(self) -> list[str]:
        if self.size == 1:
            return [self.symbol]
        return [f"{self.symbol}{_ordinal(self.temperature, k)}" for k in range(self.size)]

    @property
    def to_reported(self) -> np.ndarray:
        return self.temperature.to_reported

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        if not self.has_prior:
            return np.zeros((0, self.size))
        return _prior_with_common(self.to_reported, self.temperature.constant, self.std, self.common_std)

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        nodes = nodes.at(self.late)
        return nodes.integrals(lambda g: g.sums(self.temperature(g.temperature), self.drive(g)), self.size)

    def drive(self, group: NodeGroup) -> AnyArray:
        """Factor of the functions of temperature at the nodes."""
        assert isinstance(group, SharedNodes), "terms with signals can only be used in the model of an IMU"
        return group.product(self.signals)


class RotationSensitivity(SignalMap):
    """Bias of a gyro by a product of two rates: its sensitivity to acceleration, times the centripetal acceleration at
    its place, from where the specific force is known. It belongs to the rig, or is too small to correct: no calibration
    has it."""


class GradientOfBias(Term):
    """Sensitivity of the bias to dT/dt, (rad/s)/(K/s) or (m/s²)/(K/s): its column is the change of temperature.

    `std` `inf`: flat.
    """

    std: Float[AnyArray, ""]
    has_prior: bool = eqx.field(static=True)
    name: str = eqx.field(static=True, default=TEMPERATURE_GRADIENT)
    si_unit: str = eqx.field(static=True, default="rad/K")

    @property
    def unit(self) -> str:
        return self.si_unit

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        xp = namespace(self.std)
        return xp.reshape(1.0 / self.std, (1, 1)) if self.has_prior else xp.zeros((0, 1))

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        return nodes.temperature_change[:, None]


class EncoderHarmonics(Term):
    """The encoder's repeatable error by angle: cosine and sine of each of `orders` cycles a turn, with a prior each.

    The reference is subtracted, hence the sign of the columns; the table starts at the angle 0.
    """

    amplitudes: Float[AnyArray, " h"]
    orders: tuple[int, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True, default=HARMONICS)

    def __check_init__(self):
        if len(self.orders) != self.amplitudes.shape[0]:
            raise ValueError("expected one amplitude for each harmonic order of the angle error")

    @property
    def unit(self) -> str:
        return "rad"

    @property
    def size(self) -> int:
        return 2 * len(self.orders)

    def names(self) -> list[str]:
        return [f"angle_{wave}{order}" for order in self.orders for wave in ("cos", "sin")]

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        xp = namespace(self.amplitudes)
        return xp.diag(1.0 / xp.repeat(self.amplitudes, 2))

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        return waves(nodes.angle_before, self.orders) - waves(nodes.angle_after, self.orders)


class Backlash(Term):
    """The backlash of a drive whose angle is read at the motor, with standard deviation `std` (rad): the side on which
    the axis stands by its last turn, and where it stands before its first one."""

    std: Float[AnyArray, ""]
    name: str = eqx.field(static=True, default="backlash")

    @property
    def unit(self) -> str:
        return "rad"

    @property
    def size(self) -> int:
        return 2

    def names(self) -> list[str]:
        return ["backlash", "backlash_at_begin"]

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        xp = namespace(self.std)
        return xp.diag(1.0 / xp.stack([self.std, UNTOLD_BEGIN * self.std]))

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        before, after = sides(nodes.angle_before, nodes.angle_after)
        xp = namespace(before)
        begins = [xp.where(of == 0.0, 1.0, 0.0) for of in (before, after)]
        return xp.stack([before - after, begins[0] - begins[1]], axis=-1)


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


def make_map(
    temperature: Basis,
    rate: Basis | None = None,
    *,
    prior_std: float | np.ndarray = np.inf,
    smoothness_std: float | np.ndarray = np.inf,
    common_std: float = 0.0,
    discrepancy: tuple[float, int, int] | None = None,
    late: OtherTemperature | None = None,
) -> Map:
    """A map from plain numbers (SI). `discrepancy` is (standard deviation, highest degree in T, highest degree in ω).

    Errors: `ValueError` for a discrepancy of a basis that is not polynomial, or of no higher degree than the basis.
    """
    name, beyond = BIAS if rate is None else SCALE_FACTOR, None
    scalar = lambda v: np.asarray(v, dtype=float)  # noqa: E731
    if discrepancy is not None:
        std, *degrees = discrepancy
        polynomials = [b for b in (temperature, rate) if isinstance(b, Polynomial)]
        if len(polynomials) < (1 if rate is None else 2):
            raise ValueError(
                "a model discrepancy needs polynomial bases: for B-splines and bins, use a smoothness prior instead"
            )
        bases = [
            HigherPolynomials(b.degree + 1, degree, b.centre, b.scale)
            for b, degree in zip(polynomials, degrees, strict=False)
        ]
        of_rate = None if rate is None else bases[1]
        hidden = DISCREPANCY.format(name)
        beyond = Discrepancy(temperature=bases[0], rate=of_rate, std=scalar(std), name=hidden, late=late)
        if beyond.size == 0:
            raise ValueError(
                "the discrepancy's degrees must exceed the model's, otherwise the discrepancy adds nothing"
            )
    return Map(
        temperature=temperature,
        rate=rate,
        prior_std=scalar(prior_std),
        smoothness_std=scalar(smoothness_std),
        common_std=scalar(common_std),
        beyond=beyond,
        name=name,
        has_prior=bool(np.all(np.isfinite(prior_std))),
        has_smoothness=bool(np.isfinite(smoothness_std)),
        late=late,
    )


SLOPE: Final = "dT/dt"
"""Name of the temperature's change in a product of factors."""
ENTRY_POINTS: Final = "gradcal.terms"
"""Entry points by which other packages add terms: each names a module that defines them."""
_KNOWN: dict[str, "type[OwnTerm]"] = {}


class OwnTerm(Term):
    """An error of a channel that is linear in a few parameters, for `[[sensor.gyro.own]] term = "NAME OF THE CLASS"`.

    A subclass gives `values`, functions of the temperature's path and of the motion whose products are integrated, and
    `SI_UNIT`, of a parameter times such a product: rad/s of a gyro, m/s² of an accelerometer. It may also give `size`,
    `names`, `prior_rows`, or `columns` itself. `std`: standard deviation of each parameter before the calibration.
    """

    SI_UNIT: ClassVar[str] = "rad/s"
    std: Float[AnyArray, ""]
    name: str = eqx.field(static=True)

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        _KNOWN[cls.__name__] = cls

    @property
    def unit(self) -> str:
        return self.SI_UNIT

    def prior_rows(self) -> Float[AnyArray, "q size"]:
        return namespace(self.std).eye(self.size) / self.std

    @abstractmethod
    def values(self, nodes: SharedNodes) -> tuple[Float[AnyArray, "k m a"], Float[AnyArray, "U q b"]]:
        """Functions of `nodes.temperature` (°C), `nodes.time` (s), `nodes.slope` (K/s), and functions of the motion
        (`nodes.signal("rate x")`), by jax.numpy; a·b is the number of parameters. `constant_function`: either."""

    def columns(self, nodes: Nodes) -> Float[AnyArray, "P size"]:
        # Functions are written by jax.numpy, and where nothing is differentiated the nodes are NumPy's.
        of = np.asarray if isinstance(nodes.temperature_change, np.ndarray) else lambda values: values
        return nodes.integrals(lambda g: g.sums(*map(of, self.values(g))), self.size)


class ProductTerm(OwnTerm):
    """The product of `factors`, for `[[sensor.gyro.own]] factors = […]`: signals of the motion such as "rate x",
    "force y" or "|force z|", and "dT/dt" (K/s)."""

    factors: tuple[str, ...] = eqx.field(static=True, default=())

    def values(self, nodes: SharedNodes) -> tuple[Float[AnyArray, "k m 1"], Float[AnyArray, "U q 1"]]:
        of_path = constant_function(nodes.temperature)
        for _ in range(self.factors.count(SLOPE)):
            assert nodes.slope is not None
            of_path = of_path * nodes.slope[..., None]
        return of_path, nodes.product(tuple(factor for factor in self.factors if factor != SLOPE))


def constant_function(like: Float[AnyArray, "*s"]) -> Float[AnyArray, "*s 1"]:
    """The function that is 1 everywhere."""
    return namespace(like).ones((*like.shape, 1))


def own_term(term: str, std: float, name: str) -> OwnTerm:
    """The term of a class that was defined, or that another package brings. Errors: `ValueError` without it."""
    if term not in _KNOWN:
        for entry in entry_points(group=ENTRY_POINTS):
            importlib.import_module(entry.module)
    if term not in _KNOWN:
        raise ValueError(
            f'gradcal_jax.model.OwnTerm has no subclass "{term}": define this class, or import its module, before '
            "the spec is used. If commands or the workers of a sweep use the class, an installed package must name the "
            f'module of the class in an entry point of the group "{ENTRY_POINTS}"'
        )
    return _KNOWN[term](std=np.asarray(std), name=name)
