"""A body's pose from three silhouettes and depth images: explicit Jacobians through the body, and
what they find.
"""

import math
from functools import cached_property

import numpy as np
import pytest
import torch

import habitus
from habitus.body.jacobians import surface_jacobian
from habitus.observe.camera import Camera, look_at
from habitus.observe.images import as_vector, gaussian_pyramid, geman_mcclure
from habitus.render.draw import draw
from habitus.render.jacobians.images import depth_jacobian, silhouette_jacobian
from habitus.render.triangles import Triangles
from habitus.rotations import matrix_from_rotvec, quaternion_from_matrix, rotvec_from_matrix
from habitus.solve.least_squares import Tolerances
from habitus.solve.minimize import minimize

BODY = habitus.load_body("default")
TRIANGLES = Triangles.of(torch.as_tensor(BODY.faces), torch.as_tensor(BODY.v_template))
BETAS = torch.zeros(BODY.num_betas, dtype=torch.float64)
WALL = 5.0
OFF = math.radians(10)


@pytest.fixture(scope="module")
def planted():
    """One step of a walk: pose (J, 3) and translation (3,)."""
    turns = {
        "left_hip": (-0.5, 0.0, 0.05),
        "left_knee": (0.2, 0.0, 0.0),
        "right_hip": (0.3, 0.1, 0.0),
        "right_knee": (0.6, 0.0, 0.0),
        "spine2": (0.05, 0.15, 0.0),
        "left_shoulder": (0.2, 0.0, -1.1),
        "left_elbow": (0.0, -0.4, 0.0),
        "right_shoulder": (-0.3, 0.0, 1.1),
        "right_elbow": (0.0, 0.5, 0.0),
    }
    pose = torch.tensor(
        [turns.get(name, (0.0, 0.0, 0.0)) for name in BODY.joint_names], dtype=torch.float64
    )
    return pose, torch.tensor([0.03, -0.02, 0.04], dtype=torch.float64)


def cameras(size: int) -> list[Camera]:
    """Three around the body, 3 m away."""
    found = []
    for degrees, height in ((20, 0.35), (140, 0.1), (260, 0.6)):
        angle = math.radians(degrees)
        target = torch.tensor([0.0, -0.1, 0.0], dtype=torch.float64)
        eye = torch.tensor(
            [3.0 * math.sin(angle), height, 3.0 * math.cos(angle)], dtype=torch.float64
        )
        rotation, translation = look_at(eye, target)
        found.append(Camera.of(size, size, 1.3 * size, rotation=rotation, translation=translation))
    return found


class PosedImages:
    """A body in a pose before cameras: silhouettes and depths (N, H, W, 1), and their
    derivatives.
    """

    def __init__(self, views, pose, trans):
        self.views = views
        self.pose = pose
        self.trans = trans
        self.vertices = BODY(BETAS, pose, trans).vertices
        self.frames = [draw(camera, self.vertices, TRIANGLES) for camera in views]
        self.silhouettes = torch.stack([frame.silhouette() for frame in self.frames])[..., None]
        self.depths = torch.stack([frame.depth(WALL) for frame in self.frames])[..., None]

    @cached_property
    def vertex_jacobian(self):
        by_pose = surface_jacobian(BODY, BETAS, self.pose, self.trans).vertices_pose.flatten(2)
        return torch.cat([by_pose, torch.eye(3, dtype=torch.float64).expand(len(by_pose), 3, 3)], 2)

    def chained(self, jacobian):
        """To pose and translation, (N, H, W, 3 J + 3)."""
        pairs = zip(self.views, self.frames, strict=True)
        found = [
            jacobian(frame).chain(camera, self.vertices, self.vertex_jacobian)
            for camera, frame in pairs
        ]
        return torch.from_numpy(np.stack(found)).unflatten(1, self.depths.shape[1:3])


def to_depth(frame):
    return depth_jacobian(frame, WALL)


