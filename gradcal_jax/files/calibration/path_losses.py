"""What exports lose of the errors that depend on the path of temperature."""

from collections.abc import Iterator

from gradcal_jax.files.calibration.file import Calibration
from gradcal_jax.units import DEG_PER_H, PPM, G


def path_losses(calibration: Calibration) -> Iterator[str]:
    """Sentences on what [[path]] of a calibration knows and no target carries."""
    sizes: dict[tuple[str, str, str], float] = {}
    for one in calibration.path:
        of_scale, what, size = one.unit in ("1/K", "s/K"), "", 0.0
        if one.own:
            channel = one.channel.replace("_", " ")
            yield f"{one.name} of {channel}, {one.value:.3g} {one.unit}, of a class of your own, is lost"
        elif one.width is not None:
            what = "the mean of heating and cooling; hysteresis, up to {:.3g} {} on either branch, is lost"
            size = float(one.width)
        elif one.second_thermometer:
            what, size = "what follows the second thermometer, {:.3g} {} for each K of its difference, is lost", 1.0
        elif one.unit in ("rad/K", "m/s/K", "s/K"):
            what, size = "what follows dT/dt, {:.3g} {} at 1 K/min, is lost", 1.0 / 60.0
        if what:
            of = one.channel, "scale factor" if of_scale else "bias", what
            sizes[of] = sizes.get(of, 0.0) + one.value * size
    for (channel, what, words), size in sizes.items():
        of_bias = ("deg/h", DEG_PER_H) if channel.startswith("gyro") else ("ug", 1e6 / G)
        unit, factor = ("ppm", PPM) if what == "scale factor" else of_bias
        yield f"{what} of {channel.replace('_', ' ')}: " + words.format(abs(size) * factor, unit)
