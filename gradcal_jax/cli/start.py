"""`gradcal start`: a commented spec, rig file or column map to start from."""

import sys
from pathlib import Path
from typing import Annotated, Final

from cyclopts import Parameter

from gradcal_jax.cli.output import DONE, Force, writable
from gradcal_jax.tables.table import Table

_COLUMN_MAP: Final = "column-map"
_SWEEP: Final = "sweep"
_TEMPLATES: Final = {
    "export-gains": "Template for export: offsets and gains for a flight controller",
    "export-tracker": "Template for export: matrices for a body or head tracker, in JSON",
    "export-ins": "Template for export: noise and errors for an inertial navigation filter",
}


def start(
    example: str | None = None,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"], allow_leading_hyphen=True)] = None,
    preset: str | None = None,
    listing: Annotated[bool, Parameter(name="--list", negative="")] = False,
    force: Force = False,
) -> int:
    """Ask questions about the sensor and the rig, and write a commented spec with a plan, a rig file and a column map;
    or write one example.

    An empty line accepts the answer in brackets; "<" returns to the previous question.

    Parameters
    ----------
    example
        Ask no questions, but write this example to the file OUTPUT; --list prints all names.
    output
        The folder for spec.toml, rig.toml and columns.toml, which is created if necessary; for an example, the file
        ("-" prints it instead).
    preset
        Ask no questions, but use the prepared answers of drone-imu, bmi088, tactical-imu, drone-gyro, tactical-gyro or
        no-encoder.
    listing
        List all examples.
    """
    if listing:
        from gradcal_jax.spec import presets

        rows = [(name, presets.title(name)) for name in presets.names()]
        rows += [(_COLUMN_MAP, "Column map of a recording, for --columns"), *_TEMPLATES.items()]
        rows.append((_SWEEP, "A sweep: many plans at once, for gradcal sweep"))
        print(Table.of(["example", "what it is"], rows).text())
        return DONE
    if output is None:
        raise ValueError("name the folder (or, for an example, the file) to write, such as -o mine")
    if example is not None:
        return _example(example, output, force)
    return _folder(output, preset, force)


def _example(name: str, output: Path, force: bool) -> int:
    from gradcal_jax.records import column_names
    from gradcal_jax.spec import presets
    from gradcal_jax.tables.writing import write_whole

    if name == _COLUMN_MAP:
        text, following = column_names.EXAMPLE, f"gradcal noise LOG --columns {output}"
    elif name == _SWEEP:
        text, following = presets.template("sweep.toml"), f"gradcal sweep {output} -o results.nc"
    elif name in _TEMPLATES:
        text, following = presets.template(f"{name}.j2"), f"gradcal export CALIBRATION --template {output}"
    else:
        text, following = presets.text(name), f"gradcal check {output}"
    if str(output) == "-":
        sys.stdout.write(text)
        return DONE
    writable(output, force)
    write_whole(output, text)
    print(f"wrote {output}; next: {following}")
    return DONE


def _folder(output: Path, preset: str | None, force: bool) -> int:
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
    mountings = 0
    if "spec.toml" in texts:
        mountings = len(parse_spec(texts["spec.toml"], str(output / "spec.toml")).rig.table.mounting)
    output.mkdir(parents=True, exist_ok=True)
    for name in texts:
        writable(output / name, force)
    for name, text in texts.items():
        write_whole(output / name, text)
    print(f"wrote {', '.join(str(output / name) for name in texts)}")
    print("next, in this order:")
    print("\n".join(f"  {line}" for line in _next(answers, str(output), mountings)))
    return DONE


def _next(answers: dict[str, str], folder: str, mountings: int) -> list[str]:
    """The commands from here to the firmware's header."""
    if answers["table"] == "none":
        return [
            "let the IMU lie still in about twenty positions, in all directions, five seconds in each, and record this",
            f'gradcal estimate RECORDING --columns {folder}/columns.toml --gravity "9.81 m/s^2" '
            f'--temperature "23 degC" -o {folder}/calibration.toml',
        ]
    # A search makes turns of a motor, and a hand's are as they are.
    as_it_is = " --steps 0" if answers["table"] == "hand" else " --until-met"
    own, several = "", answers["stream"] == "own" and mountings > 1
    if answers["stream"] == "own" and not several:
        own = f" --recording FILE --columns {folder}/columns.toml"
    connect = (
        f"connect the IMU, and describe it as [[imu]] in {folder}/rig.toml: a recording of its own logger can be used "
        f"only of a run in one mounting, and this plan has {mountings}"
    )
    return [
        *([connect] if several else []),
        f"gradcal check {folder}/spec.toml",
        f"gradcal predict {folder}/spec.toml",
        f"gradcal optimise {folder}/spec.toml{as_it_is} -o {folder}/recipe.toml",
        f"gradcal run {folder}/recipe.toml --simulate -o {folder}/rehearsal",
        f"gradcal rig check {folder}/rig.toml",
        f"gradcal run {folder}/recipe.toml --rig {folder}/rig.toml -o {folder}/run",
        f"gradcal log {folder}/run{own}",
        f"gradcal estimate {folder}/run/log.nc --spec {folder}/recipe.toml -o {folder}/run/calibration.toml",
        f"gradcal report {folder}/run -o {folder}/report.html",
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
