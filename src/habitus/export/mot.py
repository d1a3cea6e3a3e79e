"""OpenSim's .mot: joint angles under the coordinate names of its full-body models (Rajagopal et al.
2016).
"""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.body.joint_angles import Chains, joint_angles
from habitus.errors import HabitusError, shown
from habitus.export.euler import continuous_angles
from habitus.files import atomic_write
from habitus.parallel.blocks import blocks
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

_AXES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""From the body's axes (left, up, forward) to a segment's in OpenSim (forward, up, right)."""
_BALLS: Mapping[str, tuple[str, str, tuple[str, str, str]]] = {
    "hip": ("pelvis", "hip", ("hip_flexion", "hip_adduction", "hip_rotation")),
    "arm": ("spine3", "shoulder", ("arm_flex", "arm_add", "arm_rot")),
}
_HINGES: Mapping[str, tuple[str, str, float]] = {
    "knee_angle": ("hip", "knee", -1.0),
    "ankle_angle": ("knee", "ankle", 1.0),
}


def write_mot(fit: "Moving", path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write joint angles as .mot, atomically: degrees, seconds, metres; the names of the
    coordinates come back.

    Names, axes and signs are those of Rajagopal's model: pelvis (ground to pelvis about z, x, y; +y
    is up), hips, knees (flexion above zero), ankles, lumbar, shoulders (zero: arms hanging) and
    elbows. They are rotations of the body's joints, whose axes differ from the model's by some
    degrees, and ``pelvis_tx`` … is where the body's root joint is: to follow markers exactly run
    OpenSim's inverse kinematics on a .trc. Raises HabitusError for a body without these joints, and
    where the file cannot be written.
    """
    table = coordinates(fit)
    columns = np.column_stack([np.arange(len(fit.pose)) / fit.rate_hz, *table.values()])
    head = (
        "Coordinates",
        "version=1",
        f"nRows={len(columns)}",
        f"nColumns={columns.shape[1]}",
        "inDegrees=yes",
        "",
    )
    note = f"Motion of {shown(fit.capture_name)}; units are metres and degrees"
    line = "\t".join(["%.6f"] * columns.shape[1]) + "\n"
    with (
        atomic_write(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="\n") as file,
    ):
        file.write("\n".join([*head, note, "endheader", "\t".join(["time", *table]), ""]))
        for part in blocks(len(columns)):
            file.writelines(line % tuple(row) for row in columns[part].tolist())
    return tuple(table)


def coordinates(fit: "Moving") -> dict[str, Float[np.ndarray, " T"]]:
    """The coordinates by name, degrees and metres."""
    body = fit.body
    pose = np.asarray(fit.pose, np.float64)
    missing = [
        name
        for name in ("pelvis", "spine3", "left_hip", "right_hip")
        if name not in body.joint_names
    ]
    if missing:
        raise HabitusError(
            f"{body.name} has no joint {missing[0]}; .mot files are written of bodies with SMPL's "
            "joints"
        )
    chains = Chains(body, pose)
    world = Rotation.from_matrix(up_rotation(fit.up_axis))
    root = body.joint_names.index("pelvis")
    angles = _ball(
        ("pelvis_tilt", "pelvis_list", "pelvis_rotation"),
        world * Rotation.from_rotvec(pose[:, root]),
        None,
    )
    roots = [fit.joints(part)[:, root] for part in blocks(fit.num_frames)]
    place = np.concatenate(roots) @ up_rotation(fit.up_axis).T
    angles |= dict(zip(("pelvis_tx", "pelvis_ty", "pelvis_tz"), place.T, strict=True))
    bent = joint_angles(body, np.asarray(fit.betas, np.float64), pose).get("elbow flexion", {})
    for side, end in (("right", "r"), ("left", "l")):
        angles |= _limbs(chains, side, end)
        if side in bent:
            angles[f"elbow_flex_{end}"] = bent[side]
    back = chains.between("pelvis", "spine3")
    if back is not None:
        angles |= _ball(("lumbar_extension", "lumbar_bending", "lumbar_rotation"), back, 1.0)
    return angles


def _limbs(chains: Chains, side: str, end: str) -> dict[str, np.ndarray]:
    angles: dict[str, np.ndarray] = {}
    mirrored = 1.0 if side == "right" else -1.0
    for base, joint, names in _BALLS.values():
        turn = chains.between(
            base if base in ("pelvis", "spine3") else f"{side}_{base}", f"{side}_{joint}"
        )
        if turn is None:
            continue
        if joint == "shoulder":  # the model's arm hangs where the body's points sideways
            turn = turn * Rotation.from_euler("z", -90.0 * mirrored, degrees=True)
        angles |= _ball(tuple(f"{name}_{end}" for name in names), turn, mirrored)
    for name, (base, joint, sign) in _HINGES.items():
        turn = chains.between(f"{side}_{base}", f"{side}_{joint}")
        if turn is not None:
            angles[f"{name}_{end}"] = sign * _split(turn, left=True)[:, 0]
    return angles


def _ball(names: tuple[str, ...], turn: Rotation, mirrored: float | None) -> dict[str, np.ndarray]:
    """Three angles by name; ``mirrored`` -1 for the left side; None where the turn begins at the
    ground.
    """
    angles = _split(turn, left=mirrored is not None) * [1.0, mirrored or 1.0, mirrored or 1.0]
    return dict(zip(names, angles.T, strict=True))


def _split(turn: Rotation, left: bool) -> Float[np.ndarray, "T 3"]:
    """Angles about OpenSim's z, then x, then y, the usual value as near to zero as whole turns
    allow.
    """
    axes = Rotation.from_matrix(_AXES)
    turned = (axes * turn if left else turn) * axes.inv()
    angles = continuous_angles(turned.as_quat()[:, None], "ZXY")[:, 0]
    return angles - 360.0 * np.round(np.median(angles, axis=0) / 360.0)
