"""The spec of `gradcal start`: the class's error budget, the rig and targets that were answered, and a plan that fits.

Its text is `templates/spec.toml`. What no question asks is not written: it has the figures of the class.
"""

import math
from collections.abc import Mapping
from typing import Any, Final, cast

from gradcal_jax import units
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.spec import presets
from gradcal_jax.spec.typical import class_row, other_term, si_of, terms_of

Answers = Mapping[str, str]
Known = Mapping[str, tuple[Any, ...]]
# Before the calibration, by grade: misalignment, and the accelerometers' scale factor and its slope.
_PRIORS: Final = {
    "consumer": ("20 mrad", "1 %, 50 ppm/K"),
    "tactical": ("10 mrad", "3000 ppm, 10 ppm/K"),
    "navigation": ("1 mrad", "500 ppm, 20 ppm/K"),
}
_FACES: Final = ((135, 225), (180, 225), (225, 225), (225, 45), (45, 45), (45, 135))
_REST: Final = '{ rest = "5 s" }'


def spec_text(answers: Answers, known: Known) -> tuple[str, tuple[str, ...]]:
    """The spec, and the names of the table's axes."""
    cold, warm, slope = cast("tuple[float, float, float]", known["chamber"])
    grade, kind = answers["grade"], answers["kind"]
    terms = {term.key: term.value for term in terms_of("sensor", grade)}
    # The die's temperature lags the air's: temperatures that it does not reach are not required.
    inset = min(math.ceil(2.0 * slope * si_of(terms["thermal_lag"])) + 2.0, 0.2 * (warm - cold))
    coldest, warmest, ramp = _parts(answers["chamber"])
    axes = ("x",) if kind == "gyro" else ("turn",) if answers["axes"] == "1" else ("tilt", "spin")
    start, moves, fastest = _cycle(known, axes)
    half = round(0.5 * (warm - cold))
    misalignment, scale = _PRIORS[grade]
    table = "coarse" if known["angle"][0] > si_of("50 arcsec") else "middle"
    values: dict[str, Any] = {
        "of": answers,
        "grade": grade,
        "table": table,
        "axes": axes,
        "half": half,
        "middle": round(0.5 * (warm + cold)),
        "box": (round(cold + inset), round(warm - inset)),
        "coldest": coldest,
        "warmest": warmest,
        "ramp": ramp,
        "fastest": fastest,
        "start": start,
        "moves": moves,
        "turn_on": answers["turn_on"].strip() if known["turn_on"] else "",
        "accuracy": next(term.value for term in terms_of("table", table) if term.key == "mounting_accuracy"),
        "misalignment": misalignment,
        "g_sensitivity": class_row("sensor", grade)["g_sensitivity"]["value"],
        "lever_arm": other_term("beside_accelerometers").value,
        "targets": [*_parts(answers["targets"]), *_parts(answers["force_targets"])],
        "temperature_error": "",
        "bias_prior": "",
    }
    if known["sheet"]:
        _, bias_slope, scale_slope = _parts(answers["sheet"])
        error = terms["temperature_error"] | {"bias_slope": bias_slope, "scale_factor_slope": scale_slope}
        values["temperature_error"] = ", ".join(f'{key} = "{value}"' for key, value in error.items())
        values["bias_prior"] = _prior(answers["sheet"], "deg/s", half, 4)
    if kind == "imu":
        walk, sheet = answers["force"].split(",", 1)
        values["walk_of_force"] = walk.strip()
        values["force_prior"] = _prior(sheet, "mg", half, 3)
        values["force_scale_prior"] = _prior(scale, "ppm", half, 2)
    return rendered(presets.template("spec.toml"), values), axes


def _parts(answer: str) -> list[str]:
    return [part.strip() for part in answer.split(",")]


