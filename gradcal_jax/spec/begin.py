"""From answers to a commented spec, rig file and column map (`gradcal start`).

The error budget is that of the sensor's grade (`typical.toml`), with the source of each figure beside it; the plan
turns the sensor at three rates while the chamber ramps, as a map of degree two in rate requires, and an IMU on a table
of one axis is hung three times. Questions and presets are data, `start.toml`.
"""

import math
import re
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, Final, NamedTuple

from gradcal_jax import units
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.hardware import frames, line_protocol, register_protocol
from gradcal_jax.records.column_names import EXAMPLE
from gradcal_jax.spec import presets, started_spec
from gradcal_jax.spec.typical import grades
from gradcal_jax.tables.problems import instead

TABLES: Final = ("grbl", "aerosmith-like", "hand", "none")
"""What may turn the table; "none": there is no table."""
STREAMS: Final = (*line_protocol.shipped(frames.FORMAT), "text", "own")
"""How samples reach the computer; "own": the IMU has its own logger."""


def chambers() -> tuple[str, ...]:
    """Names of descriptions of chambers; "none": there is none."""
    return (*_described_chambers(), "none")


def _described_chambers() -> dict[str, str]:
    """The chambers that are described, each with its driver."""
    lines = [
        name
        for name in line_protocol.shipped()
        if line_protocol.described(line_protocol.LineProtocol, name).role == "chamber"
    ]
    registers = line_protocol.shipped(register_protocol.FORMAT)
    return dict.fromkeys(lines, "lines") | dict.fromkeys(registers, "registers")


def rig_text(answers: Mapping[str, str], known: Mapping[str, tuple[Any, ...]], axes: tuple[str, ...]) -> str:
    """The rig file for the answers of `begin`; `axes`: names of the table's axes."""
    cold, warm, _ = known["chamber"]
    rate, acceleration = (f"{math.degrees(known[name][0]):.6g}" for name in ("rate", "acceleration"))
    values = {"of": answers, "axes": axes, "described": _described_chambers().get(answers["makes"], "")}
    values |= {"above": warm + 10.0, "below": cold - 10.0, "rate_dps": rate, "acceleration_dps2": acceleration}
    return rendered(presets.template("started-rig.toml"), values)


NO_ENCODER: Final = "none"
TYPICAL: Final = "typical"
Answers = Mapping[str, str]


class Question(NamedTuple):
    """A question: its name, its words, and the kinds of its answers, which commas separate. `after`: of what it is
    asked alone. An `optional` one takes "typical", too."""

    name: str
    asks: str
    kinds: tuple[str, ...]
    after: tuple[str, ...] = ()
    optional: bool = False

    def when(self, answers: Answers) -> bool:
        """Whether it is asked after these answers."""
        return all(_OF_ANSWERS[what](answers) for what in self.after)


def _turns(of: Answers) -> bool:
    return of["table"] != "none"


_OF_ANSWERS: Final[Mapping[str, Callable[[Answers], bool]]] = {
    "table": _turns,
    "imu": lambda of: of["kind"] == "imu",
    "several axes": lambda of: of["kind"] != "gyro",
}
_DATA: Final[dict[str, Any]] = tomllib.loads(
    (resources.files("gradcal_jax.spec") / "start.toml").read_text(encoding="utf-8")
)
QUESTIONS: Final = tuple(
    Question(
        row["name"], row["asks"], tuple(row["kinds"]), tuple(row.get("after", ())), optional=row.get("optional", False)
    )
    for row in _DATA["question"]
)


def _preset(name: str) -> dict[str, str]:
    own = dict(_DATA["preset"][name])
    return (_preset(own.pop("like")) if "like" in own else {}) | own


PRESETS: Final[Mapping[str, Answers]] = {name: _preset(name) for name in _DATA["preset"]}
"""Answers to all questions, for a sensor and a bench."""
DEFAULTS: Final[Answers] = {
    key: value
    for key, value in (PRESETS["drone-imu"] | {"sheet": TYPICAL}).items()
    if key not in ("sensor", "walk", "full_scale", "force")
}
"""The default answers, which an empty line accepts. The noise figures of a sensor have no default, because those of
another sensor would be wrong."""
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
        raise ValueError(f"there is no preset '{name}'; {instead(name, PRESETS)}")
    return dict(PRESETS[name])


def asked(question: Question) -> str:
    """The words of a question."""
    options = {"grades": grades, "tables": lambda: TABLES, "streams": lambda: STREAMS, "chambers": chambers}
    shown = {name: ", ".join(known()) for name, known in options.items() if f"{{{name}}}" in question.asks}
    return question.asks.format(**shown)


def understood(question: Question, answer: str) -> tuple[float | str, ...]:
    """An answer in SI, one value for each kind; none for "typical". Errors: `ValueError` that says what was
    expected."""
    if question.optional and answer.strip() == TYPICAL:
        return ()
    parts = [part.strip() for part in answer.split(",")] if len(question.kinds) > 1 else [answer.strip()]
    if len(parts) != len(question.kinds):
        such = ", ".join(_example(kind) for kind in question.kinds)
        raise ValueError(
            f"expected {len(question.kinds)} answers, separated by commas, such as '{such}'; got {len(parts)}"
        )
    return tuple(_one(kind, part) for kind, part in zip(question.kinds, parts, strict=True))


def _size(travel: str) -> str:
    """A travel without its signs: of "±170 deg" the "170 deg"."""
    return re.sub(r"^\s*(±|\+/?-)\s*", "", travel)


def _example(kind: str) -> str:
    """An answer of the right form."""
    return units.DIMENSIONS[kind].example


def _one(kind: str, text: str) -> float | str:
    if not text:
        such = f" such as '{_example(kind)}'" if kind in units.DIMENSIONS else ""
        raise ValueError(f"expected an answer{such}")
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
    value = units.parse(_size(text) if kind == "travel" else text, "angle" if kind in ("offset", "travel") else kind)
    if kind not in ("temperature", "angle") and value <= 0.0:
        raise ValueError(f"expected more than zero, got {text}")
    return value


def files_of(answers: Answers) -> dict[str, str]:
    """The texts of `spec.toml`, `rig.toml` and `columns.toml`; without a table of the last alone. Errors: `ValueError`
    that names the question."""
    known = _known(answers)
    _refuse_impossible(answers, known)
    answers = {**answers, "travel": _size(answers["travel"])} if "travel" in answers else answers
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
            raise ValueError(
                "without a table, only an IMU with accelerometers can be calibrated, with gravity as the reference"
            )
        return
    cold, warm, _ = known["chamber"]
    if warm - cold < 10.0:
        asks = next(q.asks for q in QUESTIONS if q.name == "chamber")
        raise ValueError(f"{asks} The range must be at least 10 K, and this one has {warm - cold:g} K")
    if math.isinf(known["angle"][0]) and kind != "imu":
        raise ValueError(
            'without an encoder, the angles come from the accelerometers of an IMU: answer "imu" to "What '
            "is calibrated\", or state the error of the table's angle"
        )
    if kind != "gyro" and axes == "2" and table == "hand":
        raise ValueError("for a gimbal that is turned by hand: gradcal start gimbal-by-hand -o spec.toml")
