"""The spec of `gradcal start`: error budget of the class, rig and targets of the answers, and a plan that fits them."""

import math
from collections.abc import Mapping
from string import Template
from typing import Any, Final, cast

from gradcal_jax import units
from gradcal_jax.files import presets
from gradcal_jax.files.absent import terms_of

Answers = Mapping[str, str]
Known = Mapping[str, tuple[Any, ...]]
_FULL_TURN: Final = 2.0 * math.pi
# Plain keys stand above tables.
_TERMS: Final = ("thermal_lag", "sample_clock_error", "temperature_offset", "temperature_lag")
_TERMS_OF_GYRO: Final = (
    "rate_random_walk", "turn_on_bias", "drift", "scale_factor_instability", "temperature_error",
    "bias_temperature_gradient",
)  # fmt: skip
# Before the calibration, by grade: misalignment, g-sensitivity, the accelerometers' scale factor and its slope.
_PRIORS: Final = {
    "consumer": ("20 mrad", "360 deg/h/g", "1 %, 50 ppm/K"),
    "tactical": ("10 mrad", "50 deg/h/g", "3000 ppm, 10 ppm/K"),
    "navigation": ("1 mrad", "0.1 deg/h/g", "500 ppm, 20 ppm/K"),
}
# The body's axes along the table's, once each; the first axis of a table of one axis points East, level.
_MOUNTINGS: Final = (("x", "+x", "+y", "+z"), ("y", "+z", "+x", "+y"), ("z", "+y", "+z", "+x"))
_FACES: Final = ((135, 225), (180, 225), (225, 225), (225, 45), (45, 45), (45, 135))


def spec_text(answers: Answers, known: Known) -> tuple[str, tuple[str, ...]]:
    """The spec, and the names of the table's axes."""
    cold, warm, slope = cast("tuple[float, float, float]", known["chamber"])
    grade, kind = str(known["grade"][0]), answers["kind"]
    terms = _terms(answers, known, grade)
    lag = units.parse(str(terms["thermal_lag"][0]), "time")
    # The die's temperature lags the air's: temperatures that it does not reach are not required.
    inset = min(math.ceil(2.0 * slope * lag) + 2.0, 0.2 * (warm - cold))
    low, high = round(cold + inset), round(warm - inset)
    coldest, warmest, ramp = (part.strip() for part in answers["chamber"].split(","))
    usable = min(known["rate"][0], 0.95 * known["full_scale"][0])
    axes = ("x",) if kind == "gyro" else ("turn",) if answers["axes"] == "1" else ("tilt", "spin")
    hand = answers["table"] == "hand"
    start, moves, fastest = (_moves if kind == "gyro" else _poses)(
        usable, known["acceleration"][0], known["travel"][0], axes, hand=hand
    )
    table = "coarse" if known["angle"][0] > units.parse("50 arcsec", "angle") else "middle"
    half, middle = round(0.5 * (warm - cold)), round(0.5 * (warm + cold))
    in_t = f'centre = "{middle} degC", scale = "{half} K"'
    what = {"gyro": "bias and scale factor in one ramp", "gyros": "three gyros", "imu": "three gyros, accelerometers"}
    course = f'temperature = ["{coldest}", "{warmest}"]\ngradient    = "{ramp}"\nsoak        = '
    course += '{ duration = "30 min", used = false }'
    if axes == ("turn",):
        course = _three_ramps(coldest, warmest, ramp)
    text = Template(presets.template("spec.toml")).substitute(
        answers,
        title=f"{answers['sensor']}: {what[kind]}",
        axes='["x"]' if kind == "gyro" else '["x", "y", "z"]',
        grade=grade,
        terms="\n".join(line for key in _TERMS for line in _written("gyro", key, *terms[key])),
        terms_of_gyro="\n".join(line for key in _TERMS_OF_GYRO for line in _written("gyro", key, *terms[key])),
        bias_prior=_shapes("[[sensor.gyro.bias.shape]]", answers["sheet"], "deg/s", half, 4) if known["sheet"] else "",
        in_t=in_t,
        fastest=_deg(fastest),
        other_sensors="" if kind == "gyro" else _other_sensors(answers, grade, in_t, half, mounted=axes == ("turn",)),
        rig=_rig(answers, axes, table, hand=hand),
        coldest=coldest,
        warmest=warmest,
        ramp=ramp,
        control='control     = "none"                   # by the clock; the temperature is recorded as it comes\n'
        if answers["makes"] == "none"
        else "",
        requirements=_requirements(answers, f'["{low} degC", "{high} degC"]', _deg(fastest)),
        course=course,
        start=start,
        moves="\n".join(f"  {move}," for move in moves),
        design=_DESIGN if kind == "gyro" else "",
    )
    return text, axes


