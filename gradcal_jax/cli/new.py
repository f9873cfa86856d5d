"""`gradcal new` and `gradcal start`: a commented spec, rig file or column map to start from."""

import sys
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Flag, Force, Output, writable
from gradcal_jax.tables.display import columns

_COLUMN_MAP: Final = "column-map"
_TEMPLATES: Final = {
    "export-gains": "Template for export: offsets and gains for a flight controller",
    "export-tracker": "Template for export: matrices for a body or head tracker, in JSON",
    "export-ins": "Template for export: noise and errors for an inertial navigation filter",
}


def new(
    preset: str | None = None,
    /,
    *,
    output: Annotated[str | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    force: Force = False,
) -> int:
    """Write a commented example of a spec, of a column map for recordings of other programs, or of an export template.

    Parameters
    ----------
    preset
        The name of the example: a preset of a spec, column-map, or a template for export; --list lists all
        names.
    output
        The file to write; "-" prints the example instead.
    listing
        List all examples.
    """
    from gradcal_jax.records import column_guess
    from gradcal_jax.spec import presets

    if listing:
        rows = [(name, presets.title(name)) for name in presets.names()]
        rows += [(_COLUMN_MAP, "Column map of a recording, for --columns")]
        rows += _TEMPLATES.items()
        print(columns(rows, indent=""))
        return DONE
    if preset is None:
        raise ValueError("name the preset; gradcal new --list lists all presets")
    examples = {_COLUMN_MAP: column_guess.EXAMPLE}
    examples |= {preset: presets.template(f"{preset}.j2")} if preset in _TEMPLATES else {}
    text = examples[preset] if preset in examples else presets.text(preset)
    if output is None or output == "-":
        if output is None:
            raise ValueError(
                f"name the file to write: gradcal new {preset} -o my.toml (or -o - to print the text instead)"
            )
        sys.stdout.write(text)
        return DONE
    from gradcal_jax.tables.writing import write_whole

    writable(Path(output), force)
    write_whole(output, text)
    if preset not in examples:
        from gradcal_jax.cli.predict import omitted_lines
        from gradcal_jax.recipe.recipe import spec_in

        if omitted := omitted_lines(spec_in(Path(output))):
            print("\n".join(omitted))
    following = f"gradcal check {output}"
    if preset == _COLUMN_MAP:
        following = f"gradcal allan LOG --columns {output}"
    elif preset in _TEMPLATES:
        following = f"gradcal export CALIBRATION --template {output}"
    print(f"wrote {output}; next: {following}")
    return DONE


def start(*, output: Output, preset: str | None = None, force: Flag = False) -> int:
    """Ask questions about the sensor and the rig, and write a commented spec with a plan, a rig file and a column map.

    An empty line accepts the answer in brackets; "<" returns to the previous question.

    Parameters
    ----------
    output
        The folder for spec.toml, rig.toml and columns.toml; it is created if necessary.
    preset
        Ask no questions, but use the prepared answers of drone-imu, bmi088, tactical-imu, drone-gyro, tactical-gyro or
        no-encoder.
    force
        Overwrite existing files.
    """
    from gradcal_jax.spec import begin
    from gradcal_jax.spec.spec import parse_spec
    from gradcal_jax.tables.writing import write_whole

    if output.exists() and not output.is_dir():
        raise ValueError(f"{output} is a file; name a directory")
    if preset is None:
        # Before the questions: answers are not asked for in vain.
        for name in ("spec.toml", "rig.toml", "columns.toml"):
            if (output / name).exists():
                writable(output / name, force)
    answers = _asked() if preset is None else begin.preset(preset)
    texts = begin.files_of(answers)
    if "spec.toml" in texts:
        parse_spec(texts["spec.toml"], str(output / "spec.toml"))
    output.mkdir(parents=True, exist_ok=True)
    for name in texts:
        writable(output / name, force)
    for name, text in texts.items():
        write_whole(output / name, text)
    print(f"wrote {', '.join(str(output / name) for name in texts)}")
    typical = begin.typical_terms(answers)
    if typical:
        print(
            "no question was asked about these terms; for each, spec.toml has a typical figure of the class, and its "
            "source:"
        )
        print("\n".join(f"  {line}" for line in typical))
    print("next, in this order:")
    print("\n".join(f"  {line}" for line in _next(answers, str(output))))
    return DONE


def _next(answers: dict[str, str], folder: str) -> list[str]:
    """The commands from here to the firmware's header."""
    from gradcal_jax.spec.begin import NO_ENCODER

    if answers["table"] == "none":
        return [
            "let the IMU lie still in about twenty positions, in all directions, five seconds in each, and record this",
            f'gradcal estimate RECORDING --columns {folder}/columns.toml --gravity "9.81 m/s^2" '
            f'--temperature "23 degC" -o {folder}/calibration.toml',
        ]
    # A search makes turns of a motor, and a hand's are as they are.
    as_it_is = " --steps 0" if answers["table"] == "hand" or answers["angle"] == NO_ENCODER else " --until-met"
    own = f" --recording FILE --columns {folder}/columns.toml" if answers["stream"] == "own" else ""
    return [
        f"gradcal predict {folder}/spec.toml",
        f"gradcal optimise {folder}/spec.toml{as_it_is} -o {folder}/recipe.toml",
        f"gradcal run {folder}/recipe.toml --simulate -o {folder}/rehearsal",
        f"gradcal rig check {folder}/rig.toml",
        f"gradcal run {folder}/recipe.toml --rig {folder}/rig.toml -o {folder}/run",
        f"gradcal log {folder}/run{own}",
        f"gradcal estimate {folder}/run/log.nc --recipe {folder}/recipe.toml -o {folder}/run/calibration.toml",
        f"gradcal report {folder}/run -o {folder}/report.html --before {folder}/spec.toml",
        f"gradcal export {folder}/run/calibration.toml --format c-header -o {folder}/calibration.h",
    ]


def _asked() -> dict[str, str]:
    """Read the answers, one a line; an empty line takes the default. On a terminal, a wrong answer is asked again."""
    from gradcal_jax.spec.begin import DEFAULTS, QUESTIONS, asked, understood

    answers: dict[str, str] = dict(DEFAULTS)
    done: list[int] = []
    number = 0
    while number < len(QUESTIONS):
        question = QUESTIONS[number]
        if not question.when(answers):
            number += 1
            continue
        usual = answers.get(question.name, "")
        print(f"{len(done) + 1}. {asked(question)}" + f" [{usual}] " * bool(usual), end=" " * (not usual), flush=True)
        try:
            line = sys.stdin.readline()
        except KeyboardInterrupt:
            print()
            raise
        if not line:
            print()
            raise ValueError(f"the answers ended at question {len(done) + 1}: {asked(question)}")
        answer = line.strip() or usual
        if answer == "<":
            number = done.pop() if done else 0
            continue
        try:
            understood(question, answer)
        except ValueError as error:
            if not sys.stdin.isatty():
                raise ValueError(f"{asked(question)} {answer!r}: {error}") from None
            print(f"   {error}")
            continue
        answers[question.name] = answer
        done.append(number)
        number += 1
    return answers
