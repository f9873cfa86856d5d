"""Figures of a unit's noise by the name of their error source, and the model with other ones."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from gradcal_jax.arrays import namespace, put
from gradcal_jax.model import ChannelKind, ImuModel
from gradcal_jax.model.build import BuiltImu

_WHITE: Final[dict[ChannelKind, str]] = {"gyro": "angle random walk", "accelerometer": "velocity random walk"}
# Fields of the encoders' noise, by error source.
_ENCODER: Final = {
    "rate accuracy": "rate", "reading noise": "reading", "standstill offset": "offset", "timing error": "timing",
}  # fmt: skip
CORRELATION_TIME: Final = "correlation time: {}"


def noise_sizes(built: BuiltImu) -> dict[str, np.ndarray]:
    """The standard deviation of every source of noise that is not zero, SI: `()`, or `(k,)` for each process or
    axis."""
    model, sizes = built.model, dict[str, Any]()
    for c in model.channels:
        sizes.setdefault(_WHITE[c.kind], c.angle_random_walk)
    sizes |= {name: getattr(model.encoder, field) for name, field in _ENCODER.items()}
    for name, (initial, driving, _) in _processes(built).items():
        sizes[name] = np.where(initial == 0.0, driving, initial)
    return {name: np.asarray(size, dtype=float) for name, size in sizes.items() if np.any(size)}


def correlation_times(built: BuiltImu) -> dict[str, np.ndarray]:
    """The correlation times (s) of sources whose processes all have one."""
    return {
        CORRELATION_TIME.format(name): 1.0 / decay
        for name, (initial, _, decay) in _processes(built).items()
        if np.all(decay > 0.0) and np.any(initial)
    }


def _processes(built: BuiltImu) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Initial standard deviation, diffusion and decay of the processes of every source, `(k,)` each."""
    found = {}
    for kind, sources in built.sources.items():
        own = next(c.processes for c in built.model.channels if c.kind == kind)
        for name, members in sources.items():
            numbers = (np.asarray(of)[list(members)] for of in (own.initial_std, own.diffusion, own.decay))
            found[_source(kind, name)] = tuple(numbers)
    return found


def _source(kind: ChannelKind, process: str) -> str:
    """The name of a process of one kind of channel as an error source."""
    return process if kind == "gyro" else f"accelerometer {process}"


def rescaled(built: BuiltImu, factor: Callable[[str], Any]) -> ImuModel:
    """The unit's model with the noise of every source, and every correlation time, multiplied by `factor(name)`."""

    def scaled(number: Any, name: str) -> Any:
        product = number * factor(name)
        return namespace(product).asarray(product)

    model, channels = built.model, []
    for c in model.channels:
        p, sizes, times = c.processes, np.ones(c.processes.count), np.ones(c.processes.count)
        for name, members in built.sources[c.kind].items():
            source, at = _source(c.kind, name), np.array(members)
            sizes, times = put(sizes, at, factor(source)), put(times, at, factor(CORRELATION_TIME.format(source)))
        driving = p.diffusion * sizes / namespace(times).sqrt(times)
        p = replace(p, initial_std=p.initial_std * sizes, diffusion=driving, decay=p.decay / times)
        channels.append(replace(c, angle_random_walk=scaled(c.angle_random_walk, _WHITE[c.kind]), processes=p))
    changes = {field: scaled(getattr(model.encoder, field), name) for name, field in _ENCODER.items()}
    return replace(model, channels=tuple(channels), encoder=replace(model.encoder, **changes))
