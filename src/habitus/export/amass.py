"""A marker fit in the form that scripts for AMASS slice: 156 pose columns in SMPL-H's order, z up,
16 betas, dmpls.
"""

import os
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus import __version__
from habitus.body.joint_layouts import SMPLH
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.export.npz import write_arrays
from habitus.parallel.blocks import mapped
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

STYLES = ("habitus", "amass")
"""What a body.npz can look like: this project's own arrays under AMASS's names, or exactly what
AMASS scripts slice.
"""
BETAS = 16
DMPLS = 8
BODY_JOINTS = 22
SMPL_VERTICES = 6890


def write_amass(fit: "MarkerFit", path: str | os.PathLike[str]) -> None:
    """Write a ``MarkerFit`` as .npz for AMASS scripts, atomically; docs/amass.md says what fits and
    what does not.

    T frames; z is up whatever the capture's axis was; metres, radians. ``poses`` (T,156): root, the
    21 joints of SMPL-H's body by their names, 30 finger joints (zero where the body has none);
    ``trans`` (T,3), ``betas`` (16), ``dmpls`` (T,8; zero: soft tissue has another basis here),
    ``gender``, ``mocap_framerate`` (Hz).

    ``betas`` are the fit's only where its body is an SMPL-H; otherwise they are zero, because
    SMPL-H would take those of another shape space and show another person. ``body`` names the body,
    ``body_betas`` are its own betas, ``age_years`` its age where it was brought to one, and
    ``root_joint`` (3) is where its root joint rests: a body whose root rests at r stands where the
    fit stands with ``trans + root_joint - r``.

    Raises HabitusError where the body has not the joints of SMPL-H's body, and where the file
    cannot be written.
    """
    write_arrays(path, amass_arrays(fit))


def check_npz_style(style: str, body: BodyModel) -> None:
    """Raises HabitusError for a style that is not known, or that this body's joints do not fit
    in.
    """
    if style not in STYLES:
        raise HabitusError(f"npz_style is {style!r}; expected one of {', '.join(STYLES)}")
    missing = [name for name in SMPLH.joint_names[:BODY_JOINTS] if name not in body.joint_names]
    if style == "amass" and missing:
        raise HabitusError(
            f"the body {body.name} has no joint {missing[0]}, which SMPL-H's poses have: AMASS's "
            "style cannot hold its "
            "motion; leave npz_style at habitus"
        )


def amass_arrays(fit: "MarkerFit") -> dict[str, np.ndarray]:
    """The named arrays of ``write_amass``."""
    check_npz_style("amass", fit.body)
    frames = len(fit.pose)
    own = np.asarray(fit.betas, np.float64)
    root = fit.body.rest_joints(own)[0]
    pose, trans = _upright(fit, root)
    return {
        "poses": mapped(lambda part: _smplh_poses(part, fit.body.joint_names), pose),
        "trans": trans,
        "betas": _first(own, BETAS) if is_smplh(fit.body) else np.zeros(BETAS),
        "dmpls": np.zeros((frames, DMPLS)),
        "gender": np.array(str(fit.gender)),
        "mocap_framerate": np.array(float(fit.rate_hz)),
        "body": np.array(str(fit.body_name)),
        "body_betas": own,
        "root_joint": root,
        "npz_style": np.array("amass"),
        "habitus_version": np.array(__version__),
    } | ({} if fit.body.age is None else {"age_years": np.array(fit.body.age)})


def is_smplh(body: BodyModel) -> bool:
    """Whether a body's betas can be those of an SMPL-H: by its joints and its number of
    vertices.
    """
    return body.joint_names == SMPLH.joint_names and body.num_vertices == SMPL_VERTICES


def _upright(
    fit: "MarkerFit", root: np.ndarray
) -> tuple[Float[np.ndarray, "T J 3"], Float[np.ndarray, "T 3"]]:
    """Pose and trans in a world whose z is up; the root turns about its own rest place."""
    turn = up_rotation("+z").T @ up_rotation(fit.up_axis)
    pose = mapped(lambda part: _turned(part, Rotation.from_matrix(turn)), np.asarray(fit.pose))
    return pose, (np.asarray(fit.trans, np.float64) + root) @ turn.T - root


def _turned(pose: np.ndarray, turn: Rotation) -> np.ndarray:
    out = np.array(pose, np.float64)
    out[:, 0] = (turn * Rotation.from_rotvec(out[:, 0])).as_rotvec()
    return out


def _smplh_poses(pose: np.ndarray, names: tuple[str, ...]) -> Float[np.ndarray, "T 156"]:
    out = np.zeros((len(pose), len(SMPLH.joint_names), 3))
    for column, name in enumerate(SMPLH.joint_names):
        if name in names:
            out[:, column] = pose[:, names.index(name)]
    return out.reshape(len(pose), -1)


def _first(values: np.ndarray, count: int) -> np.ndarray:
    return np.pad(values[:count], (0, max(0, count - len(values))))
