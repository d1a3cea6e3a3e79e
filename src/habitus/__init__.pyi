# What type checkers and editors see of the lazily loaded public face.

from habitus.body.hands import hand_pose as hand_pose
from habitus.body.model import BodyModel as BodyModel
from habitus.body.soft_tissue import simulate_soft_tissue as simulate_soft_tissue
from habitus.body.surface_files import write_surface as write_surface
from habitus.errors import HabitusError as HabitusError
from habitus.export.trc import write_trc as write_trc
from habitus.fit.body_fit import FitSettings as FitSettings
from habitus.fit.markers.settings import MoshWeights as MoshWeights
from habitus.io.captures.read import read_capture as read_capture
from habitus.io.layouts.files import load_layout as load_layout
from habitus.io.models.bodies import load_body as load_body
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
from habitus.jobs.motions import exaggerate as exaggerate
from habitus.jobs.motions import retarget as retarget
from habitus.jobs.register import register_scans as register_scans
from habitus.jobs.results import load_fit as load_fit
from habitus.jobs.results import load_motion as load_motion
from habitus.jobs.rgbd import fit_rgbd as fit_rgbd
from habitus.jobs.selection import select_markers as select_markers
from habitus.jobs.selection import select_poses as select_poses
from habitus.jobs.sensors import Depth as Depth
from habitus.jobs.sensors import Fit as Fit
from habitus.jobs.sensors import Markers as Markers
from habitus.jobs.sensors import Scan as Scan
from habitus.jobs.train import Trainer as Trainer
from habitus.jobs.train import train as train
from habitus.jobs.train_dynamics import train_dynamics as train_dynamics
from habitus.jobs.virtual_markers import fill_capture as fill_capture
from habitus.jobs.virtual_markers import virtual_markers as virtual_markers
from habitus.observe.camera import Camera as Camera
from habitus.render.draw import draw as draw
from habitus.residuals import terms as terms
from habitus.solve.minimize import minimize as minimize
from habitus.solve.terms import Term as Term

__version__: str
