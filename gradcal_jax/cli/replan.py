"""`gradcal optimise RUN`: the best plan for the rest of an interrupted run."""

from pathlib import Path

from gradcal_jax.cli.output import as_json
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.cli.status import DONE, INTERRUPTED, NOT_AS_WISHED


def plan_the_rest(run: Path, output: Path, *, time: str | None, pause: str, quick: bool, json: bool) -> int:
    """Search for the best plan of the rest of an interrupted run, and write it as a recipe. The part that was done by
    the journal counts in every prediction. `time`, `pause`: options of the command."""
    from gradcal_jax.cli import optimise as searches
    from gradcal_jax.files import write_toml
    from gradcal_jax.hardware.run_folder import RunFolder, prepare_resume, stretches_of
    from gradcal_jax.units import parse, time_text

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
    write_toml(result, output, header="Made by gradcal optimise; `gradcal check` prints it as a table.")
    if json:
        print(as_json(record_of(best) | {"done": spans, "recipe": str(output)}))
    else:
        print(searches.optimum_text(best))
        print(f"wrote {output}, {remark}; next step: gradcal run {output} --resume {run}")
    return code
