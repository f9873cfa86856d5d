"""`gradcal limit`: the proven lower limit on the residual of any plan."""

from pathlib import Path

from gradcal_jax.cli.console import strong
from gradcal_jax.cli.output import Json, as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE
from gradcal_jax.pages.plain_text import amount, columns


def limit(spec: Path, /, *, json: Json = False) -> int:
    """Prove a lower limit for all plans on this rig in this time, and print the efficiency of this plan.

    The proof leaves out some limits of the rig, and lists them, so a real plan may not reach the limit; no plan lies
    below it. An efficiency of 67 % means that no plan leaves less than 0.67 of the residual of this one.

    Parameters
    ----------
    spec
        The spec file, or a recipe. Its [design] states what a better plan might change; for an IMU, the limit is for
        every plan of the same duration at the same temperatures.
    json
        Print the limits for other programs.
    """
    from gradcal_jax.files.recipe import spec_in

    specification = spec_in(spec)
    use_float64()
    from gradcal_jax.api.flow import limit as limit_of

    rows = limit_of(specification)
    if json:
        print(as_json([row._asdict() for row in rows]))
        return DONE
    table = [("requirement", "no plan leaves less than", "relaxed problem reaches", "this plan leaves", "efficiency")]
    for row in rows:
        share = "" if row.efficiency is None else f"{row.efficiency:.0%}"
        bounds = amount(row.certified, row.unit), amount(row.reached, row.unit)
        table.append((f"{row.name} ({row.statistic})", *bounds, amount(row.value, row.unit), share))
    print(strong(specification.title or str(spec)))
    print(columns(table, indent=""))
    for row in rows:
        if row.judged is not None and row.judged != row.value:
            print(
                f"{row.name}: including the omitted terms with typical figures, no plan leaves less than "
                f"{amount(row.counted, row.unit)}, and this one leaves {amount(row.judged, row.unit)}"
            )
    for kept in dict.fromkeys(row.kept for row in rows if row.kept):
        print("of plans that keep: " + "; ".join(kept))
    for relaxed in dict.fromkeys(row.relaxed for row in rows):
        names = ", ".join(row.name for row in rows if row.relaxed == relaxed)
        of = "" if all(row.relaxed == relaxed for row in rows) else f" for {names}"
        print(f"the proof{of} relaxes: " + "; ".join(relaxed))
    return DONE
