"""The public names for type checkers, who cannot follow names that load on first use."""

from typing import Final

from gradcal_jax.calibration.correction import apply as apply
from gradcal_jax.calibration.exports import export as export
from gradcal_jax.calibration.file import Calibration as Calibration
from gradcal_jax.calibration.file import read_calibration as read_calibration
from gradcal_jax.calibration.file import write_calibration as write_calibration
from gradcal_jax.design.optimise import optimise as optimise
from gradcal_jax.design.plan_limit import limit as limit
from gradcal_jax.design.recipe_of_plan import make_recipe as make_recipe
from gradcal_jax.estimation.hand_estimate import estimate_by_hand as estimate_by_hand
from gradcal_jax.estimation.log_flow import allan as allan
from gradcal_jax.estimation.log_flow import estimate as estimate
from gradcal_jax.estimation.log_flow import noise as noise
from gradcal_jax.estimation.validation import validate as validate
from gradcal_jax.hardware.execute import resume as resume
from gradcal_jax.hardware.execute import run as run
from gradcal_jax.identify.limiting_function import limiting_function as limiting_function
from gradcal_jax.identify.limiting_function import limiting_function_of_mean as limiting_function_of_mean
from gradcal_jax.identify.thermal import fit_thermal_bias as fit_thermal_bias
from gradcal_jax.information.differentiable import differentiable as differentiable
from gradcal_jax.information.plan_sentences import check as check
from gradcal_jax.information.prediction import predict as predict
from gradcal_jax.information.sensitivity import sensitivity as sensitivity
from gradcal_jax.pages.page import report as report
from gradcal_jax.recipe.recipe import read_recipe as read_recipe
from gradcal_jax.records.importers import import_log as import_log
from gradcal_jax.records.log import Log as Log
from gradcal_jax.records.log_file import read_log as read_log
from gradcal_jax.records.log_file import write_log as write_log
from gradcal_jax.records.log_from import log_from as log_from
from gradcal_jax.records.run_log import log as log
from gradcal_jax.spec import presets as presets
from gradcal_jax.spec.changes import changed as changed
from gradcal_jax.spec.rig import read_rig as read_rig
from gradcal_jax.spec.spec import Spec as Spec
from gradcal_jax.spec.spec import parse_spec as parse_spec
from gradcal_jax.spec.spec import read_spec as read_spec
from gradcal_jax.sweeps.sweep import read_dataset as read_dataset
from gradcal_jax.sweeps.sweep import sweep as sweep
from gradcal_jax.sweeps.sweep_file import read_sweep as read_sweep
from gradcal_jax.tables.problems import SpecError as SpecError
from gradcal_jax.tables.schemas import schema as schema
from gradcal_jax.tables.writing import write_toml as write_toml

__version__: Final[str]
__all__: Final[list[str]]
