# What type checkers and editors see of the lazily loaded public face.

from habitus.body.soft_tissue import simulate_soft_tissue as simulate_soft_tissue
from habitus.errors import HabitusError as HabitusError
from habitus.export.motion import export_motion as export_motion
from habitus.export.surface import write_surface as write_surface
from habitus.export.trc import write_trc as write_trc
from habitus.fit.markers.guessing import guess as guess
from habitus.fit.markers.judge import judge as judge
from habitus.fit.markers.weights import MoshWeights as MoshWeights
from habitus.io.captures.read import read_capture as read_capture
from habitus.io.layouts.files import load_layout as load_layout
from habitus.io.models.bodies import load_body as load_body
from habitus.io.models.priors import prior_of as prior_of
from habitus.io.people import load_fit as load_fit
from habitus.io.people import load_motion as load_motion
from habitus.io.registrations.open import open_registrations as open_registrations
from habitus.io.rgbd.read import read_views as read_views
from habitus.jobs.archive.run import archive as archive
from habitus.jobs.comparing import compare as compare
from habitus.jobs.estimates import body_from_measurements as body_from_measurements
from habitus.jobs.evaluate import evaluate as evaluate
from habitus.jobs.exporting import export_file as export_file
from habitus.jobs.label import label as label
from habitus.jobs.live import live as live
from habitus.jobs.mosh import Mosh as Mosh
from habitus.jobs.mosh import mosh as mosh
from habitus.jobs.mosh_files import save_fit as save_fit
from habitus.jobs.motions import exaggerate as exaggerate
from habitus.jobs.motions import retarget as retarget
from habitus.jobs.register import register_scans as register_scans
from habitus.jobs.register import save_scan as save_scan
from habitus.jobs.rgbd import fit_rgbd as fit_rgbd
from habitus.jobs.rgbd import save_rgbd as save_rgbd
from habitus.jobs.selection import select_markers as select_markers
from habitus.jobs.selection import select_poses as select_poses
from habitus.jobs.train import Trainer as Trainer
from habitus.jobs.train import train as train
from habitus.jobs.train_dynamics import train_dynamics as train_dynamics
from habitus.jobs.virtual_markers import fill_capture as fill_capture
from habitus.jobs.virtual_markers import virtual_markers as virtual_markers
from habitus.residuals import terms as terms
from habitus.solve.minimize import minimize as minimize

__version__: str