def _prior(sheet: str, unit: str, half: float, size: int) -> str:
    """The prior of each coefficient of a map: of the first the offset of the sheet, of powers of temperature its
    slope."""
    of_sheet = zip(_parts(sheet), (unit, f"{unit}/K"), strict=False)
    offset, slope = (units.to_unit(si_of(text), of) for text, of in of_sheet)
    sizes = [offset, *(half * slope / power for power in range(1, size))]
    return ", ".join(f'"{value:.4g} {unit}"' for value in sizes)


def _cycle(known: Known, axes: tuple[str, ...]) -> tuple[str, list[str], str]:
    """Where the cycle begins, its turns at three rates and its positions, and the fastest rate (deg/s).

    Turns use the whole travel: of a gyro at most four turns of it to one side, of an IMU at most three from end to end;
    whole ones where one fits.
    """
    alone, reach = axes == ("x",), math.degrees(known["travel"][0])
    limit = min(reach, 1440.0) if alone else min(2.0 * reach, 1080.0)
    least = round(0.95 * limit, 4) if alone else math.floor(limit)
    most = math.floor(limit / 360.0 + 1e-9) * 360.0 or least
    # The two ramps take at most half of the angle: linear ones, or cosines.
    usable, half_of_angle = min(known["rate"][0], 0.95 * known["full_scale"][0]), 0.5 * math.radians(most)
    steepness = 1.0 if alone else 0.5 * math.pi
    fastest = min(usable, math.sqrt(half_of_angle * known["acceleration"][0] / steepness))
    peaks = [f"{math.floor(1e3 * math.degrees(fastest) * share) / 1e3:g}" for share in (1.0, 0.6, 0.3)]
    shape = ', shape = "linear ramps"' if alone else ""

    def turn(axis: str, angle: float, peak: str) -> str:
        name = f'axis = "{axis}", ' if len(axes) > 1 else ""
        one = f'{{ turn = "{angle:g} deg", {name}peak_rate = "{peak} deg/s"{shape} }}'
        return f"{_REST}, {one}" if alone else f"{one}, {_REST}"

    def there_and_back(axis: str) -> list[str]:
        return [f"{turn(axis, most, peak)}, {turn(axis, -most, peak)}" for peak in peaks]

    if alone:
        return "", there_and_back("x"), peaks[0]
    begin = 0.0 if math.isinf(reach) else -0.5 * most
    if len(axes) == 1:
        step = round(min(45.0, most / 7.0), 1)
        steps = [turn(axes[0], step, peaks[0])] * 7 + [turn(axes[0], -7.0 * step, peaks[0])]
        pairs = [f"{one}, {two}" for one, two in zip(steps[::2], steps[1::2], strict=True)]
        start = f'{{ {axes[0]} = "{begin:g} deg" }}' if begin else ""
        first, *others = there_and_back(axes[0])
        return start, [f"{_REST}, {first}", *others, *pairs], peaks[0]

    def pose(**angles: float) -> str:
        inner = ", ".join(f'{name} = "{_within(angle, reach):g} deg"' for name, angle in angles.items())
        return f'{{ pose = {{ {inner} }}, rest = "5 s" }}'

    moves = [_REST, *([pose(spin=begin)] if begin else []), *there_and_back("spin")]
    # About x, about y, and each again with spin half a turn further.
    for spin in (0.0, 180.0, 90.0, 270.0):
        moves += [pose(spin=spin, tilt=begin or 90.0), *there_and_back("tilt")]
    moves += [pose(tilt=tilt, spin=spin) for tilt, spin in _FACES]
    moves.append('{ pose = { tilt = "0 deg", spin = "0 deg" } }')
    return "", moves, peaks[0]


def _within(angle: float, reach: float) -> float:
    """The same direction within the travel (deg), or else the end that is nearer."""
    if math.isinf(reach):
        return angle
    angle = (angle + 180.0) % 360.0 - 180.0 if abs(angle) > max(180.0, reach) else angle
    return min(max(angle, -math.floor(reach)), math.floor(reach))
