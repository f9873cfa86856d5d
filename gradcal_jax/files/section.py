"""The base of every table in a file: frozen, closed to unknown keys, and plain-spoken about what is wrong."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from gradcal_jax.files.problems import Problem, SpecError, from_validation, nearest, one_of


class Section(BaseModel):
    """A table of a file. Unknown keys are refused with the nearest right spelling."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=False)

    # Plain types: the tests check annotations function by function, where Self means nothing.
    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            return handler(value)
        except ValidationError as error:
            raise SpecError(with_spelling(from_validation(error), cls, value)) from None


def with_spelling(problems: Sequence[Problem], model: type[BaseModel], value: object) -> list[Problem]:
    """Add the nearest right spelling to unknown keys, and drop "missing" where a misspelt key stands for it."""
    known = list(model.model_fields)
    present = set(cast("Mapping[str, object]", value)) if isinstance(value, Mapping) else set[str]()
    meant: set[str] = set()
    spelt: list[Problem] = []
    for problem in problems:
        if problem.kind == "unknown" and len(problem.key) == 1:
            free = [name for name in known if name not in present]
            close = nearest(str(problem.key[0]), free) or nearest(str(problem.key[0]), known)
            if close is not None:
                meant.add(close)
                ending = f'; nearest: "{close}"'
            else:
                ending = f"; known here: {', '.join(known)}"
            problem = Problem(problem.key, "this key is unknown" + ending, problem.value, "unknown")
        spelt.append(problem)
    return [p for p in spelt if not (p.kind == "missing" and len(p.key) == 1 and p.key[0] in meant)]


def choose(value: object, key: str, classes: Mapping[str, type[Section]]) -> object:
    """The table read by the class that its `key` names: the before-validator of a field that holds one of several."""
    if isinstance(value, Section):
        return value
    table = a_table(value)
    if key not in table:
        misspelt = next((name for name in table if nearest(name, [key]) == key), None)
        if misspelt is not None:
            unknown = Problem((misspelt,), f'this key is unknown; nearest: "{key}"', table[misspelt], "unknown")
            raise SpecError([unknown])
        raise SpecError([Problem((key,), f"this key is missing; expected {one_of(classes)}", kind="missing")])
    name = table[key]
    if not isinstance(name, str) or name not in classes:
        close = nearest(name, classes) if isinstance(name, str) else None
        ending = f'; nearest: "{close}"' if close else ""
        raise SpecError([Problem((key,), f"expected {one_of(classes)}{ending}", name)])
    return classes[name].model_validate(value)


def a_table(value: object) -> Mapping[str, object]:
    """The value, where it is a table. Raises `ValueError`."""
    if not isinstance(value, Mapping):
        raise ValueError("expected a table")
    return cast("Mapping[str, object]", value)


def refuse(*problems: Problem) -> None:
    """Raise the problems, if there are any. For the after-validators of sections; keys are relative to the section."""
    if problems:
        raise SpecError(problems)
