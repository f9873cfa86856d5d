"""The spec of `gradcal start`: the class's error budget, the rig and targets that were answered, and a plan that fits.

Its text is `templates/spec.toml`. What no question asks is not written: it has the figures of the class.
"""

import math
from collections.abc import Mapping
from typing import Any, Final, cast

from gradcal_jax import units
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.spec import presets
from gradcal_jax.spec.absent import BESIDE_ACCELEROMETERS
from gradcal_jax.spec.typical import terms_of, typical_g_sensitivity

Answers = Mapping[str, str]
Known = Mapping[str, tuple[Any, ...]]
_FULL_TURN: Final = 2.0 * math.pi
# Before the calibration, by grade: misalignment, and the accelerometers' scale factor and its slope.
_PRIORS: Final = {
    "consumer": ("20 mrad", "1 %, 50 ppm/K"),
    "tactical": ("10 mrad", "3000 ppm, 10 ppm/K"),
    "navigation": ("1 mrad", "500 ppm, 20 ppm/K"),
}
_FACES: Final = ((135, 225), (180, 225), (225, 225), (225, 45), (45, 45), (45, 135))


def spec_text(answers: Answers, known: Known) -> tuple[str, tuple[str, ...]]:
    """The spec, and the names of the table's axes."""
    cold, warm, slope = cast("tuple[float, float, float]", known["chamber"])
    grade, kind = str(known["grade"][0]), answers["kind"]
    terms = {term.key: term.value for term in terms_of("sensor", grade)}
    lag = units.parse(str(terms["thermal_lag"]), "time")
    # The die's temperature lags the air's: temperatures that it does not reach are not required.
    inset = min(math.ceil(2.0 * slope * lag) + 2.0, 0.2 * (warm - cold))
    coldest, warmest, ramp = _parts(answers["chamber"])
    usable = min(known["rate"][0], 0.95 * known["full_scale"][0])
    axes = ("x",) if kind == "gyro" else ("turn",) if answers["axes"] == "1" else ("tilt", "spin")
    hand = answers["table"] == "hand"
    start, moves, fastest = (_moves if kind == "gyro" else _poses)(
        usable, known["acceleration"][0], known["travel"][0], axes, hand=hand
    )
    half = round(0.5 * (warm - cold))
    misalignment, scale = _PRIORS[grade]
    table = "coarse" if known["angle"][0] > units.parse("50 arcsec", "angle") else "middle"
    values: dict[str, Any] = {
        "of": answers,
        "grade": grade,
        "table": table,
        "axes": axes,
        "hand": hand,
        "half": half,
        "middle": round(0.5 * (warm + cold)),
        "box": (round(cold + inset), round(warm - inset)),
        "coldest": coldest,
        "warmest": warmest,
        "ramp": ramp,
        "fastest": f"{math.degrees(fastest):.6g}",
        "start": start,
        "moves": moves,
        "turn_on": answers["turn_on"].strip() if known["turn_on"] else "",
        "accuracy": next(term.value for term in terms_of("table", table) if term.key == "mounting_accuracy"),
        "misalignment": misalignment,
        "g_sensitivity": typical_g_sensitivity(grade),
        "lever_arm": BESIDE_ACCELEROMETERS.value,
        "targets": [*_parts(answers["targets"]), *(_parts(answers["force_targets"]) if kind == "imu" else ())],
    }
    values |= {"temperature_error": "", "bias_prior": ""}
    if known["sheet"]:
        _, bias_slope, scale_slope = _parts(answers["sheet"])
        error = terms["temperature_error"] | {"bias_slope": bias_slope, "scale_factor_slope": scale_slope}
        values["temperature_error"] = ", ".join(f'{key} = "{value}"' for key, value in error.items())
        values["bias_prior"] = _prior(answers["sheet"], "deg/s", half, 4)
    if kind != "gyro":
        values["gravity"] = _normal_gravity(units.parse(answers["latitude"], "angle"))
    if kind == "imu":
        walk, sheet = answers["force"].split(",", 1)
        values |= {
            "walk_of_force": walk.strip(),
            "force_prior": _prior(sheet, "mg", half, 3),
            "force_scale_prior": _prior(scale, "ppm", half, 2),
        }
    return rendered(presets.template("spec.toml"), values), axes


