"""`gradcal log`: the log of a run, from the journal's raw bytes; it can be made again at any time."""

from pathlib import Path

from cyclopts import App

from gradcal_jax.cli.output import Json, OptionalOutput, as_json
from gradcal_jax.cli.status import DONE
from gradcal_jax.units import time_text


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(log)


def log(run: Path, /, *, output: OptionalOutput = None, unit: str | None = None, json: Json = False) -> int:
    """Make the log of a run: samples decoded from the raw bytes, angles, temperatures, standstills.

    Parameters
    ----------
    run
        The folder of the run.
    output
        The log file (netCDF); absent: log.nc in the folder. An older log is replaced.
    unit
        Of several units on the table, the one whose log to make.
    json
        Print what the log holds as JSON.
    """
    from gradcal_jax.files.log import write_log
    from gradcal_jax.hardware.execute import log as log_of

    found = log_of(run, unit)
    target = output or run / "log.nc"
    write_log(found, target)
    used, standstills = found.counts()["used"], 0 if found.standstill is None else int(found.standstill.max() + 1)
    if json:
        told = {"log": str(target), "unit": found.units[0], "duration_s": found.duration_s, "rows": found.counts()}
        told |= {"standstills": standstills, "simulated": found.simulated, "provenance": dict(found.provenance)}
        print(as_json(told | {"findings": [finding.message for finding in found.findings]}))
        return DONE
    print(
        f"{time_text(found.duration_s)} of {found.units[0]}: {used} samples used of {found.rows_read}, "
        f"{standstills} standstills" + (" (simulated devices)" if found.simulated else "")
    )
    for finding in found.findings:
        print(f"note: {finding.message}")
    rates, stds = (
        [1e6 * float(word) for word in found.provenance[name].split(", ")]
        for name in ("clock_rate_error", "clock_rate_std")
    )
    each = ", ".join(f"{rate:+.3f} ppm (1σ {std:.1g} ppm)" for rate, std in zip(rates, stds, strict=True))
    print(f"the unit's second is longer than the computer's by {each}")
    print(f"wrote {target}")
    return DONE