def test_explicit_jacobians_to_a_pose_are_those_of_forward_mode(planted):
    views = cameras(24)[:1]

    def images(pose, trans):
        found = PosedImages(views, pose, trans)
        return found.silhouettes, found.depths

    forward = torch.func.jacfwd(images, argnums=(0, 1))(*planted)
    for jacobian, (by_pose, by_trans) in zip((silhouette_jacobian, to_depth), forward, strict=True):
        theirs = torch.cat([by_pose.flatten(-2), by_trans], -1).squeeze(3)
        most = float(theirs.abs().max())
        assert most > 0.1
        torch.testing.assert_close(
            PosedImages(views, *planted).chained(jacobian), theirs, atol=1e-9 * most, rtol=1e-7
        )


def terms(observed, start, levels, scale):
    """Differences of silhouettes and (robust) of depths, levels of their pyramids, and joints held
    near the start.
    """
    last = []
    usual = OFF / 3**0.5

    def posed(pose, trans):
        if not last or last[0].pose is not pose:
            last[:] = [PosedImages(observed.views, pose, trans)]
        return last[0]

    def pyramids(images):
        return gaussian_pyramid(images, levels[1])[levels[0] :]

    def by_unknowns(vertex_jacobian):
        rows = torch.cat([level.flatten(1, 2) for level in pyramids(vertex_jacobian)], 1).flatten(
            0, 1
        )
        return {"pose": rows[:, :-3], "trans": rows[:, -3:]}

    def silhouettes(pose, trans):
        now = posed(pose, trans)
        off = now.silhouettes - observed.silhouettes
        return as_vector(pyramids(off)), lambda: by_unknowns(now.chained(silhouette_jacobian))

    def depths(pose, trans):
        now = posed(pose, trans)
        off = (now.depths - observed.depths) / scale
        robust, derivative = torch.func.jvp(
            lambda off: geman_mcclure(off, 1.0), (off,), (torch.ones_like(off),)
        )
        return as_vector(pyramids(robust)), lambda: by_unknowns(
            derivative / scale * now.chained(to_depth)
        )

    def near(pose):
        return (pose - start) / usual, {"pose": np.eye(pose.numel()) / usual}

    return {"silhouettes": silhouettes, "depths": depths, "near": near}


def test_a_pose_is_found_from_ten_degrees_off_at_every_joint(planted):
    generator = torch.Generator().manual_seed(4)
    observed = PosedImages(cameras(48), *planted)
    axes = torch.nn.functional.normalize(
        torch.randn(25, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    turned = rotvec_from_matrix(
        matrix_from_rotvec(planted[0]) @ matrix_from_rotvec(OFF * axes[:24])
    )
    values = {"pose": turned, "trans": planted[1] + 0.05 * axes[24]}
    assert max(errors(planted, **values)[1]) > 100.0
    for levels, scale, near, steps in (
        ((2, 4), 0.3, 0.1, 5),
        ((1, 3), 0.2, 0.03, 5),
        ((0, 2), 0.1, 0.0, 3),
    ):
        values = minimize(
            terms(observed, turned, levels, scale),
            values,
            "levenberg",
            weights={"near": near},
            max_iterations=steps,
            tolerances=Tolerances(cost=1e-2),
        ).values
    rotations, joints = errors(planted, **values)
    assert rotations.mean() < 2.5 and joints.max() < 5.0  # toes hardly show


def errors(planted, pose, trans):
    """Rotations of joints (degrees), swing and twist together, and distances of joints (mm)."""
    turn = quaternion_from_matrix(matrix_from_rotvec(planted[0]).mT @ matrix_from_rotvec(pose))
    joints = BODY(BETAS, *planted).joints - BODY(BETAS, pose, trans).joints
    return 2 * torch.atan2(turn[:, 1:].norm(dim=-1), turn[:, 0].abs()).rad2deg(), 1e3 * joints.norm(
        dim=-1
    )
