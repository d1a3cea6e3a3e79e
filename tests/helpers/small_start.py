"""The small body as a start of training, with all that training does not find, and registrations of
its people.
"""

from dataclasses import replace

import numpy as np
from small_rigs import JOINT_MIRROR, PARENTS, as_body, poses, small_body, small_rig

from habitus.body.prior import PosePrior
from habitus.learn.options import EnergyWeights, TrainOptions
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template
from habitus.parallel.workers import Threads

SMALL = small_body(pairs=5, middle=1)
BETAS = 2
ALONE = Threads(1)
WARM = TrainOptions(
    start="body",
    rounds=1,
    tolerance=0.0,
    num_betas=BETAS,
    weights=EnergyWeights(5.0, pose_shapes=0.5),
)


def body_of(**changes):
    """A body with a regressor of weights below zero, and all that training does not find."""
    rng = np.random.default_rng(3)
    body = as_body(
        small_rig(SMALL, 1), SMALL, 0.02 * rng.normal(size=(len(SMALL.vertices), 3, BETAS))
    )
    away = rng.normal(size=SMALL.regressor.shape) * 0.02
    away = (away + away[JOINT_MIRROR][:, SMALL.mirror]) / 2
    regressor = SMALL.regressor + away - away.mean(1, keepdims=True)
    n = 3 * (len(PARENTS) - 1)
    own = {
        "joint_regressor": regressor,
        "landmarks": {"nose": 4, "navel": 7},
        "part": SMALL.part,
        "mirror": SMALL.mirror,
        "pose_prior": PosePrior(
            body.joint_names[1:], rng.normal(size=n), np.diag(rng.uniform(0.1, 1.0, n))
        ),
        "female_direction": (np.array([1.5, -0.5]), 0.3),
        "extras": {"hands_mean": np.arange(3.0), "license": np.array("theirs")},
    }
    return replace(body, **(own | changes))


def template_of(body):
    return Template(
        body.v_template,
        body.faces,
        SMALL.part,
        PARENTS,
        body.joint_names,
        SMALL.mirror,
        JOINT_MIRROR,
        body.landmarks,
    )


def registrations_of(body, subjects=3, each=5):
    """People of the body in poses, with its own joints."""
    rng = np.random.default_rng(8)
    betas = np.repeat(rng.normal(size=(subjects, BETAS)), each, 0)
    vertices = body(
        betas, poses(subjects * each, 8, 0.8), 0.1 * rng.normal(size=(subjects * each, 3))
    ).vertices
    names = tuple(f"{k}" for k in range(len(vertices)))
    who = tuple(f"s{k // each}" for k in range(len(vertices)))
    return Registrations(
        vertices, body.faces, who, ("",) * len(names), ("pose",) * len(names), names
    )
