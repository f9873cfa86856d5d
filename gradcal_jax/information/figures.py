"""Figures of an IMU's errors by the name of their source, and the model with other ones."""

from collections.abc import Mapping
from functools import reduce
from typing import Any, Final, NamedTuple

import equinox as eqx
import numpy as np

from gradcal_jax.arrays import put
from gradcal_jax.model import ChannelKind, ImuModel

_WHITE: Final[dict[ChannelKind, str]] = {"gyro": "angle random walk", "accelerometer": "velocity random walk"}
# Fields of the encoders' noise, by error source.
_ENCODER: Final = {
    "rate accuracy": "rate", "reading noise": "reading", "standstill offset": "offset", "timing error": "timing",
}  # fmt: skip
CORRELATION_TIME: Final = "correlation time: "
Path = tuple[str | int, ...]


class Figure(NamedTuple):
    """The `value` of a figure, SI, and its `places` in a model: the path of an array, the indices there, and by which
    power of the figure the numbers there change."""

    value: np.ndarray
    places: tuple[tuple[Path, Any, float], ...]


def noise_figures(model: ImuModel) -> dict[str, Figure]:
    """The standard deviation of every source of noise that is not zero, `()`, or `(k,)` for each process or axis; and
    the correlation times (s) of sources whose processes all have one."""
    figures: dict[str, Figure] = {}

    def add(name: str, value: Any, *places: tuple[Path, Any, float]) -> None:
        if np.any(value):
            before = figures[name].places if name in figures else ()
            figures[name] = Figure(np.asarray(value, dtype=float), (*before, *places))

    for k, c in enumerate(model.channels):
        add(_WHITE[c.kind], c.angle_random_walk, (("channels", k, "angle_random_walk"), ..., 1.0))
        initial, driving, decay = (("channels", k, "processes", of) for of in ("initial_std", "diffusion", "decay"))
        for source in dict.fromkeys(c.processes.sources):
            name = source if c.kind == "gyro" else f"accelerometer {source}"
            at = np.flatnonzero(np.array(c.processes.sources) == source)
            start, diffusion, rates = (np.asarray(_at(model, of))[at] for of in (initial, driving, decay))
            add(name, np.where(start == 0.0, diffusion, start), (initial, at, 1.0), (driving, at, 1.0))
            if np.all(rates > 0.0) and np.any(start):
                add(CORRELATION_TIME + name, 1.0 / rates, (decay, at, -1.0), (driving, at, -0.5))
    for name, field in _ENCODER.items():
        add(name, getattr(model.encoder, field), (("encoder", field), ..., 1.0))
    return figures


def installation_figures(model: ImuModel) -> dict[str, Figure]:
    """The standard deviations of the installation's errors, by the name of the first parameter of their term."""
    paths = [("installation", k, "stds") for k in range(len(model.installation))]
    return {
        term.names()[0].replace("_", " "): Figure(np.asarray(term.stds), ((path, ..., 1.0),))
        for term, path in zip(model.installation, paths, strict=True)
    }


def with_ratios(model: ImuModel, figures: Mapping[str, Figure], ratios: Mapping[str, Any]) -> ImuModel:
    """The model with figures multiplied by `ratios`."""
    changed: dict[Path, Any] = {}
    for name, ratio in ratios.items():
        for path, at, power in figures[name].places:
            number = changed[path] if path in changed else np.asarray(_at(model, path))
            changed[path] = put(number, at, number[at] * ratio**power)
    return eqx.tree_at(lambda m: [_at(m, path) for path in changed], model, list(changed.values()))


def _at(model: Any, path: Path) -> Any:
    return reduce(lambda of, key: of[key] if isinstance(key, int) else getattr(of, key), path, model)
