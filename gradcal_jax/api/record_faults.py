"""What a record shows to be wrong before anything is estimated: rows that no estimate may use are masked, and what no
choice of rows mends makes the calibration not valid."""

from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from gradcal_jax import estimation
from gradcal_jax.files.log import Log, LogError
from gradcal_jax.files.signal_faults import without_faults
from gradcal_jax.files.spec_sections import Spec

# An angle within a standstill is no chance at this many standard deviations, and matters at this many of a reading.
_NO_CHANCE, _MATTERS = 6.0, 2.0


class RecordFaults(NamedTuple):
    """Of one unit: sentences on rows that are left out, and by name those on what makes the calibration not valid."""

    left_out: tuple[str, ...] = ()
    not_valid: Mapping[str, str] = MappingProxyType({})

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of them."""
        return *self.left_out, *self.not_valid.values()

    @property
    def also(self) -> str:
        """The sentences behind that of an error."""
        return "".join(f"; {sentence}" for sentence in self.sentences)


def without_bad_rows(
    spec: Spec, logs: Sequence[Log], channels: Collection[str]
) -> tuple[list[Log], Mapping[str, RecordFaults]]:
    """The logs with such rows masked, and by unit what was found in any of them; `channels`: those that are estimated,
    such as "gyro x"."""
    cleaned, left_out, wrong = list[Log](), dict[str, list[str]](), dict[str, dict[str, str]]()
    for log in logs:
        clean, found = without_faults(log, channels)
        for name, faults in found.items():
            if not clean.usable(name).any():
                raise LogError(f"{name}: no row is left that may be used: {'; '.join(faults.sentences)}")
        cleaned.append(clean)
        for name, faults in found.items():
            left_out.setdefault(name, []).extend(faults.sentences)
            wrong.setdefault(name, {}).update(faults.coarse | _ends_of_standstills(spec, clean, name, channels))
    return cleaned, {name: RecordFaults(tuple(left_out[name]), wrong[name]) for name in left_out}


def _ends_of_standstills(spec: Spec, log: Log, name: str, channels: Collection[str]) -> dict[str, str]:
    if log.standstill is None:
        return {}
    angles = [axis.angle for axis in spec.rig.table.axis]
    known = min(float(np.hypot(float(a.reading_noise), float(a.standstill_offset))) for a in angles)
    found = dict[str, str]()
    for k, label in enumerate(log.axes):
        if f"gyro {label}" not in channels:
            continue
        rate = log.rate_rad_per_s[log.unit_index(name), :, k]
        seen = estimation.settling(log.time_s, rate, log.standstill >= 0, log.usable(name))
        if seen is None:
            continue
        for angle, std, end, words in (
            (seen.after, seen.after_std, "beginnings", "after the table is said to stand"),
            (seen.before, seen.before_std, "ends", "before the table is said to move"),
        ):
            if abs(angle) > max(_NO_CHANCE * std, _MATTERS * known):
                found[f"gyro {label} at the {end} of standstills"] = (
                    f"gyro {label} turns {np.degrees(abs(angle)):.2g} deg {words}, in the mean of all standstills: its "
                    "samples are delayed or filtered, or standstills are marked where the table still moves"
                )
    return found
