"""Registrations of made-up people on a coarse body: enough to train something on within seconds."""

from functools import cache

from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.mesh.template import Template
from habitus_lab.population.coarse_bodies import coarse_body
from habitus_lab.population.planted_body import joints_near_rings, planted_truth
from habitus_lab.population.registrations import Planted, planted_registrations

OPTIONS = TrainOptions(
    rounds=2, tolerance=0.0, num_betas=4, weights=EnergyWeights(joints=5.0, pose_shapes=1.0)
)
COMMAND = (
    "--rounds 2 --tolerance 0 --num-betas 4 --weights.joints 5 --weights.pose-shapes 1 --workers 1"
).split()  # the same on the command line


@cache
def toy() -> tuple[Template, Planted]:
    """The template, and four people in seven poses (two women, two men), eleven in one."""
    base = coarse_body(load_body("default"), 320)
    template = body_template(base)
    truth = planted_truth(base, joint_regressor=joints_near_rings(template))
    return template, planted_registrations(
        truth,
        subjects=4,
        poses_per_subject=7,
        shape_people=11,
        test_subjects=1,
        test_poses=2,
        seed=2,
    )
