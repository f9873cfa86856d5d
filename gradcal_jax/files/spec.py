"""gradcal-spec/1: sensor, rig, requirements, plan; the input of every command."""

import contextlib
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast

from pydantic import Field, TypeAdapter, ValidationError

from gradcal_jax.files.bench import Rig
from gradcal_jax.files.checks import between_sections
from gradcal_jax.files.design import Design
from gradcal_jax.files.document import TitledFile, from_text, model_of, read_text
from gradcal_jax.files.mission import missions_from
from gradcal_jax.files.plan import GradientPlan, Plan, StandardPlan
from gradcal_jax.files.problems import Problem, SpecError
from gradcal_jax.files.quantity import SizeOfTime, Text, Time
from gradcal_jax.files.requirement import Requirement
from gradcal_jax.files.schedule import GradientSchedule, Schedule, gradient_schedule, standard_schedule
from gradcal_jax.files.section import Section
from gradcal_jax.files.sensor import Sensor

FORMAT: Final = "gradcal-spec/1"
Requirements = Annotated[tuple[Requirement, ...], Field(max_length=100)]


class Done(Section):
    """The executed part of a plan before a run was broken off; `[[done]]`, which `gradcal replan` writes."""

    plan: GradientPlan
    """The plan that was executed then."""
    start: SizeOfTime
    """Its beginning, on that plan's clock."""
    end: Time
    """Until when."""
    pause: Time
    """Time until the next part or the plan begins; the unit stays switched on."""


class Spec(TitledFile):
    """A whole spec: sensor, rig, requirements, plan, and what `optimise` may change; read-only.

    Quantities behave as numbers in SI (°C for temperatures) and keep their text. `schedule` is the plan resolved for
    the rig. From `read_spec` or `parse_spec`, or from another by `changed`. Errors: `SpecError` by those.
    """

    format: Literal["gradcal-spec/1"]
    title: Text | None = None
    """A name for people; it heads tables and pages."""
    sensor: Sensor
    """The gyro axis that is calibrated."""
    rig: Rig
    """Table and chamber."""
    requirement: Requirements = ()
    """Requirements on the calibration."""
    plan: Plan
    """Course of the chamber, motion of the table, and readings of the axis."""
    done: Annotated[tuple[Done, ...], Field(max_length=1000)] = ()
    """The parts executed before the plan begins, in the same run; every prediction includes them."""
    design: Design | None = None
    """What `optimise` may change; no other command reads it."""

    def _problems(self) -> Iterator[Problem]:
        yield from between_sections(self.sensor, self.rig, self.requirement, self.plan, self.design)
        if self.done and isinstance(self.plan, StandardPlan):
            yield Problem(("done",), 'what was done counts beside a plan of method = "gradient" alone')
        for number, part in enumerate(self.done):
            for problem in between_sections(self.sensor, self.rig, None, part.plan, None):
                yield problem.under("done", number)
            if part.end <= part.start:
                yield Problem(("done", number, "end"), "expected a time after its start", part.end.text)

    @cached_property
    def schedule(self) -> Schedule:
        """The plan in SI: `GradientSchedule` or `StandardSchedule`."""
        if isinstance(self.plan, StandardPlan):
            return standard_schedule(self.plan)
        return gradient_schedule(self.plan, self.rig)

    @property
    def gradient_schedule(self) -> GradientSchedule:
        """The schedule of a gradient plan. Raises `ValueError` for a standard one."""
        if not isinstance(self.schedule, GradientSchedule):
            raise ValueError('this needs a plan of method = "gradient"')
        return self.schedule


_SECTIONS: Final[Mapping[str, TypeAdapter[Any]]] = {
    "sensor": TypeAdapter(Sensor),
    "rig": TypeAdapter(Rig),
    "requirement": TypeAdapter(Requirements),
    "plan": TypeAdapter(Plan),
    "design": TypeAdapter(Design),
}