_DESIGN: Final = """
[design]                               # what `gradcal optimise` may change, and what for
minimise = "scale factor"
free     = ["duration", "peak_rate"]
starts   = 4
"""


def not_asked(answers: Answers, known: Known) -> list[tuple[str, str, str]]:
    """What no question asked, and so stands with a typical figure: key, figure, source."""
    terms = _terms(answers, known, str(known["grade"][0]))
    return [(key, _short(value), source) for key, (value, source) in terms.items() if source != _SHEET]


_SHEET: Final = "data sheet, as answered"


def _terms(answers: Answers, known: Known, grade: str) -> dict[str, tuple[Any, str]]:
    """The terms of the gyros' error budget, those of the data sheet in the place of typical ones, and their sources."""
    terms: dict[str, tuple[Any, str]] = {t.key: (t.value, t.source) for t in terms_of("sensor", grade)}
    if known["sheet"]:
        _, bias_slope, scale_slope = (part.strip() for part in answers["sheet"].split(","))
        of_class = terms["temperature_error"][0]
        slopes = {"bias_slope": bias_slope, "scale_factor_slope": scale_slope}
        terms["temperature_error"] = {**of_class, **slopes}, "slopes: data sheet, as answered; error: estimate"
    if known["turn_on"]:
        terms["turn_on_bias"] = answers["turn_on"].strip(), _SHEET
    return terms


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_short(one) for one in cast("list[Any]", value))
    return ", ".join(cast("Mapping[str, str]", value).values()) if isinstance(value, Mapping) else str(value)


def _shapes(head: str, sheet: str, unit: str, half: float, size: int) -> str:
    """The prior of a map as the sheet has it: its offset, and powers of the temperature by its slope."""
    offset, slope = (part.strip() for part in sheet.split(",")[:2])
    dimension = {
        "deg/s": ("angular rate", "bias slope"),
        "mg": ("acceleration", "acceleration slope"),
        "ppm": ("scale factor", "scale factor slope"),
    }[unit]
    one = units.parse(f"1 {unit}", dimension[0])
    sizes = [units.parse(offset, dimension[0]) / one]
    sizes += [half * units.parse(slope, dimension[1]) / one / power for power in range(1, size)]
    rows = [", ".join(f'"{value if k == j else 0:.4g} {unit}"' for j in range(size)) for k, value in enumerate(sizes)]
    comments = ["of the sheet", "of the sheet", *["estimate, from the slope of the sheet"] * (size - 2)]
    return "".join(f"{head}\ncoefficients = [{row}]   # {why}\n" for row, why in zip(rows, comments, strict=True))


def _other_sensors(answers: Answers, grade: str, in_t: str, half: float, *, mounted: bool) -> str:
    """Cross-axis terms of the gyros, the accelerometers, and the frame."""
    misalignment, of_force, scale = _PRIORS[grade]
    lines = [
        "[sensor.gyro.misalignment]",
        f'prior       = "{misalignment}"   # estimate',
        *(
            []
            if answers["kind"] != "imu"
            else ["[sensor.gyro.g_sensitivity]", f'prior       = "{of_force}"   # estimate']
        ),
    ]
    if answers["kind"] == "imu":
        walk, sheet = answers["force"].split(",", 1)
        of = {t.key: t for t in terms_of("accelerometer", grade)}
        lines += [
            "[sensor.accelerometer]",
            f'velocity_random_walk = "{walk.strip()}"',
            *_written("accelerometer", "turn_on_bias", *of["turn_on_bias"][1:]),
            f'misalignment = {{ prior = "{misalignment}" }}   # estimate',
            *_written("accelerometer", "drift", *of["drift"][1:]),
            "[sensor.accelerometer.bias]",
            f'temperature = {{ basis = "polynomial", degree = 2, {in_t} }}',
            _shapes("[[sensor.accelerometer.bias.shape]]", sheet, "mg", half, 3)
            + f'[sensor.accelerometer.scale_factor]\ntemperature = {{ basis = "polynomial", degree = 1, {in_t} }}',
            _shapes("[[sensor.accelerometer.scale_factor.shape]]", scale, "ppm", half, 2)
            .rstrip("\n")
            .replace("of the sheet", "estimate"),
        ]
    return "\n".join([*lines, *(["[sensor.frame]", 'fixed_by = "case"'] if mounted else [])]) + "\n"