def _parts(answer: str) -> list[str]:
    return [part.strip() for part in answer.split(",")]


def _prior(sheet: str, unit: str, half: float, size: int) -> str:
    """The prior of each coefficient of a map: of the first the offset of the sheet, of powers of temperature its
    slope."""
    offset, slope = _parts(sheet)[:2]
    dimension = {
        "deg/s": ("angular rate", "bias slope"),
        "mg": ("acceleration", "acceleration slope"),
        "ppm": ("scale factor", "scale factor slope"),
    }[unit]
    one = units.parse(f"1 {unit}", dimension[0])
    sizes = [units.parse(offset, dimension[0]) / one]
    sizes += [half * units.parse(slope, dimension[1]) / one / power for power in range(1, size)]
    return ", ".join(f'"{value:.4g} {unit}"' for value in sizes)


def _normal_gravity(latitude: float) -> float:
    """At sea level, m/s² (GRS 80)."""
    return 9.780327 * (1.0 + 0.0053024 * math.sin(latitude) ** 2 - 5.8e-6 * math.sin(2.0 * latitude) ** 2)


def _moves(
    usable: float, acceleration: float, travel: float, axes: tuple[str, ...], *, hand: bool
) -> tuple[str, list[str], float]:
    """Turns there and back at three rates with a rest before each, and the fastest of the rates (rad/s)."""
    most = min(travel, 4.0 * _FULL_TURN)
    whole = math.floor(most / _FULL_TURN + 1e-9)
    angle = whole * _FULL_TURN if whole else 0.95 * most
    # The two ramps take at most half of the angle.
    fastest = min(usable, math.sqrt(0.5 * angle * acceleration))
    written = f'turn = "{{}}{360 * whole if whole else round(math.degrees(angle), 4)} deg"'
    moves: list[str] = []
    for share in (1.0, 0.6, 0.3):
        peak = f"{math.floor(1e3 * math.degrees(fastest) * share) / 1e3:g}"
        speed = (
            _by_hand(angle, math.radians(float(peak)), acceleration)
            if hand
            else f'peak_rate = "{peak} deg/s", shape = "linear ramps"'
        )
        there, back = (f'{{ rest = "5 s" }}, {{ {written.format(sign)}, {speed} }}' for sign in ("", "-"))
        moves.append(f"{there}, {back}")
    return "", moves, math.radians(math.floor(1e3 * math.degrees(fastest)) / 1e3)


def _by_hand(angle: float, peak: float, acceleration: float) -> str:
    """How long a hand takes for an angle, whose rate is an uneven raised cosine."""
    lasting = max(2.6 * angle / peak, 1.6 * math.sqrt(_FULL_TURN * angle / acceleration))
    return f'duration = "{math.ceil(10.0 * lasting) / 10.0:g} s", shape = "hand"'


