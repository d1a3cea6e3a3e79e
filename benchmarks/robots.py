"""How well and how fast do motions go onto a humanoid robot, beside GMR in the same run?

    python benchmarks/robots.py --robot g1.xml CAPTURE ... [--gmr FOLDER] [--out FILE]

CAPTURE: captures (C3D, TRC), which are fitted first, or results (body.npz). FOLDER: a checkout of
GMR (github YanjieZe/GMR; needs mujoco, mink and daqp from PyPI), whose retargeting runs on the same
motions of the same body: its SMPL-X table takes joints by SMPL's names, which are ours.

- direction: angle between limbs of the robot and of the person, degrees: mean over thighs, shanks,
  upper arms and forearms (first with all frames, then those in which no joint is at a limit).
- slip: heels and toes of the robot while the person's stand, mm/s, root mean square, level; of
  hands while the person's rest on the ground.
- below: deepest point of soles and capsules under the ground, mm; overlap: of two links, mm.
- limits: joints beyond a limit, degrees; speed: the fastest joint, rad/s.
- frames a second: on one core, without reading and writing.
With mujoco installed the places of all links are compared with mj_kinematics (peer, mm).
"""

import argparse
import sys
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
from common import parser, run, show_table
from scipy.spatial.transform import Rotation

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.body.robot import TO_ROBOT, Robot
from habitus.fit.retarget.legs import skeleton_of
from habitus.fit.retarget.recipe import turned
from habitus.fit.retarget.robot_quality import RobotQuality, robot_quality
from habitus.fit.retarget.robots import RobotMotion, RobotRetargeting, retargeted_to_robot
from habitus.io.robots.pairs import pairs_for
from habitus.io.robots.read import read_robot
from habitus.kernels.threads import one_blas_thread
from habitus.rotations import up_rotation

LIMBS = ("thigh", "shank", "upper_arm", "forearm")


def motions(places: list[Path]) -> dict[str, BodyMotion]:
    """Motions by name: results are read, captures fitted."""
    out = {}
    for place in places:
        fit = hb.load_motion(place) if place.suffix == ".npz" else hb.Mosh(layout="auto").fit(place)
        out[place.parent.name if place.name == "body.npz" else place.stem] = BodyMotion.of(fit)
    return out


def row_of(program: str, name: str, result: RobotRetargeting, seconds: float) -> dict:
    """Numbers of one motion."""
    quality: RobotQuality = robot_quality(result)
    motion, robot = result.motion, result.motion.robot
    limbs = [each for each in quality.directions if each.split("_", 1)[-1] in LIMBS]
    every = np.array([quality.directions[each].mean() for each in limbs])
    free = np.concatenate([quality.directions[each][quality.free[each]] for each in limbs])
    beyond = np.maximum(motion.angles - robot.upper, robot.lower - motion.angles).max()
    return {
        "program": program,
        "motion": name,
        "frames": motion.num_frames,
        "direction": float(every.mean()),
        "direction free": float(free.mean()),
        "slip": 1e3 * quality.slip,
        "slip of hands": 1e3 * quality.palm_slip,
        "below": 1e3 * quality.penetration,
        "overlap": 1e3 * quality.overlap,
        "limits": float(np.rad2deg(max(beyond, 0.0))),
        "speed": float(np.abs(np.diff(motion.angles, axis=0)).max() * motion.rate_hz),
        "frames a second": motion.num_frames / seconds,
        "verdict": quality.verdict.level,
    }


def gmr_retarget(folder: Path, robot: Robot, like: RobotRetargeting, source: BodyMotion):
    """GMR's motion of the same person, and its seconds."""
    sys.path.insert(0, str(folder))
    module = import_module("general_motion_retargeting.motion_retarget")
    upright = turned(source, up_rotation(source.up_axis))
    world = skeleton_of(upright).world
    places = (world[..., 3] - [0.0, like.person.ground, 0.0]) @ TO_ROBOT.T
    quaternions = Rotation.from_matrix((TO_ROBOT @ world[..., :3]).reshape(-1, 3, 3)).as_quat(
        scalar_first=True
    )
    quaternions = quaternions.reshape(*places.shape[:2], 4)
    height = source.body.measure(source.body(source.betas))["height_m"]
    solver = module.GeneralMotionRetargeting("smplx", "unitree_g1", actual_human_height=height)
    names = source.body.joint_names
    began = time.perf_counter()
    rows = [
        solver.retarget(dict(zip(names, zip(p, q, strict=True), strict=True)))
        for p, q in zip(places, quaternions, strict=True)
    ]
    seconds = time.perf_counter() - began
    qpos = np.array(rows)
    turn = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).as_matrix()
    motion = RobotMotion(robot, qpos[:, :3], turn, qpos[:, 7:], source.rate_hz)
    return replace(like, motion=motion), seconds


def peer_distance(path: Path, motion: RobotMotion) -> float | None:
    """Largest distance (mm) of a link from where mj_kinematics places it; None without mujoco."""
    try:
        import mujoco
    except ImportError:
        return None
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    links = motion.links()
    worst = 0.0
    for t in range(0, motion.num_frames, 50):
        quaternion = Rotation.from_matrix(motion.turn[t]).as_quat(scalar_first=True)
        data.qpos[:] = np.concatenate([motion.root[t], quaternion, motion.angles[t]])
        mujoco.mj_kinematics(model, data)
        for k, name in enumerate(motion.robot.link_names):
            place = data.body(name).xpos
            worst = max(worst, float(np.linalg.norm(place - links.origins[t, k])))
    return 1e3 * worst


def measure(options: argparse.Namespace) -> dict:
    """Retarget all motions and compare."""
    robot = read_robot(options.robot)
    pairs = pairs_for(robot)
    rows, peers = [], {}
    for name, source in motions(options.captures).items():
        with one_blas_thread():
            retargeted_to_robot(source, robot, pairs)  # compiles
            began = time.perf_counter()
            result = retargeted_to_robot(source, robot, pairs)
            seconds = time.perf_counter() - began
        rows.append(row_of("habitus", name, result, seconds))
        if options.mujoco:
            peers[name] = peer_distance(options.mujoco, result.motion)
        if options.gmr:
            theirs, their_seconds = gmr_retarget(options.gmr, robot, result, source)
            rows.append(row_of("GMR", name, theirs, their_seconds))
    return {"robot": robot.name, "rows": rows, "peer_mm": peers}


def show(found: dict) -> None:
    """Print the table."""
    show_table(f"onto {found['robot']}", found["rows"], 1)
    if found["peer_mm"]:
        print(f"largest distance of a link from mj_kinematics, mm: {found['peer_mm']}")


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("captures", nargs="+", type=Path)
    arguments.add_argument("--robot", type=Path, required=True)
    arguments.add_argument("--gmr", type=Path, help="a checkout of GMR")
    arguments.add_argument("--mujoco", type=Path, help="the robot's file with its meshes beside it")
    run(arguments, measure, show)
