"""`gradcal replan`: the best plan for the rest of an interrupted run."""

from gradcal_jax.cli.output import Flag, Force, Json, Output, RunPath, as_json, writable
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE, INTERRUPTED, NOT_AS_WISHED


def replan(
    run: RunPath,
    /,
    *,
    output: Output,
    time: str | None = None,
    pause: str = "30 min",
    quick: Flag = False,
    force: Force = False,
    json: Json = False,
) -> int:
    """Find the best plan for the rest of an interrupted run, and write it as a recipe.

    The part that was done by the journal counts in every prediction; the rest is searched anew, on a ramp from where
    the chamber's course stopped. The unit must not have been switched off meanwhile: both parts are one run, with one
    turn-on bias. Of a whole unit, whole cycles count, and its poses and moves are searched anew. Go on with: gradcal
    run NEW --resume RUN. The exit status is 1 where the search did not converge.

    Parameters
    ----------
    output
        The recipe file to write.
    time
        How long the rest may take, waiting not counted, such as "40 min"; absent: the recipe's time that is left.
    pause
        Time from the end of the run to where it goes on; a whole unit's drifts begin anew.
    quick
        Few starts, or plans: within some per cent of the best, in seconds.
    json
        Print the result for other programs.
    """
    from gradcal_jax.cli import optimise as searches
    from gradcal_jax.files import write_toml
    from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume
    from gradcal_jax.hardware.stretches import stretches_of
    from gradcal_jax.units import parse, time_text

    writable(output, force)
    folder = RunFolder(run)
    left_s, pause_s = None if time is None else parse(time, "time"), parse(pause, "time")
    prepare_resume(folder)
    recipe = folder.recipe()
    done = stretches_of(folder)
    use_float64()
    from gradcal_jax import api
    from gradcal_jax.api.replan import rest_of
    from gradcal_jax.api.search_results import record_of

    spans = [(part.start_s, part.end_s) for part in done]
    rest = rest_of(recipe.spec, spans, left_s=left_s, pause_s=pause_s)
    best, interrupted = searches.search_and_watch(rest, quick=quick)
    status = f"interrupted, the best so far: {best.sentence}" if interrupted else ""
    code = INTERRUPTED if interrupted else DONE if best.converged else NOT_AS_WISHED
    seconds = sum(end - begin for begin, end in spans)
    remark = f"after {time_text(float(round(seconds)))} with data were done; its prediction counts them"
    notes = (f"the rest of a run, {remark}",)
    result = api.recipe(best, stability=recipe.stability, status=status, notes=notes)
    write_toml(result, output, header="Made by gradcal replan; `gradcal show` prints it as a table.")
    if json:
        print(as_json(record_of(best) | {"done": spans, "recipe": str(output)}))
    else:
        print(searches.optimum_text(best))
        print(f"wrote {output}, {remark}; go on with: gradcal run {output} --resume {run}")
    return code