def _poses(
    usable: float, acceleration: float, travel: float, axes: tuple[str, ...], *, hand: bool
) -> tuple[str, list[str], float]:
    """Where the cycle of an IMU begins, its turns at three rates and its positions, and the fastest rate (rad/s).

    Turns use the whole travel, at most three turns of it, whole ones where one fits; they begin at one end.
    """
    reach = math.degrees(travel)
    most = math.floor(min(2.0 * reach, 1080.0) / 360.0 + 1e-9) * 360.0 or math.floor(2.0 * reach)
    begin = 0.0 if math.isinf(reach) else -0.5 * most
    # The two ramps, which are cosines, take at most half of the angle.
    fastest = min(usable, math.sqrt(math.radians(most) * acceleration / math.pi))
    peaks = [f"{math.floor(1e3 * math.degrees(fastest) * share) / 1e3:g}" for share in (1.0, 0.6, 0.3)]

    def turn(axis: str, angle: float, peak: str) -> str:
        name = f'axis = "{axis}", ' if len(axes) > 1 else ""
        speed = f'peak_rate = "{peak} deg/s"'
        if hand:
            speed = _by_hand(math.radians(abs(angle)), math.radians(float(peak)), acceleration)
        return f'{{ turn = "{angle:g} deg", {name}{speed} }}, {{ rest = "5 s" }}'

    def there_and_back(axis: str) -> list[str]:
        return [f"{turn(axis, most, peak)}, {turn(axis, -most, peak)}" for peak in peaks]

    rest = '{ rest = "5 s" }'
    if len(axes) == 1:
        step = round(min(45.0, most / 7.0), 1)
        first, *others = there_and_back(axes[0])
        moves = [f"{rest}, {first}", *others]
        steps = [turn(axes[0], step, peaks[0])] * 7 + [turn(axes[0], -7.0 * step, peaks[0])]
        moves += [f"{one}, {two}" for one, two in zip(steps[::2], steps[1::2], strict=True)]
        start = f'{{ {axes[0]} = "{begin:g} deg" }}' if begin else ""
        return start, moves, math.radians(float(peaks[0]))

    def pose(**angles: float) -> str:
        inner = ", ".join(f'{name} = "{_within(angle, reach):g} deg"' for name, angle in angles.items())
        return f'{{ pose = {{ {inner} }}, rest = "5 s" }}'

    moves = [rest]
    moves += [pose(spin=begin), *there_and_back("spin")] if begin else there_and_back("spin")
    first = begin or 90.0
    # About x, about y, and each again with spin half a turn further.
    for spin in (0.0, 180.0, 90.0, 270.0):
        moves += [pose(spin=spin, tilt=first), *there_and_back("tilt")]
    moves += [pose(tilt=tilt, spin=spin) for tilt, spin in _FACES]
    moves.append('{ pose = { tilt = "0 deg", spin = "0 deg" } }')
    return "", moves, math.radians(float(peaks[0]))


def _within(angle: float, reach: float) -> float:
    """The same direction within the travel (deg), or else the end that is nearer."""
    if math.isinf(reach):
        return angle
    angle = (angle + 180.0) % 360.0 - 180.0 if abs(angle) > max(180.0, reach) else angle
    return min(max(angle, -math.floor(reach)), math.floor(reach))


def without_encoder(answers: Answers, known: Known) -> str:
    """The preset without an encoder, with the answers that it has a place for."""
    cold, warm, _ = known["chamber"]
    coldest, warmest, ramp = _parts(answers["chamber"])
    (scale_factor, bias), (force_scale, force_bias) = map(_parts, (answers["targets"], answers["force_targets"]))
    half, middle, inset = round(0.5 * (warm - cold)), round(0.5 * (warm + cold)), 0.07 * (warm - cold)
    text = presets.text("no-encoder")
    # A slower hand, or a weaker one.
    slower = max(1.0, 6.3 / known["rate"][0], math.sqrt(10.0 / known["acceleration"][0]))
    for duration in (5.0, 3.0, 1.5):
        text = text.replace(
            f'duration = "{duration:g} s"', f'duration = "{math.ceil(10.0 * duration * slower) / 10.0:g} s"'
        )
    for usual, own in (
        ("a typical consumer MEMS IMU", known["sensor"][0]),
        ("0.2 deg/√h", answers["walk"]),
        ("1000 deg/s", answers["full_scale"]),
        ('latitude = "48 deg"', f'latitude = "{answers["latitude"].strip()}"'),
        ("400 deg/s", answers["rate"]),
        ("800 deg/s^2", answers["acceleration"]),
        ('centre = "25 degC", scale = "15 K"', f'centre = "{middle} degC", scale = "{half} K"'),
        ('["5 degC", "45 degC"]', f'["{coldest}", "{warmest}"]'),
        ('["16 degC", "38 degC"]', f'["{cold + 3.0 * inset:.0f} degC", "{warm - inset:.0f} degC"]'),
        ('"10 degC"', f'"{coldest}"'),
        ('"40 degC"', f'"{warmest}"'),
        ("8 K/min", ramp),
        ("6.5 K/min", ramp),
        ("150 ppm", scale_factor),
        ("40 deg/h", bias),
        ('target      = "1 mg"', f'target      = "{force_bias}"'),
        ("300 ppm", force_scale),
    ):
        text = text.replace(usual, str(own))
    return text
