"""BVH: the fitted skeleton and its motion, for MotionBuilder, Maya's and Blender's importers,
retargeting tools.
"""

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from habitus.export.animation import local_quaternions, turned_root
from habitus.export.euler import continuous_angles
from habitus.export.rigs import Rig
from habitus.export.skeleton import names_of, tip
from habitus.files import atomic_write
from habitus.parallel.blocks import blocks, drop_pages
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

CM = 100.0
ORDER = "ZXY"
"""Each joint turns about its own z, then x, then y: R = Rz Rx Ry, the order most BVH files have."""
_STILL = 2e-5


def write_bvh(fit: "Moving", path: str | os.PathLike[str], rig: Rig | None = None) -> None:
    """Write the skeleton in motion as .bvh, atomically, a block of frames at a time: centimetres,
    +y up.

    Offsets are those of the fitted person's joints at rest, a T-pose facing +z; the root's are
    zero, and its position channels hold its place. Rotations are in degrees, in the order of
    `ORDER`. Soft tissue moves joints: a joint that it moves by more than 0.02 mm has position
    channels, too, which take the place of its offset, as MotionBuilder and Blender read them.
    ``rig``: joints by its names. Raises HabitusError where the file cannot be written.
    """
    body = fit.body
    joints = body.rest_joints(np.asarray(fit.betas, np.float64))
    parents = np.array(body.parents)
    offsets = joints - np.where(parents[:, None] < 0, 0.0, joints[np.maximum(parents, 0)])
    moved = [
        np.abs(_places(fit, offsets, part) - offsets).max(axis=(0, 2))
        for part in blocks(fit.num_frames)
    ]
    moves = np.max(moved, axis=0) > _STILL
    moves[0] = True
    at_root = np.where(np.arange(len(joints))[:, None] == 0, 0.0, offsets)
    names = names_of(rig, body.joint_names)
    text = "\n".join(_joint(fit, names, 0, CM * at_root, moves, 0))
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write(f"HIERARCHY\n{text}\nMOTION\n")
        file.write(f"Frames: {fit.num_frames}\nFrame Time: {1.0 / fit.rate_hz:.9f}\n")
        for values in _channels(fit, offsets, moves):
            line = " ".join(["%.5f"] * values.shape[1]) + "\n"
            file.writelines(line % tuple(row) for row in values.tolist())


def _places(
    fit: "Moving", offsets: Float[np.ndarray, "J 3"], part: slice
) -> Float[np.ndarray, "T J 3"]:
    """Where joints are from those above them (m), soft tissue included, in some frames; the root in
    the world.
    """
    trans = np.asarray(fit.trans[part], np.float64)
    places = np.tile(offsets, (len(trans), 1, 1))
    if fit.soft_tissue is not None:
        moved = np.einsum("jcb,tb->tjc", fit.body.joint_shapedirs, fit.soft_tissue[part])
        places += moved
        places[:, 1:] -= moved[:, list(fit.body.parents[1:])]
    places[:, 0] = (places[:, 0] + trans) @ up_rotation(fit.up_axis).T
    drop_pages(fit.trans, fit.soft_tissue)
    return places


def _joint(
    fit: "Moving",
    names: tuple[str, ...],
    joint: int,
    offsets: np.ndarray,
    moves: np.ndarray,
    depth: int,
) -> Iterator[str]:
    """The lines of a joint and of all that hang on it."""
    space = "\t" * depth
    parents = fit.body.parents
    turns = " ".join(f"{axis}rotation" for axis in ORDER)
    places = "Xposition Yposition Zposition " if moves[joint] else ""
    yield f"{space}{'JOINT' if depth else 'ROOT'} {names[joint]}"
    yield f"{space}{{"
    yield f"{space}\tOFFSET {_triple(offsets[joint])}"
    yield f"{space}\tCHANNELS {6 if moves[joint] else 3} {places}{turns}"
    below = [child for child, parent in enumerate(parents) if parent == joint]
    for child in below:
        yield from _joint(fit, names, child, offsets, moves, depth + 1)
    if not below:
        yield f"{space}\tEnd Site"
        yield f"{space}\t{{"
        yield f"{space}\t\tOFFSET {_triple(_tip(fit, joint))}"
        yield f"{space}\t}}"
    yield f"{space}}}"


def _tip(fit: "Moving", joint: int) -> Float[np.ndarray, " 3"]:
    """Where a limb ends (cm from its joint)."""
    betas = np.asarray(fit.betas, np.float64)
    return CM * tip(fit.body, fit.body.rest_joints(betas), fit.body.rest_vertices(betas), joint)


def _channels(
    fit: "Moving", offsets: Float[np.ndarray, "J 3"], moves: Bool[np.ndarray, " J"]
) -> Iterator[Float[np.ndarray, "T C"]]:
    """The motion, channel by channel, joints in the order of the hierarchy, a block of frames at a
    time.
    """
    world = up_rotation(fit.up_axis)
    order = list(_depth_first(fit.body.parents, 0))
    last = None
    for part in blocks(fit.num_frames):
        quaternions = local_quaternions(np.asarray(fit.pose[part], np.float64))
        angles = continuous_angles(turned_root(quaternions, world), ORDER, last)
        last = angles[-1]
        places = CM * _places(fit, offsets, part)
        columns = []
        for joint in order:
            columns += [places[:, joint], angles[:, joint]] if moves[joint] else [angles[:, joint]]
        yield np.concatenate(columns, axis=1)
        drop_pages(fit.pose)


def _depth_first(parents: tuple[int, ...], joint: int) -> Iterator[int]:
    yield joint
    for child in (child for child, parent in enumerate(parents) if parent == joint):
        yield from _depth_first(parents, child)


def _triple(values: Float[np.ndarray, " 3"]) -> str:
    return " ".join(f"{value:.6f}" for value in values)