def _rig(answers: Answers, axes: tuple[str, ...], table: str, *, hand: bool) -> str:
    of = {term.key: term for term in terms_of("table", table)}
    accuracy = f'accuracy = "{of["mounting_accuracy"].value}"'
    by_hand = (
        '\ndrive    = "hand"\nanswer_time = "4 s"                    # to read each request, and to type the angle'
    )
    if axes == ("x",):
        text = '[rig.site]\nlatitude = "unknown"                   # where the table stands, if its axis points up\n'
        text += '[rig.table]\nstanding = "read"                      # the angle is what its readings say, also at rest'
        text += by_hand * hand
        text += f'\nmounting = [{{ x = "+z", y = "+x", z = "+y", {accuracy} }}]   # the gyro along the table\'s axis\n'
    else:
        gravity = _normal_gravity(units.parse(answers["latitude"], "angle"))
        text = f'[rig.site]\nlatitude = "{answers["latitude"].strip()}"\n'
        text += f'gravity  = "{gravity:.4f} m/s^2"            # by the formula of the ellipsoid, at sea level\n'
        text += 'gravity_accuracy = "200 ug"             # some hundred metres of altitude\n'
        text += "[rig.table]" + by_hand * hand + "\n"
        text += _table_line(of, "tilt") + _table_line(of, "azimuth")
        if axes == ("turn",):
            text += "# Three ramps, the IMU hung anew in between: x, y, z along the table's axis.\nmounting = [\n"
            text += "".join(
                f'  {{ name = "{own} along the axis", x = "{x}", y = "{y}", z = "{z}", {accuracy} }},\n'
                for own, x, y, z in _MOUNTINGS
            )
            text += "]\n"
    for number, name in enumerate(axes):
        up = name in ("x", "spin")
        text += f"[[rig.table.axis]]                     # {'up' if up else 'level, pointing East'}\n"
        text += f'name             = "{name}"\ndirection        = {[0.0, 0.0, 1.0] if up else [1.0, 0.0, 0.0]}\n'
        text += (
            f'max_rate         = "{answers["rate"].strip()}"\nmax_acceleration = "{answers["acceleration"].strip()}"\n'
        )
        text += f'travel           = "{answers["travel"].strip()}"         # each way, where a cable winds up\n'
        text += _table_line(of, "orthogonality") if number + 1 < len(axes) else ""
        text += "[rig.table.axis.angle]\n"
        text += 'read_every        = "rest"\n' if hand else 'read_every        = "1 s"\n' if axes == ("x",) else ""
        text += (
            f'standstill_offset = "{answers["angle"].strip()}"        # one draw each time the table comes to rest\n'
        )
        text += "".join(_table_line(of, f"angle.{key}") for key in ("reading_noise", "timing_error", "scale_error"))
        text += "harmonics = []                         # of the encoder by angle; whole turns cancel them\n"
    return text.rstrip("\n")


def _normal_gravity(latitude: float) -> float:
    """At sea level, m/s² (GRS 80)."""
    return 9.780327 * (1.0 + 0.0053024 * math.sin(latitude) ** 2 - 5.8e-6 * math.sin(2.0 * latitude) ** 2)


def _table_line(of: Mapping[str, Any], key: str) -> str:
    return f'{key.rpartition(".")[2]} = "{of[key].value}"   # {of[key].source}\n'


def _written(channel: str, key: str, value: Any, source: str) -> list[str]:
    """A term of the error budget in TOML, its source beside it."""
    if isinstance(value, str):
        return [f'{key} = "{value}"   # {source}']
    several = isinstance(value, list)
    entries = cast("list[dict[str, str]]", value if several else [value])
    lines: list[str] = []
    for entry in entries:
        head = f"[[sensor.{channel}.{key}]]" if several else f"[sensor.{channel}.{key}]"
        lines += [f"{head}   # {source}", *(f'{name} = "{figure}"' for name, figure in entry.items())]
    return lines


def _requirements(answers: Answers, box: str, fastest: str) -> str:
    kind = answers["kind"]
    scale, bias = (part.strip() for part in answers["targets"].split(","))
    gyro, axis = ("", '\naxis        = "x"') if kind == "gyro" else ("gyro ", "")
    rate = f'\nrate        = ["-{fastest} deg/s", "{fastest} deg/s"]'
    rows = [
        (f"{gyro}scale factor", "gyro_scale_factor", axis + rate, scale),
        (f"{gyro}bias", "gyro_bias", axis + '\nof          = "this run"', bias),
    ]
    if kind == "imu":
        scale, bias = (part.strip() for part in answers["force_targets"].split(","))
        rows += [
            ("accelerometer scale factor", "accelerometer_scale_factor", "", scale),
            ("accelerometer bias", "accelerometer_bias", '\nof          = "this run"', bias),
        ]
    return "".join(
        f'[[requirement]]\nname        = "{name}"\nquantity    = "{quantity}"{more}\ntemperature = {box}\n'
        f'target      = "{target}"\ncoverage    = 2\n'
        for name, quantity, more, target in rows
    )


def _three_ramps(coldest: str, warmest: str, ramp: str) -> str:
    """Up, down and up again: a ramp for each mounting."""
    items = [f'soak = "30 min", at = "{coldest}"', f'ramp_to = "{warmest}", rate = "{ramp}"', 'soak = "10 min"']
    items += [f'ramp_to = "{coldest}", rate = "{ramp}"', 'soak = "10 min"', f'ramp_to = "{warmest}", rate = "{ramp}"']
    rows = "\n".join(f"  {{ {item}{', used = false' if 'soak' in item else ''} }}," for item in items)
    return f"programme = [                          # up, down and up again: a ramp for each mounting\n{rows}\n]"


