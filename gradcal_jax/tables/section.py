"""The base of every table in a file: frozen, closed to unknown keys, with plain messages."""

import ast
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from gradcal_jax.tables.display import summary
from gradcal_jax.tables.problems import Problem, SpecError, from_validation, hint, nearest, one_of

_NAMES_OF_PYDANTIC = {name for name in dir(BaseModel) if not name.startswith("_")}


class Section(BaseModel):
    """A table of a file. Unknown keys are refused with the nearest right spelling."""

    # Deferred: a command builds only the validators of the files that it reads.
    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=False, defer_build=True
    )

    __repr__ = __str__ = summary

    def __dir__(self) -> list[str]:
        """Our own names, which a tab lists, without those of pydantic."""
        return [name for name in object.__dir__(self) if name not in _NAMES_OF_PYDANTIC]

    # Plain types: the tests check annotations function by function, where Self has no meaning.
    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, value: Any, handler: Callable[[Any], Any]) -> Any:
        try:
            section = handler(value)
        except ValidationError as error:
            raise SpecError(with_spelling(from_validation(error), cls, value)) from None
        checks: list[Any] = [vars(kind).get("_problems") for kind in reversed(type(section).__mro__)]
        refuse(*(problem for check in filter(None, checks) for problem in check(section)))
        return section

    def _problems(self) -> Iterable[Problem]:
        """What is wrong between the keys of a table whose keys are right one by one; keys are relative to it. What a
        class yields is added to the problems of its bases."""
        return ()

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The schema, each key with its meaning."""
        body = handler(schema)
        keys: dict[str, Any] = handler.resolve_ref_schema(body).get("properties", {})
        for name, meaning in meanings(cls).items():
            keys[name]["description"] = meaning
        return body


def meanings(model: type[BaseModel]) -> dict[str, str]:
    """The meaning of each key of a table: the texts below the fields, or their descriptions."""
    owners = [owner for owner in model.__mro__ if issubclass(owner, Section)]
    texts: dict[str, str] = {}
    for name, field in model.model_fields.items():
        of_owners = (_texts(owner.__module__).get((owner.__name__, name)) for owner in owners)
        if text := next(filter(None, of_owners), field.description):
            texts[name] = text
    return texts


@cache
def _texts(module: str) -> dict[tuple[str, str], str]:
    """The texts by class and field, from the source; pydantic would read every file again for each class, at import."""
    texts: dict[tuple[str, str], str] = {}
    for table in ast.parse(Path(sys.modules[module].__file__ or "").read_text(encoding="utf-8")).body:
        if isinstance(table, ast.ClassDef):
            for pair in pairwise(table.body):
                match pair:
                    case ast.AnnAssign(target=ast.Name(id=field)), ast.Expr(value=ast.Constant(value=str(text))):
                        texts[table.name, field] = " ".join(text.split())
                    case _:
                        pass
    return texts


def with_spelling(problems: Sequence[Problem], model: type[BaseModel], value: object) -> list[Problem]:
    """Add the nearest right spelling to unknown keys, and drop "missing" where a misspelt key stands for it."""
    known = list(model.model_fields)
    free = [name for name in known if not isinstance(value, Mapping) or name not in value]
    meant: set[tuple[str | int | None, ...]] = set()
    spelt: list[Problem] = []
    for problem in problems:
        name, ending = str(problem.key[0]) if len(problem.key) == 1 else "", ""
        if name and problem.kind == "unknown":
            close = nearest(name, free) or nearest(name, known)
            ending = f'; nearest: "{close}"' if close else f"; known here: {', '.join(known)}"
            meant.add((close,))
        elif name and problem.kind == "missing" and (meaning := meanings(model).get(name)):
            ending = f" ({meaning[0].lower()}{meaning[1:].rstrip('.')})"
        spelt.append(replace(problem, message=problem.message + ending))
    return [problem for problem in spelt if problem.kind != "missing" or problem.key not in meant]


class OneOrMore:
    """Marks a list of tables that may stand as one table, without the list."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        def listed(value: object) -> object:
            return (cast("object", value),) if isinstance(value, Mapping) else value

        return core_schema.no_info_before_validator_function(listed, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        body = handler(schema)
        return {"anyOf": [body["items"], body]}


class OneOf:
    """Marks a text that is one of these names, as a `Literal` of them."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = list(dict.fromkeys(names))

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(self.names)


def chosen_by(key: str, classes: Mapping[str, type[Section]], default: str | None = None) -> BeforeValidator:
    """Marks a field that holds one of several tables: that which its `key` names, or the default."""

    def kind_of(table: Mapping[str, object]) -> type[Section]:
        name = table.get(key, default)
        if name is None:
            refuse_misspelt(table, [key])
            refuse(Problem((key,), f"this key is missing; expected {one_of(classes)}", kind="missing"))
        if not isinstance(name, str) or name not in classes:
            raise SpecError([Problem((key,), f"expected {one_of(classes)}{hint(name, classes)}", name)])
        return classes[name]

    return _chosen(kind_of)


def by_key(
    kinds: Mapping[str, type[Section]], expected: str = "", default: type[Section] | None = None
) -> BeforeValidator:
    """Marks a field that holds one of several tables: that of the first of these keys that it has, or the default."""

    def kind_of(table: Mapping[str, object]) -> type[Section]:
        kind = next((kind for key, kind in kinds.items() if key in table), default)
        if kind is None:
            refuse_misspelt(table, kinds)
            raise ValueError(f"expected {expected}")
        return kind

    return _chosen(kind_of)


def _chosen(kind_of: Callable[[Mapping[str, object]], type[Section]]) -> BeforeValidator:
    def read(value: object) -> object:
        if isinstance(value, Section):
            return value
        if not isinstance(value, Mapping):
            raise ValueError("expected a table")
        return kind_of(cast("Mapping[str, object]", value)).model_validate(value)

    return BeforeValidator(read)


def refuse_misspelt(table: Mapping[str, object], known: Iterable[str]) -> None:
    """Raise for the first key of a table that is nearly one of the keys that it lacks, if there is one."""
    for key, value in table.items():
        if ending := hint(key, known):
            raise SpecError([Problem((key,), f"this key is unknown{ending}", value, "unknown")])


def refuse(*problems: Problem) -> None:
    """Raise the problems, if there are any; keys are relative to the section."""
    if problems:
        raise SpecError(problems)
