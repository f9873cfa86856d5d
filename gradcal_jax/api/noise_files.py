"""The noise of an IMU's channels as files of other programs: kalibr's imu.yaml, and a block for an INS.

Both hold continuous-time densities: the white noise N (rad/s/√Hz, m/s²/√Hz) and the random walk K of the bias
(rad/s²/√Hz, m/s³/√Hz), of each triad the largest axis. Names of the keys: kalibr's wiki, "IMU noise model".
"""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from gradcal_jax import identify
from gradcal_jax.api.instability import allan_of, at_rest, of_sensor
from gradcal_jax.files.log import Log, LogError

NoiseFormat = Literal["kalibr", "ins"]
_UNITS: Final = {"gyroscope": ("rad/s", "rad/s^2"), "accelerometer": ("m/s^2", "m/s^3")}


class ChannelNoise(NamedTuple):
    """Of a channel ("gyroscope", "accelerometer" and its axis): the fit of its Allan deviation, SI, by its own unit."""

    kind: str
    axis: str
    fit: identify.AllanFit


def noise_of_imu(log: Log, unit: str | int = 0, *, lag: float | str = "auto") -> list[ChannelNoise]:
    """Of every gyro and accelerometer of a unit at rest. **Raises:** `LogError` as `allan` does."""
    found = list[ChannelNoise]()
    for kind, labels, force in (("gyroscope", log.axes, False), ("accelerometer", log.force_axes, True)):
        for label in labels:
            rest = at_rest(log, label, unit, lag=lag, force=force)
            found.append(ChannelNoise(kind, label, of_sensor(rest, allan_of(rest)[1])))
    return found


def noise_file(channels: Sequence[ChannelNoise], form: NoiseFormat, sample_rate_hz: float, source: str) -> str:
    """The text of the file. **Raises:** `LogError` where an axis shows no white noise."""
    lines = [
        f"# noise of {source} at rest, by its Allan deviation: densities of continuous time, of the noisiest axis;",
        "# then each axis ± one standard error",
    ]
    if form == "kalibr":
        lines += ["rostopic: /imu  # the topic of your bag", f"update_rate: {sample_rate_hz:.6g}"]
    else:
        lines.append(f"sample_rate: {sample_rate_hz:.6g}  # Hz")
    for kind, (unit, per_second) in _UNITS.items():
        own = [channel for channel in channels if channel.kind == kind]
        if not own:
            lines.append(f"# {kind}: not in the record")
            continue
        for name, term, words in (
            ("noise_density", "angle_random_walk", f"{unit}/sqrt(Hz)"),
            ("random_walk", "rate_random_walk", f"{per_second}/sqrt(Hz)"),
            *([("bias_instability", "bias_instability", unit)] if form == "ins" else []),
        ):
            values = [getattr(channel.fit, term) for channel in own]
            if name == "noise_density" and not all(value.value > 0.0 for value in values):
                raise LogError(f"an {kind} shows no white noise, which the file needs: log at a higher rate")
            largest = values[int(np.argmax([value.value for value in values]))]
            each = ", ".join(
                f"{channel.axis} {value.value:.4g} ± {value.standard_error:.2g}"
                for channel, value in zip(own, values, strict=True)
            )
            if name == "noise_density" or any(value.shows for value in values):
                lines.append(f"{kind}_{name}: {largest.value:.4e}  # {words}; {each}")
            else:
                # (With no random walk at all a filter stops to learn the bias: the limit stands in its place.)
                limit = max(value.value + value.standard_error for value in values)
                lines.append(f"{kind}_{name}: {limit:.4e}  # {words}; does not show, an upper limit (1σ); {each}")
    return "\n".join(lines) + "\n"
