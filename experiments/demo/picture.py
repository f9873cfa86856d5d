"""The figure of the README: the residual of the paper's plan, as predicted for the optimised plan, and as achieved.

gradcal demo && python experiments/demo/picture.py gradcal-demo
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from gradcal_jax import plots
from gradcal_jax.cli.precision import use_float64
from gradcal_jax.pages.residuals import residuals_of
from gradcal_jax.pages.sources import read_sources
from gradcal_jax.plots.residual import boxes_of


def main(folder: Path) -> None:
    use_float64()
    (paper, *_), (full, *_) = (residuals_of(read_sources([folder / name])) for name in ("paper.toml", "run"))
    stages = full.stages | {"before": paper.stages["predicted"]}
    figure, axes = plt.subplots(2, 2, figsize=(10.0, 7.4), layout="constrained")
    values = np.concatenate([left.values[0].ravel() for left in stages.values()])
    colours = LogNorm(np.min(values), np.max(values))
    for ax, (stage, left) in zip(axes.flat, stages.items(), strict=False):
        _, mesh = plots.draw_map(
            left.temperatures, np.degrees(left.rates), left.values[0], left.unit, title=stage, ax=ax
        )
        mesh.set_norm(colours)
    plots.draw_curves([box for stage, left in stages.items() for box in boxes_of(left, stage)], ax=axes[1, 1])
    figure.savefig(Path(__file__).with_name("residual.png"), dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
