"""The command-line application: all commands, and the handling of their errors."""

import contextlib
import os
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import gradcal_jax
from gradcal_jax.cli.output import BROKEN_PIPE, DONE, FAILED, INTERRUPTED, WRONG_INPUT, complain, is_plain

if TYPE_CHECKING:
    from cyclopts import App

_HELP: Final = """Plan and run calibrations of gyros, accelerometers and IMUs, and predict the errors that remain.

A spec file describes sensor, rig and plan. Begin with `gradcal start`.
"""
GROUPS: Final[Mapping[str, Mapping[str, str]]] = {
    "Begin": {
        "demo:demo": "Run the whole procedure in about a minute, on simulated devices.",
        "start:start": "Ask questions about sensor and rig, and write a spec, a rig file and a column map.",
        "check:check": "List all errors of a spec, or describe its plan; print a recipe as a table.",
    },
    "Predict the result, and find a plan": {
        "predict:predict": "Predict the error that remains after the plan, for every requirement.",
        "optimise:optimise": "Minimise this error, and write the new plan as a recipe.",
        "predict:limit": "Prove a lower limit for the error of all plans on this rig.",
    },
    "Execute a plan": {
        "rig:rig_app": "Check the devices of a rig, or watch a run.",
        "run:run": "Execute a recipe on a rig, or rehearse it on simulated devices.",
        "log:log": "Write the log of a run: samples, angles, temperatures and standstills.",
    },
    "Calibrate": {
        "estimate:estimate": "Estimate a calibration from a log, and test the model of the spec.",
        "calibrated:apply": "Correct the rates and specific forces of a log with a calibration.",
        "calibrated:validate": "Test a calibration on a different log.",
        "calibrated:export": "Write a calibration in the format of another program.",
        "report:report": "Make one HTML page that describes a plan, a run or a calibration.",
    },
    "Measure the noise of a sensor": {"noise:noise": "Print the noise of a record at rest."},
    "Compute many plans": {"sweep:sweep": "Predict the plan of a spec for many values of its keys."},
}
"""The commands in the order of work, as `gradcal --help` lists them: the purpose of each, by module and name."""


def build() -> "App":
    """The application with every command; a command is imported when it is used."""
    from cyclopts import App, Group, Parameter

    app = App(
        name="gradcal",
        default_parameter=Parameter(show_default=_default),
        help=_HELP,
        version=gradcal_jax.__version__,
        help_format="plaintext",  # a Markdown reader would cost a quarter of the start-up
        help_formatter="plain" if is_plain(sys.stdout) else "default",
    )
    # Completion of commands and options by the tab key, for bash, zsh and fish.
    app.register_install_completion_command(add_to_startup=False)
    for number, (title, commands) in enumerate(GROUPS.items()):
        group = Group(title, sort_key=number)
        for place in commands:
            app.command(f"gradcal_jax.cli.{place}", name=_name(place), group=group)
    return app


def _default(value: Any) -> str | None:
    """A default as help shows it; None: that of a flag, or nothing."""
    return None if value is False or value in (None, "", ()) else str(value)


def _name(place: str) -> str:
    """The name of the command at a place."""
    return place.partition(":")[2].removesuffix("_app")


def _help() -> str:
    """What `gradcal --help` prints, which needs no import."""
    lines = ["Usage: gradcal COMMAND", "", _HELP, "Commands:"]
    lines += ["  --help, -h: Display this message and exit.", "  --version: Display application version."]
    lines += ["  --install-completion: Install shell completion for this application."]
    for title, commands in GROUPS.items():
        lines += ["", f"{title}:", *(f"  {_name(place)}: {purpose}" for place, purpose in commands.items())]
    lines += ["", "The options of a command: gradcal COMMAND --help"]
    return "\n".join(lines)


def run(arguments: Sequence[str] | None = None) -> int:
    """Parse and run one command line; every expected failure is a sentence on stderr and an exit status."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot show ° or √ gets a replacement, not a traceback.
        if (reconfigure := getattr(stream, "reconfigure", None)) is not None:
            reconfigure(errors="replace")
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    try:
        if tokens in ([], ["-h"], ["--help"]):
            print(_help())
            sys.stdout.flush()
            return DONE
        app = build()
        command, bound, _ = app.parse_args(tokens, console=_wide(tokens), exit_on_error=False, print_error=False)
        status = command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
        return status if isinstance(status, int) else DONE
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe (`gradcal … | head`); keep the interpreter from reporting it at exit.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except SystemExit as error:
        # Printing help ends the program by itself when its reader has closed the pipe.
        return BROKEN_PIPE if error.code == 1 else DONE if error.code in (None, 0) else WRONG_INPUT
    except MemoryError as error:
        complain(_too_large(error))
        return WRONG_INPUT
    except Exception as error:
        if type(error).__module__.startswith("cyclopts"):
            complain(_of_command_line(error))
            return WRONG_INPUT
        # A device or a run can have failed only where a command has loaded the hardware package.
        errors = sys.modules.get("gradcal_jax.hardware.errors")
        status = FAILED if errors is not None and isinstance(error, errors.HardwareError) else WRONG_INPUT
        if "RESOURCE_EXHAUSTED" in str(error):
            complain(_too_large(error))
            return WRONG_INPUT
        foreseen = status == FAILED or isinstance(error, ValueError | OSError)
        if not foreseen or os.environ.get("GRADCAL_TRACEBACK"):
            raise
        complain(_sentence(error))
        return status


def _too_large(error: BaseException) -> str:
    text = str(error).splitlines()[0] if str(error) else ""
    if text and not text.startswith(("Unable", "RESOURCE", "std::")):
        return text  # a message of this program
    detail = f" ({text[:160]})" if text else ""
    return (
        f"out of memory{detail}: read less often, use a shorter plan or a part of the log (--rows), or fewer IMUs "
        "at once; gradcal check --json states the memory that a plan needs"
    )


def _wide(tokens: Sequence[str]) -> Any:
    """A console that does not fold help at 80 columns away from a terminal; None where no help is requested."""
    if not is_plain(sys.stdout) or not set(tokens) & {"--help", "-h"}:
        return None
    from rich.console import Console

    return Console(width=120, no_color=True, soft_wrap=True)


def _of_command_line(error: Any) -> str:
    """What is wrong with a command line, and where its options are listed."""
    command = " ".join(["gradcal", *(error.command_chain or ())])
    text = str(error)
    if type(error).__name__ == "MissingArgumentError":
        text = f"the value of {error.keyword} is missing" if error.keyword else f"{error.argument.name} is missing"
    return f"{text}\nSee {command} --help."


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
