"""Foreign skeletons made of a body's motion: other names, rest poses, units, orders of channels,
more joints than ours.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.body.rig import Rig, RigMotion
from habitus.fit.retarget.legs import skeleton_of
from habitus.fit.retarget.recipe import turned
from habitus.io.models.bodies import load_body
from habitus.rotations import matrix_from_rotvec, up_rotation

SIDES = (("left", "Left"), ("right", "Right"))
MIXAMO = {"pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2"} | {
    "neck": "Neck",
    "head": "Head",
    **{
        f"{ours}_{part}": f"{side}{name}"
        for ours, side in SIDES
        for part, name in {
            "hip": "UpLeg",
            "knee": "Leg",
            "ankle": "Foot",
            "foot": "ToeBase",
            "collar": "Shoulder",
            "shoulder": "Arm",
            "elbow": "ForeArm",
            "wrist": "Hand",
        }.items()
    },
}


def a_pose(degrees: float = 40.0) -> dict[str, np.ndarray]:
    """World rotations of limbs that turn a T-pose into an A-pose."""
    out = {}
    for side, sign in (("left", -1.0), ("right", 1.0)):
        turn = matrix_from_rotvec(np.array([0.0, 0.0, sign * np.deg2rad(degrees)]))
        out |= {f"{side}_{part}": turn for part in ("shoulder", "elbow", "wrist", "hand")}
    return out


def along_x(motion: BodyMotion) -> dict[str, np.ndarray]:
    """World rotations after which the bones of all joints point along +x, as LAFAN1's do."""
    body, rest = motion.body, motion.body.rest_joints(motion.betas)
    out = {}
    for joint, name in enumerate(body.joint_names):
        below = [k for k, parent in enumerate(body.parents) if parent == joint]
        bone = rest[below[0]] - rest[joint] if below else rest[joint] - rest[body.parents[joint]]
        turn = Rotation.align_vectors([[1.0, 0.0, 0.0]], [bone])[0]
        out[name] = turn.as_matrix()
    return out


def foreign(
    motion: BodyMotion,
    names: dict[str, str],
    rest: dict[str, np.ndarray] | None = None,
    unit: float = 100.0,
    world: np.ndarray | None = None,
) -> RigMotion:
    """A body's motion (y up) as another skeleton's: its joints of ``names``, at rest turned by
    ``rest`` (rotations in the world by our names), ``unit`` units a metre, in a turned ``world``.
    """
    body = motion.body
    skeleton = skeleton_of(motion)
    world = np.eye(3) if world is None else world
    kept = [k for k, name in enumerate(body.joint_names) if name in names]
    ours = [body.joint_names[k] for k in kept]
    parents = []
    for k in kept:
        above = body.parents[k]
        while above not in kept and above >= 0:
            above = body.parents[above]
        parents.append(kept.index(above) if above >= 0 else -1)
    turns = np.stack([(rest or {}).get(name, np.eye(3)) for name in ours])
    joints = body.rest_joints(motion.betas)[kept]
    places = np.zeros_like(joints)
    for k, parent in enumerate(parents):
        if parent >= 0:
            places[k] = places[parent] + turns[parent] @ (joints[k] - joints[parent])
    moved = world @ skeleton.world[:, kept, :, :3] @ np.swapaxes(turns, 1, 2)
    rig = Rig(
        names=tuple(names[name] for name in ours),
        parents=tuple(parents),
        places=unit * places @ world.T,
        turns=np.tile(np.eye(3), (len(kept), 1, 1)),
        ends=(False,) * len(kept),
    )
    # at rest its joints have no rotation in its own world
    moved = moved @ world.T
    there = unit * skeleton.world[:, kept][..., 3] @ world.T
    return RigMotion(rig, there, moved, motion.rate_hz, "foreign")


def bvh_text(motion: RigMotion, order: str = "ZXY", positions_last: bool = False) -> str:
    """The motion as a BVH, whose rest rotations are none."""
    rig = motion.rig
    lines = ["HIERARCHY"]
    columns = []

    def joint(k: int, depth: int) -> None:
        space = "  " * depth
        parent = rig.parents[k]
        above = rig.places[parent] if parent >= 0 else np.zeros(3)
        offset = " ".join(f"{value:.8f}" for value in rig.places[k] - above)
        turn = motion.turns[:, k]
        if parent >= 0:
            turn = np.swapaxes(motion.turns[:, parent], 1, 2) @ turn
        angles = Rotation.from_matrix(turn).as_euler(order, degrees=True)
        channels = [f"{axis}rotation" for axis in order]
        values = [angles]
        if parent < 0:
            place = [f"{axis}position" for axis in "XYZ"]
            channels = channels + place if positions_last else place + channels
            values = [angles, motion.places[:, k]]
            values = values if positions_last else values[::-1]
        columns.extend(values)
        lines.extend(
            [
                f"{space}{'ROOT' if parent < 0 else 'JOINT'} {rig.names[k]}",
                f"{space}{{",
                f"{space}  OFFSET {offset}",
                f"{space}  CHANNELS {len(channels)} {' '.join(channels)}",
            ]
        )
        below = rig.children(k)
        for child in below:
            joint(child, depth + 1)
        if not below:
            end = " ".join(f"{value:.8f}" for value in 0.2 * (rig.places[k] - above))
            lines.extend([f"{space}  End Site", f"{space}  {{", f"{space}    OFFSET {end}"])
            lines.append(f"{space}  }}")
        lines.append(f"{space}}}")

    joint(0, 0)
    table = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(table)}", f"Frame Time: {1.0 / motion.rate_hz:.8f}"]
    lines += [" ".join(f"{value:.7f}" for value in row) for row in table]
    return "\n".join(lines) + "\n"


def walk_motion() -> BodyMotion:
    """A motion of the mean person: 60 frames at 60 Hz, y up, the lowest vertex at 0."""
    made = BodyMotion.of(synthetic_fit(60, rate_hz=60.0))
    body = load_body("default")
    pose = made.pose[:, : body.num_joints]
    motion = BodyMotion(body, np.zeros(body.num_betas), pose, made.trans, 60.0, made.up_axis)
    motion = replace(turned(motion, up_rotation(made.up_axis)), up_axis="+y")
    return replace(motion, trans=motion.trans - [0.0, motion.vertices()[..., 1].min(), 0.0])
