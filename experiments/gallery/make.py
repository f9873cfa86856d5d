"""Makes docs/gallery.md and its thumbnails: a picture of each function of `gradcal_jax.plots`, one of each notebook.

python experiments/gallery/make.py, in about two minutes. Everything in the pictures is simulated but for the recorded
sensor of one notebook.
"""

import base64
import functools
import inspect
import io
import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import Rotation

jax.config.update("jax_enable_x64", True)

import gradcal_jax as gj  # noqa: E402
from gradcal_jax import plots  # noqa: E402
from gradcal_jax.estimation.estimate import EstimateReport  # noqa: E402
from gradcal_jax.estimation.hand_estimate import HandReport  # noqa: E402
from gradcal_jax.information.imu_residual import ImuResidual, imu_residual  # noqa: E402
from gradcal_jax.model.imu_build import build_imu, imu_posterior  # noqa: E402
from gradcal_jax.plots.residual import boxes_of  # noqa: E402
from gradcal_jax.recipe.recipe import Recipe  # noqa: E402

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "gallery"
WIDTH = 320
SMALL = {
    "sensor.gyro.scale_factor.temperature.degree": 1,
    "sensor.gyro.scale_factor.rate.degree": 1,
    "plan.temperature": ["20 degC", "26 degC"],
    "plan.soak": {"duration": "60 s", "used": False},
    "plan.cycle.moves": [
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "1080 deg", "peak_rate": "150 deg/s", "shape": "cosine ramps"},
        {"rest": "20 s", "read_every": "1 s"},
        {"turn": "-1080 deg", "peak_rate": "60 deg/s", "shape": "cosine ramps"},
    ],
    "plan.cycle.other_axes": None,
}
OF_NOTEBOOKS = {
    "draw_sweep": "a_sweep_read_with_xarray",
    "draw_frontier": "designing_a_plan",
    "draw_sensitivities": "designing_a_plan",
    "draw_drift": "instability_of_a_real_sensor",
    "draw_loop": "the_ramp_goes_both_ways",
}
"""Pictures that a notebook has drawn already."""


def main() -> None:
    PICTURES.mkdir(exist_ok=True)
    for name, figure in drawn().items():
        image = io.BytesIO()
        figure.savefig(image, dpi=100)
        thumbnail(image, name)
    for name, notebook in OF_NOTEBOOKS.items():
        thumbnail(pictures_of(notebook, name)[0], name)
    notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for path in notebooks:
        thumbnail(pictures_of(path.stem)[0], path.stem)
    (ROOT / "docs" / "gallery.md").write_text(page(notebooks), encoding="utf-8")


def drawn() -> dict[str, Figure]:
    """The pictures that no notebook has."""
    spec = gj.changed(gj.parse_spec(gj.presets.text("paper-dynamic-gradient")), SMALL)
    turns = gj.parse_spec(gj.presets.text("rig-3arcsec"))
    imu = gj.parse_spec(gj.presets.text("two-axis-table"))
    mission = gj.read_spec(ROOT / "experiments" / "missions" / "plans" / "hover.toml")
    coarse = gj.changed(turns, {"rig.table.axis[0].angle.reading_noise": "30 arcsec"})
    recipe = gj.make_recipe(spec)
    with tempfile.TemporaryDirectory() as folder:
        report = calibrated(recipe, Path(folder) / "run", 0)
    (calibration,) = report.calibrations
    noise = 2e-4 * np.random.default_rng(0).standard_normal(400_000)
    deviation, fit = gj.allan(noise + np.cumsum(2e-8 * noise / 2e-4), rate=100.0)
    by_rate, over_t = ((row, np.degrees(row.rates)) for row in residuals(turns))
    figures = {
        "draw_prediction": plots.draw_prediction(imu),
        "draw_comparison": plots.draw_comparison([("30 arcsec", turns), ("0.05 deg", coarse)]),
        "draw_poses": plots.draw_poses(imu),
        "draw_requirement": plots.draw_requirement(imu, "accelerometer bias"),
        "draw_map": plots.draw_map(by_rate[0].temperatures, by_rate[1], by_rate[0].values[0], "ppm"),
        "draw_worst_over_temperature": plots.draw_worst_over_temperature(by_rate[1], by_rate[0].values[0], "ppm"),
        "draw_over_temperature": plots.draw_over_temperature(over_t[0].temperatures, over_t[0].values[0], "deg/h"),
        "draw_curves": plots.draw_curves(boxes_of(over_t[0], "bias"), target=4.0),
        "draw_temperature": plots.draw_temperature(gj.timeline(turns)),
        "draw_planned_temperature": plots.draw_planned_temperature(recipe),
        "draw_planned_rate": plots.draw_planned_rate(recipe, "x"),
        "draw_calibrated_scale_factor": plots.draw_calibrated_scale_factor(calibration, calibration.channel[0]),
        "draw_calibrated_term": plots.draw_calibrated_term(calibration, "gyro", "bias"),
        "draw_residuals_over_time": plots.draw_residuals_over_time(report.sensors[0]),
        "draw_allan": plots.draw_allan(deviation, fit),
        "draw_boundary": plots.draw_boundary(gj.instability(noise, rate=100.0)),
        "draw_heading": plots.draw_requirement(mission, mission.requirement[0].name),
        "draw_gravity_left": plots.draw_gravity_left(by_hand()),
        "draw_turns_left": plots.draw_turns_left(by_hand()),
    }
    return {name: figure_of(one) for name, one in figures.items()}


