"""Sources of error from outside the package: one class each, named in a spec."""

import importlib
from abc import abstractmethod
from importlib.metadata import entry_points
from typing import ClassVar, Final

import equinox as eqx
import numpy as np
from jaxtyping import Float

from gradcal_jax.arrays import AnyArray, namespace
from gradcal_jax.model.nodes import Nodes, SharedNodes
from gradcal_jax.model.terms import Term

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

    @property
    def size(self) -> int:
        return 1

    def names(self) -> list[str]:
        return [self.name] if self.size == 1 else [f"{self.name}{k}" for k in range(self.size)]

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
            f'no class "{term}" of gradcal_jax.model.OwnTerm is defined: define it, or import its module, before the '
            f'spec is used; for commands and workers, an entry point "{ENTRY_POINTS}" of an installed package names it'
        )
    return _KNOWN[term](std=np.asarray(std), name=name)
