"""`gradcal new`: a commented spec or column map to start from."""

import sys
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import Force, writable
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import columns

_COLUMN_MAP: Final = "column-map"
_POINT_MAP: Final = "point-map"
_TEMPLATES: Final = {
    "export-gains": "Offsets and gains of a flight controller, for export --template",
    "export-tracker": "Matrices of a body or head tracker in JSON, for export --template",
    "export-ins": "Noise and errors for an inertial navigation filter, for export --template",
}


def new(
    preset: str | None = None,
    /,
    *,
    output: Annotated[str | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    force: Force = False,
) -> int:
    """Write a commented example of a spec, or of a column map for recordings of other programs.

    Parameters
    ----------
    preset
        Its name, see --list; or column-map, point-map, or a template of an export.
    output
        The file to write; - prints it.
    listing
        List the presets.
    """
    from gradcal_jax.files import column_guess, points, presets

    if listing:
        rows = [(name, presets.title(name)) for name in presets.names()]
        rows += [(_COLUMN_MAP, "What the columns of a recording mean, for --columns")]
        rows += _TEMPLATES.items()
        print(columns([*rows, (_POINT_MAP, "What the columns of a table of points mean, for --points")], indent=""))
        return DONE
    if preset is None:
        raise ValueError("which preset? List them with: gradcal new --list")
    examples = {_COLUMN_MAP: column_guess.EXAMPLE, _POINT_MAP: points.EXAMPLE}
    examples |= {preset: presets.template(f"{preset}.j2")} if preset in _TEMPLATES else {}
    text = examples[preset] if preset in examples else presets.text(preset)
    if output is None or output == "-":
        if output is None:
            raise ValueError(f"where to? Write a file with: gradcal new {preset} -o my.toml (or -o - to print it)")
        sys.stdout.write(text)
        return DONE
    from gradcal_jax.files.writing import write_whole

    writable(Path(output), force)
    write_whole(output, text)
    if preset not in examples:
        from gradcal_jax.cli.predict import omitted_lines
        from gradcal_jax.files.recipe import spec_in

        if omitted := omitted_lines(spec_in(Path(output))):
            print("\n".join(omitted))
    following = {
        _COLUMN_MAP: f"gradcal allan LOG --columns {output}",
        _POINT_MAP: f"gradcal estimate TABLE --points {output} --spec SPEC",
    }.get(
        preset, f"gradcal export CALIBRATION --template {output}" if preset in _TEMPLATES else f"gradcal check {output}"
    )
    print(f"wrote {output}; next: {following}")
    return DONE