def expect_spec(value: object) -> Spec:
    """The value, if it is a spec. Errors: `TypeError` that says how to read one."""
    if isinstance(value, Spec):
        return value
    if isinstance(value, str | Path):
        raise TypeError(f"expected a spec, not the name of its file: read it with gj.read_spec({str(value)!r})")
    raise TypeError(f"expected a spec as gj.read_spec or gj.parse_spec give it, not {type(value).__name__}")


def expect_whole(spec: Spec, what: str) -> None:
    """Errors: `ValueError` where a plan continues an executed part, which `what` does not support."""
    if expect_spec(spec).done:
        raise goes_on(what)


def goes_on(what: str) -> ValueError:
    """The message where a plan continues an executed part, which `what` does not support."""
    return ValueError(f"{what} is of a plan that begins a run, and this one goes on with what was done: [[done]]")


def read_spec(path: str | Path) -> Spec:
    """Read a spec file: TOML, quantities as text with units ("0.1 deg/sqrt(h)"), SI (°C) inside.

    Names of mission files are seen from the spec's folder. Errors: `SpecError` that lists everything wrong with it,
    each with its key and what was expected.
    """
    with missions_from(Path(path).parent):
        return parse_spec(read_text(path), str(path))


def parse_spec(text: str, source: str = "") -> Spec:
    """A spec from the text of a TOML file (quantities with units, SI inside); `source` names it in messages. Names of
    mission files are seen from the working directory.

    Errors: `SpecError`, as `read_spec`.
    """
    return from_text(spec_of, text, source)


def spec_of(document: Mapping[str, Any], source: str = "") -> Spec:
    """A spec from tables as TOML gives them. Raises `SpecError` that lists everything wrong."""

    def further(problems: list[Problem]) -> list[Problem]:
        if is_of_unit(document):
            raise of_one_axis(source)
        return _still_visible(document, problems)

    return model_of(Spec, document, FORMAT, source, further)


def of_one_axis(source: str = "") -> SpecError:
    """The message for the spec of a whole unit in place of one axis's."""
    message = "is of a whole unit (gyros, accelerometers); this serves one gyro axis alone"
    return SpecError([Problem(("sensor",), message)], source)


def is_of_unit(document: Mapping[str, Any]) -> bool:
    """Whether the tables are the spec of a whole unit: with [sensor.gyro] or [sensor.accelerometer]."""
    sensor = document.get("sensor")
    return isinstance(sensor, Mapping) and ("gyro" in sensor or "accelerometer" in sensor)


def _still_visible(document: Mapping[str, Any], problems: list[Problem]) -> list[Problem]:
    """Problems between the sections that could be read by themselves, when another section could not."""
    sections: dict[str, Any] = dict.fromkeys(_SECTIONS)
    pruned = {"requirement": (), **_without_unknown_keys(document, problems)}
    for name in _SECTIONS.keys() & pruned.keys():
        with contextlib.suppress(ValidationError):
            sections[name] = _SECTIONS[name].validate_python(pruned[name])
    between = between_sections(*sections.values())
    reported = {problem.key for problem in problems}
    return [problem for problem in between if problem.key not in reported]


def _without_unknown_keys(document: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """The document less its unknown keys; a section with a likely slip for a known key is left out whole."""
    unknown = {problem.key for problem in problems if problem.kind == "unknown"}
    slips = {problem.key[0] for problem in problems if problem.kind == "unknown" and "nearest" in problem.message}
    kept = {name: value for name, value in document.items() if name not in slips}
    return cast("dict[str, Any]", _pruned(kept, (), unknown))


def _pruned(value: object, key: tuple[str | int, ...], unknown: set[tuple[str | int, ...]]) -> object:
    if isinstance(value, Mapping):
        table = cast("Mapping[str, object]", value)
        return {
            name: _pruned(entry, (*key, name), unknown) for name, entry in table.items() if (*key, name) not in unknown
        }
    if isinstance(value, list):
        return [_pruned(entry, (*key, i), unknown) for i, entry in enumerate(cast("list[object]", value))]
    return value
