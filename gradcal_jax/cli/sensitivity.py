"""`gradcal sensitivity`: what a better encoder, a longer ramp, a quieter sensor is worth."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from gradcal_jax.cli.console import columns, strong

# Less than this share of a per cent is nothing.
_NOTHING = 5e-4


def register(app: App) -> None:
    """Add the commands of this family."""
    app.command(sensitivity)


def sensitivity(
    spec: Path,
    /,
    *,
    json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    plot: Path | None = None,
) -> int:
    """Say what one per cent more of every figure of sensor, rig and plan changes, in per cent of the residual.

    For an optimised recipe this is also what is left of the change once the plan is optimised again.

    Parameters
    ----------
    spec
        The spec file, or a recipe.
    json
        Print the sensitivities for other programs.
    plot
        Draw them as bars into this file.
    """
    from gradcal_jax.cli.precision import use_float64
    from gradcal_jax.cli.specs import read_spec

    found = read_spec(spec)
    use_float64()
    from gradcal_jax.assemble.sensitivity import sensitivities

    known = sensitivities(found)
    if plot is not None:
        from gradcal_jax import plots

        plots.save(plots.draw_sensitivities(known), plot)
    if json:
        from json import dumps

        rows = [row._asdict() for row in known.rows]
        print(dumps({"residuals": known.residuals, "percent_per_percent": rows}, indent=2))
        return 0
    print(strong(found.title or str(spec)))
    for name, (value, unit) in known.residuals.items():
        print(f"\n{name}: {value:.4g} {unit}; one per cent more of ... changes it by")
        shown = [row for row in known.rows if row.requirement == name and abs(row.percent) >= _NOTHING]
        print(columns([(row.figure, f"{row.percent:+.3f} %") for row in shown], right=(1,)))
    if plot is not None:
        print(f"wrote {plot}")
    return 0