def calibrated(recipe: Recipe, folder: Path, seed: int) -> EstimateReport:
    """The estimate of a run on simulated devices, of a sensor with a number of its own."""
    gj.run(recipe, folder, simulate=True, seed=seed)
    return gj.estimate(recipe.spec, replace(gj.log(folder), units=(f"SN {seed + 1}",)))


def residuals(spec: gj.Spec) -> list[ImuResidual]:
    """The residual of each requirement."""
    built = build_imu(spec)
    known = imu_posterior(built)
    return [imu_residual(built, known, requirement) for requirement in spec.requirement]


@functools.cache
def by_hand() -> HandReport:
    """A simulated IMU that is laid down in 24 positions, and turned by hand from one to the next."""
    rng = np.random.default_rng(1)
    rest, turn, rate = 500, 100, 100.0
    attitude, rows, forces = np.eye(3), [np.zeros((rest, 3))], [np.tile([0.0, 0.0, 9.81], (rest, 1))]
    for _ in range(24):
        axis = rng.standard_normal(3)
        axis *= rng.uniform(1.0, 2.5) / np.linalg.norm(axis)
        rows += [np.tile(axis / (turn / rate), (turn, 1)), np.zeros((rest, 3))]
        steps = [Rotation.from_rotvec(-axis * k / turn).as_matrix() @ attitude for k in range(1, turn + 1)]
        forces += [np.array(steps) @ [0.0, 0.0, 9.81]]
        attitude = steps[-1]
        forces.append(np.tile(forces[-1][-1], (rest, 1)))
    turned, force = np.concatenate(rows), np.concatenate(forces)
    log = gj.log_from(
        np.arange(len(turned)) / rate,
        1.001 * turned + 1e-3 + 1e-3 * rng.standard_normal(turned.shape),
        force=1.002 * force + 0.02 + 5e-3 * rng.standard_normal(force.shape),
        temperature=np.full(len(turned), 23.0),
        simulated=True,
    )
    (report,) = gj.estimate_by_hand(log, 9.81)
    return report


def figure_of(drawn: Any) -> Figure:
    """The figure of what a function returned: it, axes, or artists with their axes."""
    axes = drawn if isinstance(drawn, Axes | Figure) else drawn[0]
    figure = axes if isinstance(axes, Figure) else axes.get_figure(root=True)
    assert isinstance(figure, Figure)
    return figure


def pictures_of(notebook: str, function: str = "") -> list[io.BytesIO]:
    """The pictures of a notebook's cells that call a function; of all cells, without one."""
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    outputs = [o for cell in cells if function in "".join(cell["source"]) for o in cell.get("outputs", [])]
    images = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    return [io.BytesIO(base64.b64decode(image)) for image in images]


def thumbnail(image: io.BytesIO, name: str) -> None:
    """A picture of at most `WIDTH` pixels."""
    image.seek(0)
    with Image.open(image) as picture:
        picture.convert("RGB").resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.LANCZOS).quantize(
            128
        ).save(PICTURES / f"{name}.png", optimize=True)


def page(notebooks: list[Path]) -> str:
    """The page, in Markdown."""
    lines = [
        "# Gallery",
        "",
        "This page is made by `experiments/gallery/make.py`. Every picture shows simulated devices, except the picture",
        "of the notebook on a real sensor.",
        "",
        "## Notebooks",
        "",
        "| | |",
        "|---|---|",
    ]
    for path in notebooks:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        title = "".join(cells[0]["source"]).splitlines()[0].lstrip("# ")
        lines.append(f"| ![{title}](gallery/{path.stem}.png) | [{title}](../notebooks/{path.name}) |")
    lines += ["", "## Functions of `gradcal_jax.plots`", ""]
    lines += [
        "Each function draws on `ax`, or on `figure` (a figure or subfigure) if it needs several axes. If you pass",
        "neither, it makes a new figure. It returns what it drew; `plots.save(figure, path)` writes it to a file.",
        "",
    ]
    lines += ["| | |", "|---|---|"]
    for name in sorted(n for n in plots.__all__ if n.startswith("draw_")):
        function = getattr(plots, name)
        first = " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split()).split("Errors:")[0].strip()
        arguments = ", ".join(inspect.signature(function).parameters)
        shown = first.replace("|", "\\|")
        lines.append(f"| ![{name}](gallery/{name}.png) | `{name}({arguments})`<br>{shown} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
