"""What the names of a record's columns say: quantity, axis and unit; a question where the column map says otherwise.

Units stand in brackets ("gx [deg/s]"), behind a name ("gyro_x_rads", "temp_F", "timeUS") or before it ("mdps_x"), and
are read by one table. A unit of one or two letters counts only where it is of the quantity that the name states.
"""

import contextlib
import gzip
import importlib
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from gradcal_jax import units
from gradcal_jax.records.column_map import ForceColumn, Measured, RateColumn
from gradcal_jax.records.log import LogError
from gradcal_jax.spec import presets

EXAMPLE: Final = presets.template("columns.toml")

_SPELLINGS: Final = {
    spelling: unit
    for unit, spellings in {
        "rad/s": "rads rads-1 rad/sec radsec rps",
        "mrad/s": "mrads mrads-1",
        "deg/s": "degs degs-1 deg/sec degsec dps degree/s degrees/s degrees",
        "mdeg/s": "mdps mdegs mdegs-1",
        "deg/h": "degh degh-1 deg/hr deghr dph",
        "rpm": "rpm",
        "s": "s sec secs second seconds",
        "ms": "ms msec millis milliseconds",
        "us": "us usec micros microseconds",
        "ns": "ns nsec nanos nanoseconds",
        "degC": "c degc celsius",
        "degF": "f degf fahrenheit",
        "K": "k kelvin",
        "g": "g",
        "mg": "mg",
        "m/s^2": "m/s2 ms2 ms-2 m/s/s mss mps2",
    }.items()
    for spelling in spellings.split()
}
"""Units by their spelling in lower case, without blanks, underscores and signs of powers."""
_SAME: Final = str.maketrans({"°": "deg", "µ": "u", "μ": "u", "²": "2", "⁻": "-", "¹": "1", **dict.fromkeys(" _^·*")})
# (An axis in brackets is no unit.)
_BRACKET: Final = re.compile(r"[(\[](?![xyzXYZ\d][)\]])([^()\[\]]+)[)\]]\s*$")
_JOINT: Final = re.compile(r"[ _.]+|-(?=[A-Za-z])|(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_COUNTS: Final = re.compile(r"(?:raw|lsb|counts?|cnts?|ticks?|digits?|adc|int16)", re.IGNORECASE)
_AXIS: Final = r"[ _.\-\[]*[xyz0-2]\]?"
_ROTATION: Final = r"(?:gyro?(?:scope)?|gyr|ang(?:ular)?[ _.]?(?:velocity|vel|rate)|omega)"
_FORCE: Final = r"(?:(?:lin(?:ear)?[ _.]?)?acc(?:el(?:eration|erometer)?)?|specific[ _]?force)"
_INCREMENT: Final = r"d(?:elta|el)?[ _.]?(?:theta|ang(?:le)?|v|vel(?:ocity)?)"
_QUANTITIES: Final = {
    quantity: re.compile(pattern, re.IGNORECASE)
    for quantity, pattern in {
        "a time": r"time|stamp|time[ _]?stamp|t",
        "a temperature": r"(?:imu|sensor|gyro)?[ _]?temp(?:erature)?",
        "a rate": rf"{_ROTATION}{_AXIS}",
        "a specific force": rf"{_FORCE}{_AXIS}",
        "an increment per row": rf"{_INCREMENT}{_AXIS}",
        "a quaternion": r"q(?:uat(?:ernion)?)?[ _.\-\[]*[wxyz0-3]\]?|orientation[ _.]?[wxyz]",
        "an angle": rf"roll|pitch|yaw|heading|azimuth|(?:euler|angle)[ _.\-]?(?:roll|pitch|yaw)|(?:euler|angle){_AXIS}",
        "a magnetic field": rf"mag(?:net(?:ic|ometer)?)?(?:[ _.]?field)?{_AXIS}",
    }.items()
}
"""Names that leave no doubt."""
_SHORT: Final = {
    "a rate": re.compile(rf"(?:g|w|rate){_AXIS}|[xyz][ _]?(?:rate|gyro)", re.IGNORECASE),
    "a specific force": re.compile(rf"(?:a|f){_AXIS}|[xyz][ _]?acc(?:el)?", re.IGNORECASE),
}
"""Names that probably mean these."""
_DIMENSIONS: Final = {
    "a time": "time",
    "a temperature": "temperature",
    "a rate": "angular rate",
    "a specific force": "acceleration",
}
_KEYS: Final = {"a time": "time", "a temperature": "temperature", "a rate": "rate", "a specific force": "force"}


def question_of(name: str, source: Measured) -> str | None:
    """A question where a column's name says another quantity or unit than its map; None where neither."""
    plain = _BRACKET.sub("", name).strip()
    own = "a rate" if isinstance(source, RateColumn) else "a specific force" if isinstance(source, ForceColumn) else ""
    stated = _quantity(plain, short=False)
    if own and source.per == "second" and source.scale == 1.0 and stated == "an increment per row":
        return (
            f"the name of column '{name}' states an increment since the row before: for a rate, write the unit of the "
            'angle with per = "row", such as unit = "mdeg", per = "row"; for a specific force, give scale = the sample '
            "rate in Hz"
        )
    if own and stated not in (None, own, "an increment per row", "a time", "a temperature"):
        return (
            f"the name of column '{name}' states {stated}, and the column map states {own}: which of the two is "
            "correct?"
        )
    if source.scale != 1.0 or source.zero != 0.0:
        return None
    bracket = _BRACKET.search(name)
    if bracket and _COUNTS.fullmatch(bracket[1].strip()):
        return (
            f"the name of column '{name}' states counts, and the column map states {source.unit}: give the scale of "
            "one count"
        )
    return contradiction(name, source.unit)


def contradiction(name: str, unit: str) -> str | None:
    """A question where the name of a column says another unit than its map; None where it says none."""
    text, named = unit_in(name)
    if named is None or named == unit:
        return None
    with contextlib.suppress(units.UnitError):
        if abs(units.convert(1.0, named, unit) - 1.0) < 1e-9:
            return None
    return (
        f"the name of column '{name}' states the unit {text}, and the column map states {unit}: which of the two is "
        "correct?"
    )


def unit_in(name: str) -> tuple[str, str | None]:
    """The text of the unit in a column's name, and the unit; ("", None) where there is none."""
    if bracket := _BRACKET.search(name):
        return bracket[1], _unit_of(bracket[1])
    for text, rest in _ends_of(name):
        unit = _SPELLINGS.get(_spelling(text)) or (_unit_of(text) if "/" in text else None)
        quantity = _quantity(rest, short=True)
        alike = unit is not None and _DIMENSIONS.get(quantity or "") == _dimension(unit)
        if alike or (unit is not None and len(_spelling(text)) > 2 and quantity != "an increment per row"):
            return text, unit
    return "", None


def _ends_of(name: str) -> Iterator[tuple[str, str]]:
    """Ends of a name at joints, and what is left of it: those behind it, the longest first, and the first words."""
    joints = [(joint.start(), joint.end()) for joint in _JOINT.finditer(name)]
    for start, end in joints[-3:]:
        yield name[end:], name[:start]
    # (The first word of "degC_temp" has a joint of its own.)
    for start, end in reversed(joints[:2]):
        yield name[:start], name[end:]


def _spelling(text: str) -> str:
    return text.lower().translate(_SAME)


def _unit_of(text: str) -> str | None:
    """A unit as people write it, as this program writes it."""
    if known := _SPELLINGS.get(_spelling(text.strip())):
        return known
    with contextlib.suppress(units.UnitError):
        units.dimension_of(text.strip())
        return text.strip() if re.search("[A-Za-z]", text) else None
    return None


def _dimension(unit: str) -> str:
    return "temperature" if unit == "K" else units.dimension_of(unit)


def _quantity(plain: str, *, short: bool) -> str | None:
    """The quantity that a name without its unit states; `short`: or probably means."""
    for names in (_QUANTITIES, _SHORT) if short else (_QUANTITIES,):
        for quantity, pattern in names.items():
            if pattern.fullmatch(plain):
                return quantity
    return None


def without_a_map(path: Path) -> LogError:
    """The error for a recording without a column map: what to do, with a map to fill in if its header has names."""
    problem = (
        f"{path} is not a log of this program (.nc): describe its columns in a column map, and give the map with "
        "--columns"
    )
    try:
        columns = map_to_fill_in(path)
    except (OSError, ValueError, ImportError):
        columns = None
    if columns is None:
        return LogError(f"{problem}; gradcal start column-map -o columns.toml writes one to start from")
    return LogError(f"{problem}. A map by the header of the file; replace every ???:\n\n{columns}")


def map_to_fill_in(path: Path) -> str | None:
    """A column map in TOML from the header of a text table, or the names in an .npz or Parquet file; ??? where the
    names say no unit. None if no name says a rate."""
    names, delimiter = _header(path)
    lines = dict[str, str]()
    for name in names:
        text, unit = unit_in(name)
        plain = _BRACKET.sub("", name).strip() if _BRACKET.search(name) else name.replace(text, "").strip(" _.-")
        quantity = _quantity(plain, short=True)
        if quantity not in _KEYS:
            continue
        key = _KEYS[quantity]
        if key in ("rate", "force"):
            axis = re.findall("[xyz0-2]", plain.lower())
            key += "." + (axis[-1] if axis[-1] in "xyz" else "xyz"[int(axis[-1])])
        escaped = name.replace("\\", "\\\\").replace('"', '\\"')
        lines.setdefault(key, f'{key} = {{ column = "{escaped}", unit = "{unit or "???"}" }}')
    if not any(key.startswith("rate.") for key in lines):
        return None
    head = ['format = "gradcal-columns/1"', *([] if "time" in lines else ['sample_rate = "???"'])]
    tail = [] if delimiter in (None, ",") else ["[csv]", f'delimiter = "{delimiter}"']
    return "\n".join([*head, *(lines[key] for key in sorted(lines)), *tail])


def _header(path: Path) -> tuple[Sequence[str], str | None]:
    """The names of the columns, and their delimiter."""
    if path.suffix.lower() == ".npz":
        with path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
            return list(opened.files), None
    if path.suffix.lower() == ".parquet":
        parquet: Any = importlib.import_module("pyarrow.parquet")
        return list(parquet.read_schema(path).names), None
    text = gzip.open if path.suffix.lower() == ".gz" else open
    with text(path, "rt", encoding="utf-8-sig") as lines:
        begin = [line[:2000].lstrip("# ").strip() for line in islice(lines, 60)]
    for line in begin:
        for delimiter, mark in ((";", ";"), ("tab", "\t"), (",", ","), ("whitespace", None)):
            names = [name.strip().strip('"') for name in line.split(mark)]
            plain = [_BRACKET.sub("", name).strip() for name in names]
            plain += [rest for name in names for _, rest in _ends_of(name)]
            if len(names) > 1 and any(_quantity(name, short=True) == "a rate" for name in plain):
                return names, delimiter
    return (), None
