"""`gradcal check --upgrade`: a spec, recipe or calibration of an earlier version in today's form."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gradcal_jax.cli.output import writable
from gradcal_jax.cli.status import DONE

if TYPE_CHECKING:
    from gradcal_jax.files.section import Section


def upgrade_file(file: Path, output: Path | None, *, force: bool) -> int:
    """Write a spec, recipe or calibration in the current format to `output`; by default it replaces the file, which is
    saved as FILE.old."""
    from gradcal_jax.files.document import read_text, read_toml
    from gradcal_jax.files.writing import write_toml, write_whole

    text = read_text(file)
    model, done = _upgraded(text, read_toml(text, str(file)), file)
    if not done:
        print(f"{file} is in today's form already; nothing was written")
        return DONE
    kept = None if output is not None else file.with_name(f"{file.name}.old")
    writable(output or kept or file, force)
    if kept is not None:
        write_whole(kept, text)
    goal = output or file
    write_toml(model, goal, header=f"Converted by `gradcal check --upgrade` from {file.name}.")
    print("\n".join(f"  {line}" for line in done))
    if any(line.lstrip().startswith("#") or " #" in line for line in text.splitlines()):
        print(f"note: the comments of {kept or file} are not in {goal}")
    print(f"wrote {goal}" + (f"; the original file is now {kept}" if kept is not None else ""))
    return DONE


def _upgraded(text: str, document: dict[str, Any], file: Path) -> "tuple[Section, list[str]]":
    """The file's contents, and what of its form is an earlier version's. Raises `SpecError`, and `ValueError` for files
    of other kinds."""
    from gradcal_jax.files.axis_as_imu import is_of_axis
    from gradcal_jax.files.calibration.file import is_calibration, parse_calibration
    from gradcal_jax.files.calibration.upgrade import OLD_FORMAT
    from gradcal_jax.files.mission import missions_from
    from gradcal_jax.files.recipe import is_recipe, parse_recipe
    from gradcal_jax.files.spec import FORMAT, parse_spec

    if is_calibration(document):
        model = parse_calibration(text, str(file))
        old = document["format"] == OLD_FORMAT
        return model, [f"{OLD_FORMAT} -> {model.format}, with a [[channel]] for each sensor axis"] if old else []
    if is_recipe(document):
        model = parse_recipe(text, str(file))
        if not is_of_axis(document["spec"]):
            return model, []
        names = 'motion: moves name the table\'s axis; parameters: "b00" -> "gyro_x.b00"'
        return model, [*_moved(document["spec"], "spec."), names]
    if document.get("format") != FORMAT:
        raise ValueError(f"{file}: expected a spec, a recipe or a calibration")
    with missions_from(file.parent):
        model = parse_spec(text, str(file))
    return model, _moved(document, "") if is_of_axis(document) else []


def _moved(spec: dict[str, Any], above: str) -> list[str]:
    """What of a spec of one axis has another place."""
    moved = [
        f"[{above}sensor] -> [{above}sensor], and [{above}sensor.gyro] with its axis",
        f"[{above}rig.table] -> [{above}rig.table], and [[{above}rig.table.axis]] with the spacing of its readings",
    ]
    if "earth_rate" in spec["rig"]:
        moved.append(f"{above}rig.earth_rate -> {above}rig.site.latitude")
    if spec.get("requirement"):
        moved.append(f'[[{above}requirement]]: quantities begin with the sensor\'s name, such as "gyro_bias"')
    if spec.get("done"):
        moved.append(f"[[{above}done]]: plans likewise")
    return moved
