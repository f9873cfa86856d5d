"""Errors that depend on the path of temperature and not on its present value alone, and error terms of one's own."""

from collections.abc import Iterable, Iterator
from typing import Annotated, Final, Generic, Literal, TypeVar

from pydantic import Field

from gradcal_jax import units
from gradcal_jax.tables import quantity as q
from gradcal_jax.tables.problems import Problem
from gradcal_jax.tables.section import Section

Value = TypeVar("Value")
Slope = TypeVar("Slope")
Gradient = TypeVar("Gradient")


class Play(Section, Generic[Slope]):
    """An error that depends on past temperatures: a play follows the temperature with a backlash of ± `width`,
    and the error is proportional to the difference between play and temperature. If the temperature changes by more
    than twice the width, heating and cooling differ by 2 × coefficient × width."""

    width: q.PositiveTemperatureDifference
    """Half-width of the play."""
    prior: q.Positive[Slope]
    """Standard deviation of the coefficient (error for each K between play and temperature) before the calibration."""


PlayOfScaleFactor = Play[q.ScaleFactorSlope]


SLOPE: Final = "dT/dt"
Factor = Annotated[str, Field(pattern=r"^((rate|force) [xyz]|\|(rate|force) [xyz]\||dT/dt)$")]
# SI units of an error by dT/dt, which have shorter names than a quotient.
_BY_SLOPE: Final = {"rad/s": "rad/K", "m/s^2": "m/s/K", "1": "s/K"}
_OF_FACTOR: Final = {"rate": "(rad/s)", "force": "(m/s^2)", "dT/dt": "(K/s)"}


class GeneralTerm(Section):
    """An estimated error of your own: the bias, or the scale factor, is proportional to a product of `factors`; or a
    subclass of `gradcal_jax.model.OwnTerm`. The maps of a calibration do not contain it."""

    name: q.Text
    """Name of its parameter, or of the parameters of its class."""
    target: Literal["bias", "scale_factor"] = "bias"
    """What the error changes: the bias, or the scale factor, which multiplies the channel's own rate or force."""
    factors: tuple[Factor, ...] = ()
    """Components of the rate and of the specific force such as "rate x" or "|force z|", or "dT/dt"."""
    class_name: q.Text | None = None
    """Name of the class, in the place of `factors`; `prior` is then in the unit of the target."""
    prior: q.Text
    """Standard deviation of each parameter before the calibration, with the unit of the target divided by those of the
    factors, as in "5 ppm/(K/min)" or "0.1 deg/h/g/g"."""

    def si_unit(self, of_bias: str) -> str:
        """SI unit of its parameter, by that of the channel's bias."""
        unit = of_bias if self.target == "bias" else "1"
        if self.factors == (SLOPE,):
            return _BY_SLOPE[unit]
        return "/".join([unit, *(_OF_FACTOR[factor.strip("|").partition(" ")[0]] for factor in self.factors)])

    def prior_in_si(self, of_bias: str) -> float:
        """Its prior, SI. Errors: `UnitError` for another unit."""
        size = units.parse_in(self.prior, self.si_unit(of_bias))
        if not size > 0.0:
            raise units.UnitError(f"'{self.prior}' must be positive")
        return size

    def _problems(self) -> Iterator[Problem]:
        if (self.class_name is None) == (not self.factors):
            yield Problem((), "give either the factors of a product, or the name of a class")


def problems_of_terms(terms: Iterable[GeneralTerm], of_bias: str) -> Iterator[Problem]:
    """What is wrong with the priors of a channel's terms, by the SI unit of its bias."""
    for number, one in enumerate(terms):
        try:
            one.prior_in_si(of_bias)
        except units.UnitError as error:
            yield Problem(("term", number, "prior"), str(error), one.prior)


class TemperaturePath(Section, Generic[Slope]):
    """Errors that depend on past temperatures, and not only on the present one, and error terms of your own; all are
    estimated."""

    hysteresis: Annotated[tuple[Play[Slope], ...], Field(max_length=10)] = ()
    """Hysteresis of the bias, as a sum of plays."""
    scale_factor_hysteresis: Annotated[tuple[PlayOfScaleFactor, ...], Field(max_length=10)] = ()
    """Hysteresis of the scale factor, as a sum of plays."""
    term: Annotated[tuple[GeneralTerm, ...], Field(max_length=20)] = ()
    """Error terms of your own."""

    @property
    def on_path(self) -> bool:
        """Whether any of these is named."""
        return any(getattr(self, key) for key in TemperaturePath.model_fields)

    def _problems(self) -> Iterator[Problem]:
        names = [one.name for one in self.term]
        if len(set(names)) < len(names):
            yield Problem(("term",), "two terms have the same name", names)
        if reserved := set(names) & {"bias", "scale_factor", "second_order"}:
            yield Problem(("term",), "is the name of a map", sorted(reserved)[0])
        for key in ("hysteresis", "scale_factor_hysteresis"):
            widths = [float(play.width) for play in getattr(self, key)]
            if len(set(widths)) < len(widths):
                yield Problem((key,), "two entries have the same width, so their coefficients cannot be separated")
