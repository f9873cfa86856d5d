"""From ten answers to a commented spec, rig file and column map (`gradcal start`).

The error budget is that of the sensor's grade (`typical.toml`), with the source of each figure beside it; the plan is
one ramp over the chamber's range with turns at three rates, as a map of degree two in rate requires.
"""

import math
from collections.abc import Mapping
from string import Template
from typing import Any, Final, NamedTuple, cast

from gradcal_jax import units
from gradcal_jax.files import presets
from gradcal_jax.files.absent import grades, terms_of
from gradcal_jax.files.column_guess import EXAMPLE
from gradcal_jax.files.problems import instead
from gradcal_jax.files.rig import TEMPLATE

NO_ENCODER: Final = "none"


class Question(NamedTuple):
    """A question: its name, its words, and the kinds of its answers, which commas separate."""

    name: str
    asks: str
    kinds: tuple[str, ...]


QUESTIONS: Final = (
    Question("sensor", "What is the sensor called?", ("text",)),
    Question("grade", f"Of which grade is it: {', '.join(grades())}?", ("grade",)),
    Question("walk", "Its angle random walk, from the data sheet or `gradcal allan`?", ("angle random walk",)),
    Question("full_scale", "Its full scale?", ("angular rate",)),
    Question("rate", "How fast does the table turn at most?", ("angular rate",)),
    Question("acceleration", "How fast does it speed up?", ("angular acceleration",)),
    Question(
        "angle", 'By how much is its angle off where it comes to rest (or "none": nothing reads it)?', ("offset",)
    ),
    Question("travel", 'How far each way, before a cable ends it (or "unlimited")?', ("travel",)),
    Question(
        "chamber",
        "The chamber: coldest, warmest, and how fast it ramps?",
        ("temperature", "temperature", "temperature slope"),
    ),
    Question("targets", "The limits on the error: of the scale factor, of the bias?", ("scale factor", "angular rate")),
)

PRESETS: Final[Mapping[str, Mapping[str, str]]] = {
    "drone-imu": {
        "sensor": "ICM-42688 class",
        "grade": "consumer",
        "walk": "0.17 deg/sqrt(h)",
        "full_scale": "500 deg/s",
        "rate": "360 deg/s",
        "acceleration": "300 deg/s^2",
        "angle": "0.05 deg",
        "travel": "720 deg",
        "chamber": "-25 degC, 70 degC, 1 K/min",
        "targets": "1200 ppm, 120 deg/h",
    },
    "tactical-imu": {
        "sensor": "tactical MEMS",
        "grade": "tactical",
        "walk": "0.15 deg/sqrt(h)",
        "full_scale": "400 deg/s",
        "rate": "400 deg/s",
        "acceleration": "400 deg/s^2",
        "angle": "30 arcsec",
        "travel": "unlimited",
        "chamber": "-40 degC, 85 degC, 1 K/min",
        "targets": "300 ppm, 35 deg/h",
    },
    "no-encoder": {
        "sensor": "ICM-42688 class",
        "grade": "consumer",
        "walk": "0.2 deg/sqrt(h)",
        "full_scale": "1000 deg/s",
        "rate": "400 deg/s",
        "acceleration": "800 deg/s^2",
        "angle": "none",
        "travel": "unlimited",
        "chamber": "10 degC, 40 degC, 5.5 K/min",
        "targets": "150 ppm, 40 deg/h",
    },
}
"""Answers to all questions, for a class of unit and bench; the first are the defaults of the questions."""


def preset(name: str) -> dict[str, str]:
    """The answers of a preset. Errors: `ValueError` with the nearest right spelling."""
    if name not in PRESETS:
        raise ValueError(f"there is no preset '{name}' to start from: {instead(name, PRESETS)}")
    return dict(PRESETS[name])


def understood(question: Question, answer: str) -> tuple[float | str, ...]:
    """An answer in SI, one value for each kind. Errors: `ValueError` that says what was expected."""
    parts = [part.strip() for part in answer.split(",")] if len(question.kinds) > 1 else [answer.strip()]
    if len(parts) != len(question.kinds):
        raise ValueError(f"expected {len(question.kinds)} answers with commas between them, got {len(parts)}")
    return tuple(_one(kind, part) for kind, part in zip(question.kinds, parts, strict=True))


