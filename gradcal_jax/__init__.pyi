"""The public names for type checkers, who cannot follow names that load on first use."""

from typing import Final

from gradcal_jax.api import monte_carlo as monte_carlo
from gradcal_jax.api import predict as predict
from gradcal_jax.api import recipe as recipe
from gradcal_jax.api import timeline as timeline
from gradcal_jax.api.calibrations import lot as lot
from gradcal_jax.api.hand_estimate import estimate_by_hand as estimate_by_hand
from gradcal_jax.api.limit import limit as limit
from gradcal_jax.api.log_flow import allan as allan
from gradcal_jax.api.log_flow import estimate as estimate
from gradcal_jax.api.log_flow import instability as instability
from gradcal_jax.api.optimise import frontier as frontier
from gradcal_jax.api.optimise import optimise as optimise
from gradcal_jax.api.optimise import replan as replan
from gradcal_jax.api.plan_sentences import check as check
from gradcal_jax.api.sensitivity import differentiable as differentiable
from gradcal_jax.api.sensitivity import sensitivity as sensitivity
from gradcal_jax.api.validation import validate as validate
from gradcal_jax.decoding.run_log import log as log
from gradcal_jax.files import Spec as Spec
from gradcal_jax.files import SpecError as SpecError
from gradcal_jax.files import changed as changed
from gradcal_jax.files import parse_spec as parse_spec
from gradcal_jax.files import presets as presets
from gradcal_jax.files import read_spec as read_spec
from gradcal_jax.files import schema as schema
from gradcal_jax.files import write_toml as write_toml
from gradcal_jax.files.calibration import Calibration as Calibration
from gradcal_jax.files.calibration import read_calibration as read_calibration
from gradcal_jax.files.calibration import write_calibration as write_calibration
from gradcal_jax.files.calibration.correction import apply as apply
from gradcal_jax.files.calibration.exports import export as export
from gradcal_jax.files.log.importers import import_log as import_log
from gradcal_jax.files.log.log import Log as Log
from gradcal_jax.files.log.log_file import read_log as read_log
from gradcal_jax.files.log.log_file import write_log as write_log
from gradcal_jax.files.log.log_from import log_from as log_from
from gradcal_jax.files.run.recipe import read_recipe as read_recipe
from gradcal_jax.files.run.sweep import read_sweep as read_sweep
from gradcal_jax.files.spec.rig import read_rig as read_rig
from gradcal_jax.hardware.execute import resume as resume
from gradcal_jax.hardware.execute import run as run
from gradcal_jax.identify.limiting_function import limiting_function as limiting_function
from gradcal_jax.identify.limiting_function import limiting_function_of_mean as limiting_function_of_mean
from gradcal_jax.identify.thermal import fit_thermal_bias as fit_thermal_bias
from gradcal_jax.information import posterior as posterior
from gradcal_jax.information import residual as residual
from gradcal_jax.jobs.dataset import read_dataset as read_dataset
from gradcal_jax.jobs.sweep import sweep as sweep
from gradcal_jax.model import SensorModel as SensorModel
from gradcal_jax.pages.page import report as report
from gradcal_jax.trajectory import gradient_plan as gradient_plan
from gradcal_jax.trajectory import programme as programme
from gradcal_jax.trajectory import rest as rest
from gradcal_jax.trajectory import standard_plan as standard_plan
from gradcal_jax.trajectory import turn as turn

__version__: Final[str]
__all__: Final[list[str]]
