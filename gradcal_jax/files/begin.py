"""From answers to a commented spec, rig file and column map (`gradcal start`).

The error budget is that of the sensor's grade (`typical.toml`), with the source of each figure beside it; the plan
turns the sensor at three rates while the chamber ramps, as a map of degree two in rate requires, and an IMU on a table
of one axis is hung three times.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from gradcal_jax import units
from gradcal_jax.display import columns
from gradcal_jax.files import started_spec
from gradcal_jax.files.absent import grades
from gradcal_jax.files.column_guess import EXAMPLE
from gradcal_jax.files.problems import instead
from gradcal_jax.files.started_rig import STREAMS, TABLES, chambers, rig_text

NO_ENCODER: Final = "none"
TYPICAL: Final = "typical"
Answers = Mapping[str, str]


class Question(NamedTuple):
    """A question: its name, its words, and the kinds of its answers, which commas separate. `when`: whether it is asked
    after these answers. An `optional` one takes "typical", too."""

    name: str
    asks: str
    kinds: tuple[str, ...]
    when: Callable[[Answers], bool] = lambda _: True
    optional: bool = False


def _turns(of: Answers) -> bool:
    return of["table"] != "none"


def _is_imu(of: Answers) -> bool:
    return of["kind"] == "imu"


def _turns_several(of: Answers) -> bool:
    return of["kind"] != "gyro" and _turns(of)


def _turns_imu(of: Answers) -> bool:
    return _is_imu(of) and _turns(of)


QUESTIONS: Final = (
    Question("sensor", "What is the sensor called?", ("text",)),
    Question("kind", "What is calibrated: gyro (one axis), gyros (x, y, z), imu (with accelerometers)?", ("kind",)),
    Question("grade", f"Of which grade is it: {', '.join(grades())}?", ("grade",)),
    Question("walk", "Its gyros' angle random walk, from the data sheet or `gradcal allan`?", ("angle random walk",)),
    Question("full_scale", "Their full scale?", ("angular rate",)),
    Question(
        "sheet",
        'From the sheet: zero-rate offset, its and the scale factor\'s change with temperature (or "typical")?',
        ("angular rate", "bias slope", "scale factor slope"),
        optional=True,
    ),
    Question(
        "turn_on", 'By how much does the bias differ at the next power-on (or "typical")?', ("angular rate",),
        optional=True,
    ),
    Question(
        "force",
        "The accelerometers' velocity random walk, zero-g offset, and its change with temperature?",
        ("velocity random walk", "acceleration", "acceleration slope"),
        _is_imu,
    ),
    Question("stream", "How do samples come: stim300, vectornav, text (lines), own (it logs by itself)?", ("stream",)),
    Question("table", f"What turns the table: {', '.join(TABLES)}?", ("table",)),
    Question("axes", "How many axes has it: 1 or 2?", ("axes",), _turns_several),
    Question("rate", "How fast does it turn at most?", ("angular rate",), _turns),
    Question("acceleration", "How fast does it speed up?", ("angular acceleration",), _turns),
    Question(
        "angle",
        'By how much is its angle off where it comes to rest (or "none": nothing reads it)?',
        ("offset",),
        _turns,
    ),
    Question("travel", 'How far each way, before a cable ends it, as "170 deg" (or "unlimited")?', ("travel",), _turns),
    Question("latitude", "At which latitude is it?", ("angle",), _turns_several),
    Question("makes", "What makes the temperature: {chambers}?", ("chamber",), _turns),
    Question(
        "chamber",
        "From which temperature to which, and how fast does it ramp?",
        ("temperature", "temperature", "temperature slope"),
        _turns,
    ),
    Question(
        "targets",
        "The limits on the error: of the gyros' scale factor and bias?",
        ("scale factor", "angular rate"),
        _turns,
    ),
    Question(
        "force_targets",
        "And of the accelerometers' scale factor and bias?",
        ("scale factor", "acceleration"),
        _turns_imu,
    ),
)  # fmt: skip

_DRONE: Final = {
    "sensor": "ICM-42688 class",
    "kind": "imu",
    "grade": "consumer",
    "walk": "0.17 deg/sqrt(h)",
    "full_scale": "500 deg/s",
    "sheet": "0.5 deg/s, 0.005 deg/s/K, 50 ppm/K",
    "turn_on": TYPICAL,
    "force": "0.042 m/s/sqrt(h), 20 mg, 0.15 mg/K",
    "stream": "own",
    "table": "grbl",
    "axes": "1",
    "rate": "360 deg/s",
    "acceleration": "300 deg/s^2",
    "angle": "0.05 deg",
    "travel": "720 deg",
    "latitude": "48 deg",
    "makes": "espec",
    "chamber": "-25 degC, 70 degC, 1 K/min",
    "targets": "1200 ppm, 200 deg/h",
    "force_targets": "1000 ppm, 4 mg",
}
_TACTICAL: Final = _DRONE | {
    "sensor": "tactical MEMS",
    "grade": "tactical",
    "walk": "0.15 deg/sqrt(h)",
    "full_scale": "400 deg/s",
    "sheet": TYPICAL,
    "force": "0.07 m/s/sqrt(h), 5 mg, 0.05 mg/K",
    "stream": "stim300",
    "table": "zaber",
    "axes": "2",
    "rate": "400 deg/s",
    "acceleration": "400 deg/s^2",
    "angle": "30 arcsec",
    "travel": "unlimited",
    "makes": "weiss",
    "chamber": "-40 degC, 85 degC, 1 K/min",
    "targets": "300 ppm, 35 deg/h",
    "force_targets": "500 ppm, 1 mg",
}
PRESETS: Final[Mapping[str, Answers]] = {
    "drone-imu": _DRONE,
    "bmi088": _DRONE
    | {
        "sensor": "BMI088",
        "walk": "0.84 deg/sqrt(h)",
        "sheet": "1 deg/s, 0.015 deg/s/K, 300 ppm/K",
        "force": "0.103 m/s/sqrt(h), 20 mg, 0.2 mg/K",
        "stream": "text",
        "travel": "170 deg",
        "makes": "none",
        "chamber": "0 degC, 50 degC, 1 K/min",
        "targets": "2000 ppm, 300 deg/h",
    },
    "tactical-imu": _TACTICAL,
    "drone-gyro": _DRONE | {"kind": "gyro", "sheet": TYPICAL, "targets": "1200 ppm, 120 deg/h"},
    "tactical-gyro": _TACTICAL | {"kind": "gyro"},
    "no-encoder": _DRONE
    | {
        "walk": "0.2 deg/sqrt(h)",
        "full_scale": "1000 deg/s",
        "stream": "stim300",
        "table": "hand",
        "rate": "400 deg/s",
        "acceleration": "800 deg/s^2",
        "angle": "none",
        "travel": "unlimited",
        "makes": "none",
        "chamber": "10 degC, 40 degC, 5.5 K/min",
        "targets": "150 ppm, 40 deg/h",
        "force_targets": "300 ppm, 1 mg",
    },
}
"""Answers to all questions, for a sensor and a bench."""
DEFAULTS: Final[Answers] = {k: v for k, v in _DRONE.items() if k not in ("sensor", "walk", "full_scale", "force")} | {
    "sheet": TYPICAL
}
"""What an empty line answers; the figures of a sensor have no default, since those of another one would be wrong."""
_CHOICES: Final[Mapping[str, Callable[[], tuple[str, ...]]]] = {
    "grade": grades,
    "kind": lambda: ("gyro", "gyros", "imu"),
    "stream": lambda: STREAMS,
    "table": lambda: TABLES,
    "axes": lambda: ("1", "2"),
    "chamber": chambers,
}


def preset(name: str) -> dict[str, str]:
    """The answers of a preset. Errors: `ValueError` with the nearest right spelling."""
    if name not in PRESETS:
        raise ValueError(f"there is no preset '{name}' to start from: {instead(name, PRESETS)}")
    return dict(PRESETS[name])


def asked(question: Question) -> str:
    """The words of a question."""
    return question.asks.format(chambers=", ".join(chambers())) if "{chambers}" in question.asks else question.asks


def understood(question: Question, answer: str) -> tuple[float | str, ...]:
    """An answer in SI, one value for each kind; none for "typical". Errors: `ValueError` that says what was
    expected."""
    if question.optional and answer.strip() == TYPICAL:
        return ()
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
    if kind in _CHOICES:
        if text not in (choices := _CHOICES[kind]()):
            raise ValueError(instead(text, choices))
        return text
    if (kind, text) in (("offset", NO_ENCODER), ("travel", "unlimited")):
        return math.inf
    value = units.parse(text, "angle" if kind in ("offset", "travel") else kind)
    if kind not in ("temperature", "angle") and value <= 0.0:
        raise ValueError(f"expected more than zero, got {text}")
    return value


def files_of(answers: Answers) -> dict[str, str]:
    """The texts of `spec.toml`, `rig.toml` and `columns.toml`; without a table of the last alone. Errors: `ValueError`
    that names the question."""
    known = _known(answers)
    _refuse_impossible(answers, known)
    full_scale = f'full_scale = "{math.degrees(known["full_scale"][0]):.6g} deg/s" '
    map_text = EXAMPLE.replace('# full_scale = "500 deg/s" ', full_scale)
    if answers["kind"] == "imu":
        commented = map_text[map_text.index("# [force]") : map_text.index("# [table_angle]")]
        force = "".join(f'{axis} = {{ column = "a{axis}", unit = "m/s^2" }}\n' for axis in "xyz")
        map_text = map_text.replace(commented, f"{commented[2:].splitlines()[0]}\n{force}\n")
    if not _turns(answers):
        return {"columns.toml": map_text}
    text, axes = started_spec.without_encoder(answers, known), ("axle",)
    if answers["angle"].strip() != NO_ENCODER:
        text, axes = started_spec.spec_text(answers, known)
    return {"spec.toml": text, "rig.toml": rig_text(answers, known, axes), "columns.toml": map_text}


def typical_terms(answers: Answers) -> list[str]:
    """Lines on the error terms that no question asked: key, typical figure, source."""
    if not _turns(answers) or answers["angle"].strip() == NO_ENCODER:
        return []
    rows = started_spec.not_asked(answers, _known(answers))
    return columns(rows, indent="", width=118).splitlines()


def _known(answers: Answers) -> dict[str, tuple[Any, ...]]:
    known: dict[str, tuple[Any, ...]] = {}
    for question in QUESTIONS:
        if not question.when(answers):
            continue
        try:
            known[question.name] = understood(question, answers[question.name])
        except ValueError as error:
            raise ValueError(f"{asked(question)} {answers[question.name]!r}: {error}") from None
    return known


def _refuse_impossible(answers: Answers, known: Mapping[str, tuple[Any, ...]]) -> None:
    kind, table, axes = answers["kind"], answers["table"], answers.get("axes", "1")
    if not _turns(answers):
        if kind != "imu":
            raise ValueError("without a table only an IMU with accelerometers is calibrated, by gravity alone")
        return
    cold, warm, _ = known["chamber"]
    if warm - cold < 10.0:
        asks = next(q.asks for q in QUESTIONS if q.name == "chamber")
        raise ValueError(f"{asks} a range of at least 10 K is needed, and this has {warm - cold:g} K")
    if math.isinf(known["angle"][0]) and kind != "imu":
        raise ValueError("without an encoder the accelerometers of an IMU tell the angles: answer imu, or an angle")
    if table == "switch" and not math.isinf(known["angle"][0]):
        raise ValueError('a motor that is only switched reports no angle: answer "none" for its angle')
    if kind != "gyro" and axes == "2" and table not in ("zaber", "odrive"):
        presets_of = {"hand": "; a gimbal that is turned by hand: gradcal new gimbal-by-hand"}
        raise ValueError(
            f"tables of two axes are started with zaber or odrive, not with {table}{presets_of.get(table, '')}"
        )