def _one(kind: str, text: str) -> float | str:
    if not text:
        raise ValueError("expected an answer")
    if kind == "text":
        if not text.isprintable() or '"' in text or "\\" in text or len(text) > 100:
            raise ValueError("expected a name of at most 100 letters, without quotes or backslashes")
        return text
    if kind == "grade":
        if text not in grades():
            raise ValueError(instead(text, grades()))
        return text
    if kind == "offset":
        if text == NO_ENCODER:
            return math.inf
        kind = "angle"
    if kind == "travel":
        if text == "unlimited":
            return math.inf
        kind = "angle"
    value = units.parse(text, kind)
    if kind != "temperature" and value <= 0.0:
        raise ValueError(f"expected more than zero, got {text}")
    return value


def files_of(answers: Mapping[str, str]) -> dict[str, str]:
    """The texts of `spec.toml`, `rig.toml` and `columns.toml`. Errors: `ValueError` that names the question."""
    known: dict[str, tuple[Any, ...]] = {}
    for question in QUESTIONS:
        try:
            known[question.name] = understood(question, answers[question.name])
        except ValueError as error:
            raise ValueError(f"{question.asks} {answers[question.name]!r}: {error}") from None
    if answers["angle"].strip() == NO_ENCODER:
        columns = EXAMPLE.replace(
            '# full_scale = "500 deg/s" ', f'full_scale = "{_deg(known["full_scale"][0])} deg/s" '
        )
        return {"spec.toml": _without_encoder(answers, known), "rig.toml": _RIG, "columns.toml": columns}
    rate, acceleration = (f"{math.degrees(known[name][0]):.6g}" for name in ("rate", "acceleration"))
    rig = TEMPLATE.replace('"300 deg/s"', f'"{rate} deg/s"').replace('"300 deg/s^2"', f'"{acceleration} deg/s^2"')
    columns = EXAMPLE.replace('# full_scale = "500 deg/s" ', f'full_scale = "{_deg(known["full_scale"][0])} deg/s" ')
    return {"spec.toml": _spec(answers, known), "rig.toml": rig, "columns.toml": columns}


def _deg(value: float) -> str:
    return f"{math.degrees(value):.6g}"


# A person turns and says that it stands; there is no chamber, and the unit's own thermometer is recorded.
_RIG: Final = """# Made by gradcal start: no encoder, no chamber. gradcal rig check FILE asks the devices.
format = "gradcal-rig/1"

[[axis]]
name    = "axle"                        # as in the spec
driver  = "operator"
port    = "terminal"
safe    = "hold"
gravity_loaded = false
options = { angle = "none", max_rate = "400 deg/s", max_acceleration = "800 deg/s^2" }

[[imu]]
name    = "unit"
driver  = "stim300"                     # or another: gradcal rig --help
port    = "/dev/ttyUSB0"
"""


def _without_encoder(answers: Mapping[str, str], known: Mapping[str, tuple[Any, ...]]) -> str:
    """The preset without an encoder, with the answers that it has a place for."""
    cold, warm, _ = cast("tuple[float, float, float]", known["chamber"])
    _require_range(cold, warm)
    coldest, warmest, ramp = (part.strip() for part in answers["chamber"].split(","))
    scale_factor, bias = (part.strip() for part in answers["targets"].split(","))
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
    ):
        text = text.replace(usual, str(own))
    return text


def _require_range(cold: float, warm: float) -> None:
    if warm - cold < 10.0:
        raise ValueError(f"{QUESTIONS[8].asks} a range of at least 10 K is wanted, and this has {warm - cold:g} K")


