"""`gradcal rig new` and `gradcal rig check`: what hangs on which port."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import App

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Flag, Json, OutputOrPrint, as_json, writable
from gradcal_jax.cli.status import DONE, FAILED
from gradcal_jax.pages.plain_text import columns

if TYPE_CHECKING:
    from gradcal_jax.hardware.setup import DeviceReport


def register(app: App) -> None:
    """Add the commands of this family."""
    rig = App(name="rig", help="The rig file: which device hangs on which port, and what they say of themselves.")
    rig.command(new)
    rig.command(check)
    app.command(rig)


def new(*, output: OutputOrPrint, force: Flag = False) -> int:
    """Write a commented rig file to start from.

    Parameters
    ----------
    output
        The file to write; - prints it.
    force
        Overwrite an existing file.
    """
    from gradcal_jax.files.rig import TEMPLATE
    from gradcal_jax.files.writing import write_whole

    if str(output) == "-":
        print(TEMPLATE, end="")
        return DONE
    writable(output, force)
    write_whole(output, TEMPLATE)
    print(f"wrote {output}; put in your ports and devices, then: gradcal rig check {output}")
    return DONE


def check(rig: Path, /, *, json: Json = False) -> int:
    """Ask every device of a rig who it is and what it accepts. Nothing moves.

    The exit status is 3 where a device does not answer as it should.

    Parameters
    ----------
    rig
        The rig file.
    json
        Print what the devices said as JSON.
    """
    from gradcal_jax.files.rig import read_rig
    from gradcal_jax.hardware.clock import RealClock
    from gradcal_jax.hardware.setup import check_each

    found = read_rig(rig)
    reports = check_each(found, RealClock())
    if json:
        print(as_json([_plain(asdict(report)) for report in reports]))
    else:
        print(strong(found.title or str(rig)))
        print(columns([row for report in reports for row in _rows(report)]))
        for entry in found.axis:
            print(f'  when a run ends badly, axis {entry.name}: "{entry.safe}"')
        if found.chamber is not None:
            print(f'  when a run ends badly, the chamber: "{found.chamber.safe}"')
        good = all(report.good for report in reports)
        print("every device answers as the rig file says" if good else "the rig is not ready")
    return DONE if all(report.good for report in reports) else FAILED


def _rows(report: "DeviceReport") -> list[tuple[str, ...]]:
    head = (report.name, report.driver, report.port)
    if report.problem:
        return [(*head, report.problem)]
    identity = report.identity
    said = "" if identity is None else " ".join((identity.model, identity.serial_number, identity.firmware)).strip()
    limits = {} if report.limits is None else asdict(report.limits)
    limits.pop("registers", None)
    return [(*head, said), *(("", "", "", f"{name} {_short(value)}") for name, value in limits.items())]


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return None if isinstance(value, float) and value - value != 0.0 else value
