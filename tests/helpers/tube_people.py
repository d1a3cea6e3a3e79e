"""Registrations of made-up people of tubes, and models to be held against them: small enough to be
fitted at once.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from tube_body import random_pose, tube_body

from habitus.body.model import BodyModel
from habitus.evaluate.posable import PosableBody
from habitus.io.models.bodies import save_body
from habitus.io.registrations.open import write_registrations
from habitus.mesh.registrations import Registrations
from habitus_lab.baselines.blendscape import BlendScape

NOISE = 0.002
SUBJECTS = ("ann", "bob", "ann", "bob", "eve")


@dataclass(frozen=True, eq=False)
class TubePeople:
    """The body that registrations were made from, and registrations with noise and without."""

    body: BodyModel
    noisy: Registrations
    clean: Registrations


@cache
def tube_people() -> TubePeople:
    """Two people in two poses and one in one, of the set "test"; two more registrations are of the
    set "pose".
    """
    rng = np.random.default_rng(0)
    body = tube_body(betas=4, around=5, along=3, pose_shapes=0.004)
    names = ("root", "neck", *body.joint_names[2:])
    body = replace(body, joint_names=names, faces=np.concatenate([body.faces, _bridges(body, 20)]))
    model = PosableBody(body)
    subjects = (*SUBJECTS, "zoe", "zoe")
    betas = {name: rng.normal(size=4) for name in dict.fromkeys(subjects)}
    poses = [random_pose(rng, largest=0.6) for _ in subjects]
    vertices = np.array(
        [model.surface(betas[s], pose) for s, pose in zip(subjects, poses, strict=True)]
    )
    words = {
        "subject": subjects,
        "sex": ("female", "male", "female", "male", "female", "", ""),
        "set": ("test",) * 5 + ("pose",) * 2,
        "name": tuple(f"{s}-{k}" for k, s in enumerate(subjects)),
    }
    clean = Registrations(vertices, body.faces, **words)
    noisy = replace(clean, vertices=vertices + NOISE / np.sqrt(3) * rng.normal(size=vertices.shape))
    return TubePeople(body, noisy, clean)


def _bridges(body: BodyModel, each: int) -> np.ndarray:
    """A triangle from each tube of so many vertices to its parent's: triangle deformations need one
    piece.
    """
    tubes = body.v_template.reshape(-1, each, 3)
    corners = []
    for k, parent in enumerate(body.parents[1:], 1):
        near = int(np.linalg.norm(tubes[parent] - tubes[k, 0], axis=1).argmin())
        corners.append([k * each, k * each + 1, parent * each + near])
    return np.array(corners)


def written_tubes(folder: Path) -> dict[str, Path]:
    """Files: noisy and clean registrations, the body, one of dual quaternions."""
    people = tube_people()
    paths = {name: folder / f"{name}.npz" for name in ("noisy", "clean", "tubes", "dual")}
    write_registrations(people.noisy, paths["noisy"], dtype=np.float64)
    write_registrations(people.clean, paths["clean"], dtype=np.float64)
    save_body(people.body, paths["tubes"])
    save_body(replace(people.body, skinning="dqbs").with_betas(3), paths["dual"])
    return paths


def tube_scape(body: BodyModel) -> BlendScape:
    """Triangles that turn with their parts, two made-up shape directions, no deformation by
    pose.
    """
    faces = body.faces
    joints = body.num_joints
    return BlendScape(
        name="scape",
        template=body.v_template,
        faces=faces,
        parents=body.parents,
        influence=body.skinning_weights,
        mean_shape=np.tile(np.eye(3), (len(faces), 1, 1)),
        shape_directions=0.05
        * np.random.default_rng(1).normal(size=(2, 1, 3, 3))
        * np.ones((1, len(faces), 1, 1)),
        pose_regression=np.zeros((9 * (joints - 1), len(faces), 3, 3)),
        shape_variances=np.array([3.0, 1.0, 0.5, 0.5]),
    )


def other_topology() -> BodyModel:
    """A body of other tubes."""
    return tube_body(betas=2, around=4, along=3, pose_shapes=0.0)
