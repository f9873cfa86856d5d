"""The command-line application: all commands, and the handling of their errors."""

import contextlib
import os
import sys
from collections.abc import Sequence
from typing import Any, Final

from cyclopts import App, CycloptsError, Group

import gradcal_jax
from gradcal_jax.cli.calibrated import apply, export, validate
from gradcal_jax.cli.check import check
from gradcal_jax.cli.demo import demo
from gradcal_jax.cli.estimate import estimate
from gradcal_jax.cli.log import log
from gradcal_jax.cli.noise import noise
from gradcal_jax.cli.optimise import optimise
from gradcal_jax.cli.output import BROKEN_PIPE, DONE, FAILED, INTERRUPTED, WRONG_INPUT, complain, is_plain
from gradcal_jax.cli.predict import limit, predict
from gradcal_jax.cli.report import report
from gradcal_jax.cli.rig import rig_app
from gradcal_jax.cli.run import run as run_command
from gradcal_jax.cli.start import start
from gradcal_jax.cli.sweep import sweep

_HELP: Final = """Plan and run calibrations of gyros, accelerometers and IMUs, and predict the errors that remain.

A spec file describes sensor, rig and plan. Begin with `gradcal start`.
"""

GROUPS: Final[tuple[tuple[str, tuple[Any, ...]], ...]] = (
    ("Begin", (demo, start, check)),
    ("Predict the result, and find a plan", (predict, optimise, limit)),
    ("Execute a plan", (rig_app, run_command, log)),
    ("Calibrate", (estimate, apply, validate, export, report)),
    ("Measure the noise of a sensor", (noise,)),
    ("Compute many plans", (sweep,)),
)
"""The commands in the order of work, as `gradcal --help` lists them."""


def build() -> App:
    """The application with every command."""
    app = App(
        name="gradcal",
        help=_HELP,
        version=gradcal_jax.__version__,
        help_format="plaintext",  # a Markdown reader would cost a quarter of the start-up
        help_formatter="plain" if is_plain(sys.stdout) else "default",
    )
    # Completion of commands and options by the tab key, for bash, zsh and fish.
    app.register_install_completion_command(add_to_startup=False)
    for number, (title, commands) in enumerate(GROUPS):
        group = Group(title, sort_key=number)
        for place, command in enumerate(commands):
            app.command(command)
            added = command if isinstance(command, App) else app[command.__name__]
            added.group, added.sort_key = (group,), place
    return app


def run(arguments: Sequence[str] | None = None) -> int:
    """Parse and run one command line; every expected failure is a sentence on stderr and an exit status."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot show ° or √ gets a replacement, not a traceback.
        if (reconfigure := getattr(stream, "reconfigure", None)) is not None:
            reconfigure(errors="replace")
    try:
        app = build()
        tokens = sys.argv[1:] if arguments is None else list(arguments)
        command, bound, _ = app.parse_args(tokens, console=_wide(tokens), exit_on_error=False, print_error=False)
        status = command(*bound.args, **bound.kwargs)
        sys.stdout.flush()
        return status if isinstance(status, int) else DONE
    except CycloptsError as error:
        complain(f"{error}\nSee gradcal --help.")
        return WRONG_INPUT
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
    if not is_plain(sys.stdout) or not (set(tokens) & {"--help", "-h"} or not tokens):
        return None
    from rich.console import Console

    return Console(width=120, no_color=True, soft_wrap=True)


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
