"""Changing single keys of a spec by their dotted names: for sweeps, sensitivities and optimised plans.

    changed(spec, {"plan.cycle.moves[1].peak_rate": "200 deg/s", "design.starts": 4})

A value is what the file would hold: a quantity has its unit, and a plain number is refused for it, as in a file.
"""

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, cast

from gradcal_jax.spec.moves import AXES, Axis
from gradcal_jax.spec.spec import spec_of
from gradcal_jax.spec.spec_sections import Spec
from gradcal_jax.tables.problems import ABSENT, Key, Problem, SpecError, split_key
from gradcal_jax.tables.section import Section


def tables_of(spec: Section) -> dict[str, Any]:
    """The spec as the tables of its file: texts with units, numbers, lists; a copy, free to change. Errors: none."""
    return spec.model_dump(mode="json", exclude_unset=True)


def changed(spec: Spec, changes: Mapping[str, object], source: str = "") -> Spec:
    """A new spec with some keys set, such as {"rig.chamber.max_heating": "2 K/min"}; None removes a key.

    Values are as in the file: text with units. Errors: `SpecError` for unknown keys and bad values.

    >>> from gradcal_jax import parse_spec, presets
    >>> spec = parse_spec(presets.text("paper-static-gradient"))
    >>> changed(spec, {"rig.chamber.max_heating": "3 K/min"}).rig.chamber.max_heating
    Quantity(0.05, '3 K/min')
    """
    return spec_of(patched(spec, changes, source), source)


def along_axis(spec: Spec, axis: Axis) -> Spec:
    """The spec of one gyro on a table of one axis, of another axis of the body that hangs along that of the table, as
    the gyro's own did. Errors: `ValueError` for other specs."""
    axes: Sequence[Axis] = () if spec.sensor.gyro is None else spec.sensor.gyro.axes
    if not spec.is_one_axis or len(axes) != 1:
        raise ValueError("an axis can be chosen only if the spec has a single gyro, along the only axis of the table")
    if (own := axes[0]) == axis:
        return spec
    tables = tables_of(spec)
    table, turned = tables["rig"]["table"], AXES.index(axis) - AXES.index(own)
    tables["sensor"]["gyro"]["axes"] = [axis]
    hung: Any = table["mounting"]
    mountings = cast("list[dict[str, Any]]", hung if isinstance(hung, list) else [hung])
    for mounting in mountings:
        # In the same cyclic order, so that the body's axes stay right-handed.
        mounting |= {AXES[(k + turned) % 3]: mounting[a] for k, a in enumerate(AXES)}
    for turn in table["axis"]:
        turn["name"] = axis if turn["name"] == own else turn["name"]
    for row in tables.get("requirement", ()):
        row |= {"axis": axis} if "axis" in row else {}
    return spec_of(tables)


def patched(spec: Spec, changes: Mapping[str, object], source: str = "") -> dict[str, Any]:
    """The tables of a spec with some keys set, not checked. Raises `SpecError` for keys that have no place."""
    tables = tables_of(spec)
    problems: list[Problem] = []
    for text, value in changes.items():
        try:
            _put(tables, split_key(text), value)
        except SpecError as error:
            problems += error.problems
        except ValueError as error:
            problems.append(Problem((text,), str(error), value))
    if problems:
        raise SpecError(problems, source)
    return tables


def _put(tables: dict[str, Any], key: Key, value: object) -> None:
    here: Any = tables
    for depth, part in enumerate(key):
        last = depth == len(key) - 1
        if isinstance(part, str) and isinstance(here, dict):
            table = cast("dict[str, Any]", here)
            if not last:
                here = table.setdefault(part, {})
            elif value is None:
                table.pop(part, None)
            else:
                table[part] = copy.deepcopy(value)
        elif isinstance(part, int) and isinstance(here, list) and part < len(rows := cast("list[Any]", here)):
            if last:
                rows[part] = copy.deepcopy(value)
            else:
                here = rows[part]
        else:
            message = "there is no such place: the key above is no table, or its list is shorter (entries count from 0)"
            raise SpecError([Problem(key[: depth + 1], message, kind="unknown")])


def differences(before: Any, after: Any, key: Key) -> Iterator[tuple[Key, Any, Any]]:
    """Every place where two files' tables differ, with both values; lists of other lengths and moves with other keys
    are one place."""
    if before == after:
        return
    inner: Iterable[tuple[str | int, Any, Any]] | None = None
    if isinstance(before, dict) and isinstance(after, dict):
        old, new = cast("dict[str, Any]", before), cast("dict[str, Any]", after)
        if "shape" not in new or set(old) == set(new):
            inner = ((name, old.get(name, ABSENT), new.get(name, ABSENT)) for name in dict.fromkeys((*old, *new)))
    elif isinstance(before, list) and isinstance(after, list):
        olds, news = cast("list[Any]", before), cast("list[Any]", after)
        if len(olds) == len(news):
            inner = ((place, *pair) for place, pair in enumerate(zip(olds, news, strict=True)))
    if inner is None:
        yield key, before, after
        return
    for name, one, other in inner:
        yield from differences(one, other, (*key, name))
