"""`gradcal start`: ten questions, and a spec, a rig file and a column map to work with."""

import sys

from gradcal_jax.cli.output import Flag, Output, writable
from gradcal_jax.cli.status import DONE


def start(*, output: Output, preset: str | None = None, force: Flag = False) -> int:
    """Answer ten questions, and get a spec with a plan, a rig file and a column map, each commented.

    Parameters
    ----------
    output
        The directory for spec.toml, rig.toml and columns.toml; it is made where there is none.
    preset
        Ask nothing, and take the answers for drone-imu, tactical-imu or no-encoder.
    force
        Overwrite existing files.
    """
    from gradcal_jax.files import begin, parse_spec
    from gradcal_jax.files.writing import write_whole

    if output.exists() and not output.is_dir():
        raise ValueError(f"{output} is a file; name a directory")
    answers = _asked() if preset is None else begin.preset(preset)
    texts = begin.files_of(answers)
    parse_spec(texts["spec.toml"], str(output / "spec.toml"))
    output.mkdir(parents=True, exist_ok=True)
    for name in texts:
        writable(output / name, force)
    for name, text in texts.items():
        write_whole(output / name, text)
    print(f"wrote {', '.join(str(output / name) for name in texts)}")
    print("next, in this order:")
    # A search makes turns of a motor, and a hand's are as they are.
    as_it_is = " --steps 0" * (answers["angle"] == begin.NO_ENCODER)
    for line in (
        f"gradcal predict {output / 'spec.toml'}",
        f"gradcal optimise {output / 'spec.toml'}{as_it_is} -o {output / 'recipe.toml'}",
        f"gradcal run {output / 'recipe.toml'} --simulate -o {output / 'rehearsal'}",
        f"gradcal rig check {output / 'rig.toml'}",
    ):
        print(f"  {line}")
    return DONE


def _asked() -> dict[str, str]:
    """Read the answers, one a line; an empty line takes the default. On a terminal, a wrong answer is asked again."""
    from gradcal_jax.files.begin import PRESETS, QUESTIONS, understood

    answers: dict[str, str] = {}
    usual = next(iter(PRESETS.values()))
    for number, question in enumerate(QUESTIONS, 1):
        while True:
            print(f"{number}. {question.asks} [{usual[question.name]}] ", end="", flush=True)
            line = sys.stdin.readline()
            if not line:
                raise ValueError(f"the answers ended at question {number} of {len(QUESTIONS)}: {question.asks}")
            answer = line.strip() or usual[question.name]
            try:
                understood(question, answer)
            except ValueError as error:
                if not sys.stdin.isatty():
                    raise ValueError(f"{question.asks} {answer!r}: {error}") from None
                print(f"   {error}")
                continue
            answers[question.name] = answer
            break
    return answers
