"""A file with a skeleton in motion, as a body in motion: BVH, glTF and FBX."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.rig import RigMotion
from habitus.errors import HabitusError
from habitus.fit.retarget.rig_motions import body_motion_of
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.io.motions.bvh import read_bvh
from habitus.io.motions.fbx_motion import ENDINGS as FBX
from habitus.io.motions.fbx_motion import read_fbx_motion
from habitus.io.motions.gltf import ENDINGS as GLTF
from habitus.io.motions.gltf import read_gltf, read_gltf_motion
from habitus.kernels.threads import one_blas_thread

ENDINGS = (".bvh", *GLTF, *FBX)


def read_rig_motion(path: Path) -> RigMotion:
    """The skeleton of a file in motion, as the file has it. Raises HabitusError."""
    if not path.is_file():
        raise HabitusError(f"{path}: no such file; expected a motion ({' or '.join(ENDINGS)})")
    ending = path.suffix.lower()
    if ending in FBX:
        return read_fbx_motion(path)
    return read_gltf_motion(path) if ending in GLTF else read_bvh(path)


def is_rig_motion(path: Path) -> bool:
    """Whether a file holds a skeleton in motion; a glTF file may be a scan as well. Raises
    HabitusError for a damaged one.
    """
    if path.suffix.lower() not in GLTF or not path.is_file():
        return path.suffix.lower() in (".bvh", *FBX)
    document = read_gltf(path).document
    return bool(document.get("animations")) and bool(document.get("skins"))


def read_foreign_motion(
    path: Path, body: BodyModel | None = None, betas: Float[np.ndarray, " B"] | None = None
) -> BodyMotion:
    """The motion of any person's skeleton on a body of ours; its ``made`` says what was decided.

    body: whose motion it becomes; the shipped one whose own skeleton it is, or the default body,
    with fingers where the file has them, where missing. betas: the person's; found from the lengths
    of limbs where missing. Raises HabitusError with the file named.
    """
    motion = read_rig_motion(path)

    def bodies(names: tuple[str, ...]) -> list[BodyModel]:
        return [body] if body is not None else _shipped(names)

    try:
        with one_blas_thread():
            return body_motion_of(motion, bodies, betas)
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error


def _shipped(names: tuple[str, ...]) -> list[BodyModel]:
    """The default body, and where the names are ours the others that it may be."""
    joints = None
    if "left_index1" in names and "right_index1" in names:
        joints = "smplx" if "jaw" in names else "smplh"
    first = load_body("default", joints=joints)
    if not set(first.joint_names) <= set(names):
        return [first]
    others = [name for name in SHIPPED if SHIPPED[name] != SHIPPED["default"]]
    return [first, *(load_body(name, joints=joints) for name in others)]
