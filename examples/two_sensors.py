"""A made person with 12 markers and two depth views: fitted to the markers, to the views, and to
both at once.

python examples/two_sensors.py [PEOPLE]
"""

import sys

import numpy as np
import torch

import habitus as hb
from habitus.body.model import BodyModel
from habitus.observe.camera import DepthView
from habitus.observe.simulated_markers import Faults, simulate_capture

LABELS = "LFHD C7 LELB RELB LWRA RWRA LFWT RBWT LKNE RKNE LHEE RHEE".split()
SHOTS = (0, 30)
"""Frames of the capture at which the depth camera looked."""


def motion(body: BodyModel, frames: int, rng: np.random.Generator) -> tuple:
    """Pose (T, J, 3) and trans (T, 3): arms, legs and back move about an A-pose, and the person
    turns by 45 degrees.
    """
    wave = np.sin(np.linspace(0.0, 2.0 * np.pi, frames)[:, None] + rng.uniform(0.0, 6.0, (1, 12)))
    pose = np.zeros((frames, body.num_joints, 3))

    def turn(joint: str, axis: int, angles: np.ndarray) -> None:
        pose[:, body.joint_names.index(joint), axis] = angles

    for k, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        turn(f"{side}_shoulder", 2, sign * (-0.8 + 0.3 * wave[:, k]))
        turn(f"{side}_elbow", 1, sign * (-0.3 + 0.2 * wave[:, 2 + k]))
        turn(f"{side}_hip", 0, -0.1 + 0.15 * wave[:, 4 + k])
        turn(f"{side}_knee", 0, 0.2 + 0.15 * wave[:, 6 + k])
    turn("spine2", 0, 0.1 * wave[:, 8])
    turn(body.joint_names[0], 1, np.minimum(np.arange(frames) / SHOTS[1], 1.0) * np.pi / 4.0)
    return pose, np.stack([0.05 * wave[:, 9], 1.0 + 0.02 * wave[:, 10], 0.05 * wave[:, 11]], 1)


def depth_view(
    camera: hb.Camera, vertices: np.ndarray, faces: np.ndarray, rng: np.random.Generator
) -> DepthView:
    """What a sensor with the noise of a Kinect sees of a surface before an empty room."""
    seen = hb.draw(camera, torch.from_numpy(vertices), faces, boundary="none").depth().numpy()
    person = np.isfinite(seen)
    noise = 1.5e-3 * np.where(person, seen, 0.0) ** 2 * rng.normal(size=seen.shape)
    return DepthView(np.where(person, seen + noise, 0.0), camera, mask=person)


def person(body: BodyModel, seed: int) -> tuple:
    """Truth (betas, pose, trans), markers (T, 12, 3) as recorded, their layout, and two views."""
    rng = np.random.default_rng(seed)
    layout = hb.load_layout("cmu-41").restricted_to(LABELS)
    betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
    pose, trans = motion(body, 60, rng)
    places = (layout.vertices(body), layout.distances())
    faults = Faults(noise=0.0005, placement=0.01, missing=0.0)
    capture = simulate_capture(body, betas, pose, trans, *places, faults, rng)
    camera = hb.Camera.of(320, 240, 285.0, rotation=(np.pi, 0.0, 0.0), translation=(0, 1.0, 2.6))
    surfaces = body(betas, pose[list(SHOTS)], trans[list(SHOTS)]).vertices
    views = [depth_view(camera, surface, body.faces, rng) for surface in surfaces]
    return (betas, pose, trans), hb.Markers(capture.observed, layout, fps=30.0), views


def errors_mm(body: BodyModel, truth: tuple, betas: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Mean distance of the skin at rest, and of the joints (2, J, 3) in the two shots."""
    shape = body.rest_vertices(betas) - body.rest_vertices(truth[0])
    off = joints - body(truth[0], truth[1][list(SHOTS)], truth[2][list(SHOTS)]).joints
    return 1e3 * np.array([np.linalg.norm(each, axis=-1).mean() for each in (shape, off)])


def compare(body: BodyModel, seed: int) -> dict[str, np.ndarray]:
    """Errors (shape, joints) in mm of each sensor alone and of both."""
    truth, markers, views = person(body, seed)
    alone = hb.Fit(body, markers).solve()
    seen = hb.Fit(body, hb.Depth(views)).solve()
    both = hb.Fit(body, [markers, hb.Depth(views, frames=SHOTS)]).solve()
    in_camera = torch.from_numpy(np.stack([seen.joints(k) for k in range(len(SHOTS))]))
    in_world = views[0].camera.to_world(in_camera).numpy()
    together = np.stack([both.joints(f"frame {k}") for k in SHOTS])
    return {
        "12 markers": errors_mm(body, truth, alone.betas, alone.motion.joints(SHOTS)),
        "2 depth views": errors_mm(body, truth, seen.betas, in_world),
        "both at once": errors_mm(body, truth, both.betas, together),
    }


def main(people: int = 3) -> dict[str, np.ndarray]:
    """Print the mean errors of some people."""
    body = hb.load_body("default")
    each = [compare(body, seed) for seed in range(people)]
    mean = {name: np.mean([one[name] for one in each], axis=0) for name in each[0]}
    print(f"{'mean of ' + str(people) + ' people':16} shape (mm)  joints (mm)")
    for name, (shape, joints) in mean.items():
        print(f"{name:16} {shape:10.1f} {joints:12.1f}")
    return mean


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