def _deg(value: float) -> str:
    return f"{math.degrees(value):.6g}"


def _moves(
    usable: float, acceleration: float, travel: float, axes: tuple[str, ...], *, hand: bool
) -> tuple[str, list[str], float]:
    """Turns there and back at three rates with a rest before each, and the fastest of the rates (rad/s)."""
    most = min(travel, 4.0 * _FULL_TURN)
    whole = math.floor(most / _FULL_TURN + 1e-9)
    angle = whole * _FULL_TURN if whole else 0.95 * most
    # The two ramps take at most half of the angle.
    fastest = min(usable, math.sqrt(0.5 * angle * acceleration))
    written = f"turns = {{}}{whole}" if whole else f'turn = "{{}}{math.degrees(angle):.4f} deg"'
    moves: list[str] = []
    for share in (1.0, 0.6, 0.3):
        for sign in ("", "-"):
            moves.append('{ rest = "5 s", read_every = "1 s" }' if not hand else '{ rest = "5 s" }')
            peak = f"{math.floor(1e3 * math.degrees(fastest) * share) / 1e3:g}"
            speed = (
                _by_hand(angle, math.radians(float(peak)), acceleration)
                if hand
                else f'peak_rate = "{peak} deg/s", shape = "linear ramps"'
            )
            moves.append(f"{{ {written.format(sign)}, {speed} }}")
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
        speed = f'peak_rate = "{peak} deg/s"'
        if hand:
            speed = _by_hand(math.radians(abs(angle)), math.radians(float(peak)), acceleration)
        return f'{{ turn = "{angle:g} deg", axis = "{axis}", {speed} }}, {{ rest = "5 s" }}'

    def there_and_back(axis: str) -> list[str]:
        return [f"{turn(axis, most, peak)}, {turn(axis, -most, peak)}" for peak in peaks]

    moves = ['{ rest = "5 s" }']
    if len(axes) == 1:
        step = round(min(45.0, most / 7.0), 1)
        moves += there_and_back(axes[0])
        moves += [turn(axes[0], step, peaks[0])] * 7 + [turn(axes[0], -7.0 * step, peaks[0])]
        start = f'start = {{ {axes[0]} = "{begin:g} deg" }}\n' if begin else ""
        return start, moves, math.radians(float(peaks[0]))

    def pose(**angles: float) -> str:
        inner = ", ".join(f'{name} = "{_within(angle, reach):g} deg"' for name, angle in angles.items())
        return f'{{ pose = {{ {inner} }}, rest = "5 s" }}'

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
    coldest, warmest, ramp = (part.strip() for part in answers["chamber"].split(","))
    scale_factor, bias = (part.strip() for part in answers["targets"].split(","))
    force_scale, force_bias = (part.strip() for part in answers["force_targets"].split(","))
    half, middle, inset = round(0.5 * (warm - cold)), round(0.5 * (warm + cold)), 0.07 * (warm - cold)
    text = presets.text("no-encoder")
    # A slower hand, or a weaker one.
    slower = max(1.0, 6.3 / known["rate"][0], math.sqrt(10.0 / known["acceleration"][0]))
    for duration in (5.0, 3.0, 1.5):
        text = text.replace(
            f'duration = "{duration:g} s"', f'duration = "{math.ceil(10.0 * duration * slower) / 10.0:g} s"'
        )
    for usual, own in (
        ("a typical consumer MEMS unit", known["sensor"][0]),
        ("0.2 deg/√h", answers["walk"]),
        ("1000 deg/s", answers["full_scale"]),
        ('latitude = "48 deg"', f'latitude = "{answers["latitude"].strip()}"'),
        ("400 deg/s", answers["rate"]),
        ("800 deg/s^2", answers["acceleration"]),
        ('centre = "25 degC", scale = "15 K"', f'centre = "{middle} degC", scale = "{half} K"'),
        ('["5 degC", "45 degC"]', f'["{coldest}", "{warmest}"]'),
        ('["12 degC", "38 degC"]', f'["{cold + inset:.0f} degC", "{warm - inset:.0f} degC"]'),
        ('"10 degC"', f'"{coldest}"'),
        ('"40 degC"', f'"{warmest}"'),
        ("8 K/min", ramp),
        ("5.5 K/min", ramp),
        ("150 ppm", scale_factor),
        ("40 deg/h", bias),
        ('target      = "1 mg"', f'target      = "{force_bias}"'),
        ("300 ppm", force_scale),
    ):
        text = text.replace(usual, str(own))
    return text
