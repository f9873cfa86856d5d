"""`gradcal log`: the log of a run, from the journal's raw bytes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.output import Json, OptionalOutput, RunPath, show
from gradcal_jax.cli.recordings import load
from gradcal_jax.units import time_text

if TYPE_CHECKING:
    from gradcal_jax.records.log import Log


def log(
    run: RunPath,
    /,
    *,
    output: OptionalOutput = None,
    unit: str | None = None,
    recording: Path | None = None,
    columns: Path | None = None,
    json: Json = False,
) -> int:
    """Write the log of a run: the samples decoded from the raw bytes, the angles, the temperatures and the standstills.

    Parameters
    ----------
    output
        The log file (netCDF); by default log.nc in the folder of the run. An older log is replaced. If there are
        several IMUs, one file is written for each, and the name of the IMU is added to the name of the file.
    unit
        Write only the log of this IMU, if several were on the table.
    recording
        A recording that the IMU's own logger made during this run; its clock is aligned with the clock of the run by
        comparing the motion.
    columns
        If the recording is a table: its column map (gradcal-columns/1); see gradcal start column-map.
    json
        Print the contents of the log as JSON.
    """
    from gradcal_jax.hardware.run_folder import RunFolder
    from gradcal_jax.records.run_log import units_in

    if columns is not None and recording is None:
        raise ValueError("--columns states the column map of a --recording, but --recording is missing")
    recorded = None if recording is None else load(recording, columns, unit=unit)
    RunFolder(run).notes()
    target = output or run / "log.nc"
    names = [unit] if unit is not None or recorded is not None else units_in(run)
    files = {name: target if len(names) == 1 else target.with_stem(f"{target.stem}-{name}") for name in names}
    done = [_written(run, name, recorded, path) for name, path in files.items()]
    records = [record for record, _ in done]
    return show("\n".join(text for _, text in done), records if len(names) > 1 else records[0], json=json)


def _written(run: Path, unit: str | None, recorded: "Log | None", target: Path) -> tuple[dict[str, Any], str]:
    """Write the log of an IMU; what is printed of it."""
    from gradcal_jax.records.log_file import write_log
    from gradcal_jax.records.run_log import log

    # A day's samples lie on the disk that the log will be on.
    made = log(run, unit, recording=recorded, scratch=target.parent)
    write_log(made, target)
    counts, name = made.counts(), made.units[0]
    standing = 0 if made.standstill is None else int(made.standstill.max()) + 1
    record: dict[str, Any] = {"log": str(target), "unit": name, "duration_s": made.duration_s, "rows": counts}
    record |= {"standstills": standing, "simulated": made.simulated, "provenance": dict(made.provenance)}
    record |= {"findings": [finding.message for finding in made.findings]}
    simulated = " (simulated devices)" if made.simulated else ""
    text = (
        f"{time_text(made.duration_s)} of {name}: {counts['used']} samples used of {made.rows_read}, "
        f"{standing} standstills{simulated}"
    )
    return record, "\n".join([text, *(f"note: {finding}" for finding in record["findings"]), f"wrote {target}"])
