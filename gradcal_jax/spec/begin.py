"""From answers to a commented spec, rig file and column map (`gradcal start`).

The error budget is that of the sensor's grade (`typical.toml`), with the source of each figure beside it; the plan
turns the sensor at three rates while the chamber ramps, as a map of degree two in rate requires, and an IMU on a table
of one axis is hung three times. Questions and presets are data, `start.toml`.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any, Final, NamedTuple

from gradcal_jax import units
from gradcal_jax.calibration.text_template import rendered
from gradcal_jax.hardware.description import described, shipped
from gradcal_jax.hardware.frames import FRAMES
from gradcal_jax.hardware.line_protocol import LINES, LineProtocol
from gradcal_jax.hardware.register_protocol import REGISTERS
from gradcal_jax.records.column_names import EXAMPLE
from gradcal_jax.spec import presets, started_spec
from gradcal_jax.spec.typical import grades
from gradcal_jax.tables.problems import instead

TYPICAL: Final = "typical"
Answers = Mapping[str, str]
Known = Mapping[str, tuple[Any, ...]]
_DATA: Final[dict[str, Any]] = tomllib.loads(
    (resources.files("gradcal_jax.spec") / "start.toml").read_text(encoding="utf-8")
)


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
        holds = {
            "table": answers["table"] != "none",
            "imu": answers["kind"] == "imu",
            "several axes": answers["kind"] != "gyro",
        }
        return all(holds[what] for what in self.after)


QUESTIONS: Final = tuple(Question(**row) for row in _DATA["question"])


def preset(name: str) -> dict[str, str]:
    """The answers of a preset. Errors: `ValueError` with the nearest right spelling."""
    if name not in _DATA["preset"]:
        raise ValueError(f"there is no preset '{name}'; {instead(name, _DATA['preset'])}")
    own = dict(_DATA["preset"][name])
    return (preset(own.pop("like")) if "like" in own else {}) | own


PRESETS: Final[Mapping[str, Answers]] = {name: preset(name) for name in _DATA["preset"]}
"""Answers to all questions, for a sensor and a bench."""
DEFAULTS: Final[Answers] = {
    key: value
    for key, value in (PRESETS["drone-imu"] | {"sheet": TYPICAL}).items()
    if key not in ("sensor", "walk", "full_scale", "force")
}
"""The default answers, which an empty line accepts. The noise figures of a sensor have no default, because those of
another sensor would be wrong."""


def _described_chambers() -> dict[str, str]:
    """The chambers that are described, each with its driver."""
    lines = [name for name in shipped(LINES) if described(LineProtocol, name).role == "chamber"]
    return dict.fromkeys(lines, "lines") | dict.fromkeys(shipped(REGISTERS), "registers")


_CHOICES: Final[Mapping[str, Callable[[], tuple[str, ...]]]] = {
    "grade": grades,
    "kind": lambda: ("gyro", "gyros", "imu"),
    "stream": lambda: (*shipped(FRAMES), "text", "own"),
    "table": lambda: ("grbl", "aerosmith-like", "none"),
    "axes": lambda: ("1", "2"),
    "chamber": lambda: (*_described_chambers(), "none"),
}


def asked(question: Question) -> str:
    """The words of a question."""
    listed = {kind: ", ".join(_CHOICES[kind]()) for kind in question.kinds if kind in _CHOICES}
    return question.asks.format(**listed)


def understood(question: Question, answer: str) -> tuple[float | str, ...]:
    """An answer in SI, one value for each kind; none for "typical". Errors: `ValueError` that says what was
    expected."""
    if question.optional and answer.strip() == TYPICAL:
        return ()
    kinds = question.kinds
    parts = [part.strip() for part in answer.split(",")] if len(kinds) > 1 else [answer.strip()]
    if len(parts) != len(kinds):
        such = ", ".join(units.DIMENSIONS[kind].example for kind in kinds)
        raise ValueError(f"expected {len(kinds)} answers, separated by commas, such as '{such}'; got {len(parts)}")
    return tuple(_one(kind, part) for kind, part in zip(kinds, parts, strict=True))


def _one(kind: str, text: str) -> float | str:
    if not text:
        such = f" such as '{units.DIMENSIONS[kind].example}'" if kind in units.DIMENSIONS else ""
        raise ValueError(f"expected an answer{such}")
    if kind == "text":
        if not text.isprintable() or '"' in text or "\\" in text or len(text) > 100:
            raise ValueError("expected a name of at most 100 letters, without quotes or backslashes")
        return text
    if kind in _CHOICES:
        if text not in (choices := _CHOICES[kind]()):
            raise ValueError(instead(text, choices))
        return text
    if (kind, text) == ("travel", "unlimited"):
        return math.inf
    value = units.parse(text, "angle" if kind in ("travel", "offset") else kind)
    if kind not in ("temperature", "angle") and value <= 0.0:
        raise ValueError(f"expected more than zero, got {text}")
    return value


def files_of(answers: Answers) -> dict[str, str]:
    """The texts of `spec.toml`, `rig.toml` and `columns.toml`; without a table of the last alone. Errors: `ValueError`
    that names the question."""
    if answers["table"] == "none":
        if answers["kind"] != "imu":
            raise ValueError(
                "without a table, only an IMU with accelerometers can be calibrated, with gravity as the reference"
            )
        return {"columns.toml": EXAMPLE}
    known = _known(answers)
    if "spec" in answers:
        text, axes = presets.text(answers["spec"]), ("axle",)
    else:
        text, axes = started_spec.spec_text(answers, known)
    return {"spec.toml": text, "rig.toml": _rig_text(answers, known, axes), "columns.toml": EXAMPLE}


def _known(answers: Answers) -> dict[str, tuple[Any, ...]]:
    known: dict[str, tuple[Any, ...]] = {}
    for question in QUESTIONS:
        if not question.when(answers) or ("spec" in answers and question.name in ("table", "angle")):
            continue
        try:
            known[question.name] = understood(question, answers[question.name])
            cold, warm, *_ = known.get("chamber", (0.0, 100.0))
            if warm - cold < 10.0:
                raise ValueError("the range must be at least 10 K")
        except ValueError as error:
            raise ValueError(f"{asked(question)} {answers[question.name]!r}: {error}") from None
    return known


def _rig_text(answers: Answers, known: Known, axes: tuple[str, ...]) -> str:
    """The rig file; `axes`: names of the table's axes."""
    cold, warm, _ = known["chamber"]
    rate, acceleration = (f"{math.degrees(known[name][0]):.6g}" for name in ("rate", "acceleration"))
    values = {"of": answers, "axes": axes, "described": _described_chambers().get(answers["makes"], "")}
    values |= {"above": warm + 10.0, "below": cold - 10.0, "rate_dps": rate, "acceleration_dps2": acceleration}
    return rendered(presets.template("started-rig.toml"), values)
