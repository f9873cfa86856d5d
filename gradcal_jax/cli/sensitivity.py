"""`gradcal sensitivity`: the effect of a better encoder, a longer ramp, a quieter sensor on the residual."""

from pathlib import Path

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Json, Plot, as_json, drawable, save_figure
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import amount, columns

# Smaller changes, in per cent, are not shown.
_NOTHING = 5e-4


def sensitivity(spec: Path, /, *, json: Json = False, plot: Plot = None) -> int:
    """Print the change of the residual, in per cent, for one per cent more of every figure of sensor, rig and plan.

    For an optimised recipe the change is the same after the plan is optimised again.

    Parameters
    ----------
    spec
        The spec file, or a recipe.
    json
        Print the sensitivities for other programs.
    plot
        Draw them as bars into this file.
    """
    from gradcal_jax.files.recipe import spec_in

    drawable(plot)
    specification = spec_in(spec)
    use_float64()
    from gradcal_jax.api.sensitivity import sensitivity

    known = sensitivity(specification)
    if json:
        rows = [row._asdict() for row in known.rows]
        print(as_json({"residuals": known.residuals, "percent_per_percent": rows}))
    else:
        print(strong(specification.title or str(spec)))
        for name, (value, unit) in known.residuals.items():
            print(f"\n{name}: {amount(value, unit)}; one per cent more of ... changes it by")
            shown = [row for row in known.rows if row.requirement == name and abs(row.percent) >= _NOTHING]
            print(columns([(row.figure, f"{row.percent:+.3f} %") for row in shown], right=(1,)))
    save_figure(lambda plots: plots.draw_sensitivities(known), plot, quiet=json)
    return DONE