def _spec(answers: Mapping[str, str], known: Mapping[str, tuple[Any, ...]]) -> str:
    cold, warm, slope = cast("tuple[float, float, float]", known["chamber"])
    _require_range(cold, warm)
    grade = str(known["grade"][0])
    terms = {term.key: term for term in terms_of("sensor", grade)}
    lag = units.parse(str(terms["thermal_lag"].value), "time")
    # The die's temperature lags the air's: temperatures that it does not reach are not required.
    inset = min(math.ceil(2.0 * slope * lag) + 2.0, 0.2 * (warm - cold))
    low, high = round(cold + inset), round(warm - inset)
    usable = min(known["rate"][0], 0.95 * known["full_scale"][0])
    moves, fastest = _moves(usable, known["acceleration"][0], known["travel"][0])
    scale_factor, bias = (part.strip() for part in answers["targets"].split(","))
    coldest, warmest, ramp = (part.strip() for part in answers["chamber"].split(","))
    half, middle = round(0.5 * (warm - cold)), round(0.5 * (warm + cold))
    table = "coarse" if known["angle"][0] > units.parse("10 arcsec", "angle") * 5 else "middle"
    return Template(presets.template("spec.toml")).substitute(
        answers,
        grade=grade,
        terms="\n".join(line for key in _TERMS for line in _written(key, terms[key])),
        terms_of_gyro="\n".join(line for key in _TERMS_OF_GYRO for line in _written(key, terms[key])),
        in_t=f'centre = "{middle} degC", scale = "{half} K"',
        fastest=_deg(fastest),
        mounting_terms=_accuracy(table),
        angle_terms=_table_lines(table, "angle.reading_noise", "angle.timing_error", "angle.scale_error"),
        coldest=coldest,
        warmest=warmest,
        ramp=ramp,
        low=low,
        high=high,
        scale_factor=scale_factor,
        bias=bias,
        moves="\n".join(f"  {move}," for move in moves),
    )


# Plain keys stand above tables.
_TERMS: Final = ("thermal_lag", "sample_clock_error", "temperature_offset", "temperature_lag")
_TERMS_OF_GYRO: Final = (
    "rate_random_walk", "turn_on_bias", "drift", "scale_factor_instability", "temperature_error",
    "bias_temperature_gradient",
)  # fmt: skip


def _accuracy(table: str) -> str:
    """The mounting's accuracy for a class of table, as a further key of an inline table."""
    return "".join(f', accuracy = "{t.value}"' for t in terms_of("table", table) if t.key == "mounting_accuracy")


def _table_lines(table: str, *keys: str) -> str:
    """Terms of a class of table in TOML, each with its source beside it."""
    of = {term.key: term for term in terms_of("table", table)}
    return "\n".join(f'{key.rpartition(".")[2]} = "{of[key].value}"   # {of[key].source}' for key in keys)


def _written(key: str, term: Any) -> list[str]:
    """A term of the error budget in TOML, its source beside it."""
    if isinstance(term.value, str):
        return [f'{key} = "{term.value}"   # {term.source}']
    several = isinstance(term.value, list)
    entries = cast("list[dict[str, str]]", term.value if several else [term.value])
    lines: list[str] = []
    for entry in entries:
        head = f"[[sensor.gyro.{key}]]" if several else f"[sensor.gyro.{key}]"
        lines += [f"{head}   # {term.source}", *(f'{name} = "{value}"' for name, value in entry.items())]
    return lines


def _moves(usable: float, acceleration: float, travel: float) -> tuple[list[str], float]:
    """Turns there and back at three rates with a rest before each, and the fastest of the rates (rad/s)."""
    most = min(travel, 4.0 * 2.0 * math.pi)
    whole = math.floor(most / (2.0 * math.pi) + 1e-9)
    angle = whole * 2.0 * math.pi if whole else 0.95 * most
    # The two ramps take at most half of the angle.
    fastest = min(usable, math.sqrt(0.5 * angle * acceleration))
    written = f"turns = {{}}{whole}" if whole else f'turn = "{{}}{math.degrees(angle):.4f} deg"'
    moves: list[str] = []
    for share in (1.0, 0.6, 0.3):
        for sign in ("", "-"):
            moves.append('{ rest = "5 s", read_every = "1 s" }')
            peak = f"{math.floor(1e3 * math.degrees(fastest) * share) / 1e3:g}"
            moves.append(f'{{ {written.format(sign)}, peak_rate = "{peak} deg/s", shape = "linear ramps" }}')
    return moves, math.radians(math.floor(1e3 * math.degrees(fastest)) / 1e3)
