"""What the names of a record's columns say: quantity, axis and unit; a question where the column map says otherwise.

Units stand in brackets ("gx [deg/s]"), behind a name ("gyro_x_rads", "temp_F", "timeUS") or before it ("mdps_x"), and
are read by one table. A unit of one or two letters counts only where it is of the quantity that the name states.
"""

import contextlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

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
        "counts": "raw lsb lsbs count counts cnt cnts tick ticks digit digits adc int16",
    }.items()
    for spelling in spellings.split()
}
"""Units by their spelling in lower case, without blanks, underscores and signs of powers."""
_SAME: Final = str.maketrans({"°": "deg", "µ": "u", "μ": "u", "²": "2", "⁻": "-", "¹": "1", **dict.fromkeys(" _^·*")})
# (An axis in brackets is no unit.)
_BRACKET: Final = re.compile(r"[(\[](?![xyzXYZ\d][)\]])([^()\[\]]+)[)\]]\s*$")
_JOINT: Final = re.compile(r"[ _.]+|-(?=[A-Za-z])|(?<=[a-z])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_AXIS: Final = r"[ _.\-\[]*[xyz0-2]\]?"
_ROTATION: Final = r"(?:gyro?(?:scope)?|gyr|ang(?:ular)?[ _.]?(?:velocity|vel|rate)|omega)"
_FORCE: Final = r"(?:(?:lin(?:ear)?[ _.]?)?acc(?:el(?:eration|erometer)?)?|specific[ _]?force)"
_INCREMENT: Final = r"d(?:elta|el)?[ _.]?(?:theta|ang(?:le)?|v|vel(?:ocity)?)"
_QUANTITIES: Final = {
    "a time": r"time|stamp|time[ _]?stamp|t",
    "a temperature": r"(?:imu|sensor|gyro)?[ _]?temp(?:erature)?",
    "a rate": rf"{_ROTATION}{_AXIS}",
    "a specific force": rf"{_FORCE}{_AXIS}",
    "an increment per row": rf"{_INCREMENT}{_AXIS}",
    "a quaternion": r"q(?:uat(?:ernion)?)?[ _.\-\[]*[wxyz0-3]\]?|orientation[ _.]?[wxyz]",
    "an angle": rf"roll|pitch|yaw|heading|azimuth|(?:euler|angle)[ _.\-]?(?:roll|pitch|yaw)|(?:euler|angle){_AXIS}",
    "a magnetic field": rf"mag(?:net(?:ic|ometer)?)?(?:[ _.]?field)?{_AXIS}",
}
"""Names that leave no doubt."""
_SHORT: Final = {
    "a rate": rf"(?:g|w|rate){_AXIS}|[xyz][ _]?(?:rate|gyro)",
    "a specific force": rf"(?:a|f){_AXIS}|[xyz][ _]?acc(?:el)?",
}
"""Names that probably mean these."""
_MEASURED: Final = {
    "a time": ("time", "time"),
    "a temperature": ("temperature", "temperature"),
    "a rate": ("rate", "angular rate"),
    "a specific force": ("force", "acceleration"),
}
"""By quantity the key of a map, and the dimension."""


def question_of(name: str, source: Measured) -> str | None:
    """A question where a column's name says another quantity or unit than its map; None where neither."""
    plain = _BRACKET.sub("", name).strip()
    own = "a rate" if isinstance(source, RateColumn) else "a specific force" if isinstance(source, ForceColumn) else ""
    stated = _quantity(plain, _QUANTITIES)
    begin = f"the name of column '{name}' states"
    if own and stated == "an increment per row" and source.per == "second" and source.scale == 1.0:
        return (
            f"{begin} an increment since the row before: for a rate, write the unit of the "
            'angle with per = "row", such as unit = "mdeg", per = "row"; for a specific force, give scale = the sample '
            "rate in Hz"
        )
    if own and stated not in (None, own, "an increment per row", "a time", "a temperature"):
        return f"{begin} {stated}, and the column map states {own}: which of the two is correct?"
    return contradiction(name, source.unit) if source.scale == 1.0 and source.zero == 0.0 else None


def contradiction(name: str, unit: str) -> str | None:
    """A question where the name of a column says another unit than its map; None where it says none."""
    text, named = unit_in(name)
    if named is None or named == unit:
        return None
    begin = f"the name of column '{name}' states"
    if named == "counts":
        return f"{begin} counts, and the column map states {unit}: give the scale of one count"
    with contextlib.suppress(units.UnitError):
        if abs(units.convert(1.0, named, unit) - 1.0) < 1e-9:
            return None
    return f"{begin} the unit {text}, and the column map states {unit}: which of the two is correct?"


def unit_in(name: str) -> tuple[str, str | None]:
    """The text of the unit in a column's name, and the unit; ("", None) where there is none."""
    if bracket := _BRACKET.search(name):
        return bracket[1], _unit_of(bracket[1])
    for text, rest in _ends_of(name):
        unit = _SPELLINGS.get(_spelling(text)) or (_unit_of(text) if "/" in text else None)
        quantity = _quantity(rest, _QUANTITIES, _SHORT)
        if unit is None or unit == "counts":
            continue
        dimension = "temperature" if unit == "K" else units.dimension_of(unit)
        alike = quantity in _MEASURED and _MEASURED[quantity][1] == dimension
        if alike or (len(_spelling(text)) > 2 and quantity != "an increment per row"):
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
    return text.strip().lower().translate(_SAME)


def _unit_of(text: str) -> str | None:
    """A unit as people write it, as this program writes it."""
    if known := _SPELLINGS.get(_spelling(text)):
        return known
    with contextlib.suppress(units.UnitError):
        units.dimension_of(text.strip())
        return text.strip() if re.search("[A-Za-z]", text) else None
    return None


def _quantity(plain: str, *tables: dict[str, str]) -> str | None:
    """The quantity that a name without its unit states."""
    named = (item for table in tables for item in table.items())
    return next((quantity for quantity, names in named if re.fullmatch(names, plain, re.IGNORECASE)), None)


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
    """A column map in TOML from the header of a text table; ??? where the names say no unit. None if no name says a
    rate."""
    names, delimiter = _header(path)
    lines = dict[str, str]()
    for name in names:
        quantity, plain, unit = _read(name)
        if quantity not in _MEASURED:
            continue
        key, _ = _MEASURED[quantity]
        if key in ("rate", "force"):
            axis = re.findall("[xyz0-2]", plain.lower())[-1]
            key += "." + (axis if axis in "xyz" else "xyz"[int(axis)])
        known = "???" if unit in (None, "counts") else unit
        escaped = name.replace("\\", "\\\\").replace('"', '\\"')
        lines.setdefault(key, f'{key} = {{ column = "{escaped}", unit = "{known}" }}')
    if not any(key.startswith("rate.") for key in lines):
        return None
    head = ['format = "gradcal-columns/1"', *([] if "time" in lines else ['sample_rate = "???"'])]
    tail = [] if delimiter in (None, ",") else ["[csv]", f'delimiter = "{delimiter}"']
    return "\n".join([*head, *(lines[key] for key in sorted(lines)), *tail])


def _read(name: str) -> tuple[str | None, str, str | None]:
    """The quantity that a name states, the name without its unit, and the unit."""
    text, unit = unit_in(name)
    plain = _BRACKET.sub("", name).strip() if _BRACKET.search(name) else name.replace(text, "").strip(" _.-")
    return _quantity(plain, _QUANTITIES, _SHORT), plain, unit


def _header(path: Path) -> tuple[Sequence[str], str | None]:
    """The names of the columns, and their delimiter."""
    with path.open(encoding="utf-8-sig") as lines:
        begin = [lines.readline(2000).lstrip("# ").strip() for _ in range(60)]
    for line in begin:
        for delimiter, mark in ((";", ";"), ("tab", "\t"), (",", ","), ("whitespace", None)):
            names = [name.strip().strip('"') for name in line.split(mark)]
            if len(names) > 1 and any(_read(name)[0] == "a rate" for name in names):
                return names, delimiter
    return (), None
