"""BVH: the fitted skeleton and its motion, for MotionBuilder, Maya's and Blender's importers,
retargeting tools.
"""

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from habitus.export.animation import Animation, animate
from habitus.export.euler import continuous_angles
from habitus.files import atomic_write
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

CM = 100.0
ORDER = "ZXY"
"""Each joint turns about its own z, then x, then y: R = Rz Rx Ry, the order most BVH files have."""
_STILL = 2e-5
_TIP = 0.05


def write_bvh(fit: "Moving", path: str | os.PathLike[str]) -> Animation:
    """Write the skeleton in motion as .bvh, atomically: centimetres, +y up; what was written comes
    back.

    Offsets are those of the fitted person's joints at rest, a T-pose facing +z; the root's are
    zero, and its position channels hold its place. Rotations are in degrees, in the order of
    `ORDER`. Soft tissue moves joints: a joint that it moves by more than 0.02 mm has position
    channels, too, which take the place of its offset, as MotionBuilder and Blender read them.
    Raises HabitusError where the file cannot be written.
    """
    animation = animate(fit, correctives="none", body=fit.body)
    joints = animation.rest_joints
    parents = animation.body.parents
    offsets = joints - np.where(np.array(parents)[:, None] < 0, 0.0, joints[np.maximum(parents, 0)])
    places = _places(fit, offsets)
    moves = np.abs(places - offsets).max(axis=(0, 2)) > _STILL
    moves[0] = True
    offsets[0] = 0.0
    text = "\n".join(_joint(animation, 0, CM * offsets, moves, 0))
    values = _channels(animation, CM * places, moves)
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write(f"HIERARCHY\n{text}\nMOTION\n")
        file.write(f"Frames: {len(values)}\nFrame Time: {1.0 / animation.rate_hz:.9f}\n")
        line = " ".join(["%.5f"] * values.shape[1]) + "\n"
        file.writelines(line % tuple(row) for row in values.tolist())
    return animation


def _places(fit: "Moving", offsets: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "T J 3"]:
    """Where joints are from those above them (m), soft tissue included; the root in the world."""
    places = np.tile(offsets, (len(fit.pose), 1, 1))
    if fit.soft_tissue is not None:
        moved = np.einsum("jcb,tb->tjc", fit.body.joint_shapedirs, fit.soft_tissue)
        places += moved
        places[:, 1:] -= moved[:, list(fit.body.parents[1:])]
    places[:, 0] = (places[:, 0] + fit.trans) @ up_rotation(fit.up_axis).T
    return places


def _joint(
    animation: Animation, joint: int, offsets: np.ndarray, moves: np.ndarray, depth: int
) -> Iterator[str]:
    """The lines of a joint and of all that hang on it."""
    space = "\t" * depth
    parents = animation.body.parents
    turns = " ".join(f"{axis}rotation" for axis in ORDER)
    places = "Xposition Yposition Zposition " if moves[joint] else ""
    yield f"{space}{'JOINT' if depth else 'ROOT'} {animation.body.joint_names[joint]}"
    yield f"{space}{{"
    yield f"{space}\tOFFSET {_triple(offsets[joint])}"
    yield f"{space}\tCHANNELS {6 if moves[joint] else 3} {places}{turns}"
    below = [child for child, parent in enumerate(parents) if parent == joint]
    for child in below:
        yield from _joint(animation, child, offsets, moves, depth + 1)
    if not below:
        yield f"{space}\tEnd Site"
        yield f"{space}\t{{"
        yield f"{space}\t\tOFFSET {_triple(_tip(animation, joint))}"
        yield f"{space}\t}}"
    yield f"{space}}}"


def _tip(animation: Animation, joint: int) -> Float[np.ndarray, " 3"]:
    """Where a limb ends (cm from its joint): twice as far as the middle of what it carries."""
    carried = animation.body.skinning_weights[:, joint]
    if carried.max() < 0.5:
        parent = animation.body.parents[joint]
        way = animation.rest_joints[joint] - animation.rest_joints[max(parent, 0)]
        return CM * _TIP * way / max(float(np.linalg.norm(way)), 1e-9)
    middle = np.average(animation.rest_vertices, axis=0, weights=carried)
    return 2.0 * CM * (middle - animation.rest_joints[joint])


def _channels(
    animation: Animation, places: Float[np.ndarray, "T J 3"], moves: Bool[np.ndarray, " J"]
) -> Float[np.ndarray, "T C"]:
    """The motion, channel by channel, joints in the order of the hierarchy."""
    angles = continuous_angles(animation.tracks[0].quaternions, ORDER)
    columns = []
    for joint in _depth_first(animation.body.parents, 0):
        columns += [places[:, joint], angles[:, joint]] if moves[joint] else [angles[:, joint]]
    return np.concatenate(columns, axis=1)


def _depth_first(parents: tuple[int, ...], joint: int) -> Iterator[int]:
    yield joint
    for child in (child for child, parent in enumerate(parents) if parent == joint):
        yield from _depth_first(parents, child)


def _triple(values: Float[np.ndarray, " 3"]) -> str:
    return " ".join(f"{value:.6f}" for value in values)
