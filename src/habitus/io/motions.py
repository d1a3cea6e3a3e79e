"""Reads a body in motion: a fit's body.npz, what exaggerating or retargeting wrote, or an npz as
AMASS has them.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.recentred import recentred
from habitus.errors import HabitusError, shown
from habitus.io.archives import open_archive, reason
from habitus.io.fits import load_fit
from habitus.io.models.bodies import SHIPPED, load_body

BodyLike = BodyModel | str | os.PathLike[str] | None
_RATES = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
_COLUMNS = {3 * len(layout.joint_names): layout for layout in (SMPL, SMPLH, SMPLX)}


def load_motion(path: str | os.PathLike[str], body: BodyLike = None) -> BodyMotion:
    """The body in motion that an npz holds: of ``habitus mosh``, ``exaggerate`` or ``retarget``, or
    AMASS's.

    AMASS's: ``poses`` (T, 3J), ``trans`` (T, 3), ``betas``, ``mocap_framerate``, z up. ``body``:
    the model that its betas belong to, loaded or a file, where the file names none that comes
    along. Raises HabitusError, with the file named, where it holds no such motion, or where betas
    would be put on a body that is not theirs.
    """
    source = Path(path)
    arrays = _arrays(source)
    if "marker_triangles" in arrays:
        return BodyMotion.of(load_fit(source, body))
    missing = [name for name in ("poses", "trans") if name not in arrays]
    if missing:
        raise HabitusError(
            f"{source}: holds no {missing[0]}; expected the body.npz of a fit, or an npz as AMASS's"
        )
    try:
        model = _body(source, arrays, body)
        return _checked(_motion(source, arrays, model))
    except HabitusError:
        raise
    except Exception as error:  # what is there may be of any kind and shape
        raise HabitusError(
            f"{source}: its arrays do not fit together ({reason(error)}); export it anew"
        ) from error


def _arrays(source: Path) -> dict[str, np.ndarray]:
    try:
        with open_archive(source) as file:
            return {name: file.read(name) for name in file.names}
    except FileNotFoundError:
        raise HabitusError(f"{source}: no such file; expected an npz with poses") from None
    except (OSError, HabitusError) as error:
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected an npz with poses"
        ) from error


def _body(source: Path, arrays: dict[str, np.ndarray], body: BodyLike) -> BodyModel:
    """The body that the betas belong to."""
    character = arrays.get("character_vertices")
    told = next(
        (
            str(arrays[key])
            for key in ("character_base", "body", "surface_model_type")
            if key in arrays
        ),
        "",
    )
    if body is None and told not in SHIPPED:
        whose = (
            f"belong to the body {shown(told)!r}"
            if told
            else "do not say to which body they belong"
        )
        raise HabitusError(f"{source}: its betas {whose}; give it, --body FILE")
    if isinstance(body, BodyModel):
        model = body
    else:
        layout = _COLUMNS.get(arrays["poses"].shape[-1])
        by_name = str(told if body is None else body) in SHIPPED
        joints = (
            layout.name if by_name and layout is not None and "body_betas" not in arrays else None
        )
        model = load_body(os.fspath(told if body is None else body), joints=joints)
    if model.name in SHIPPED and SHIPPED[model.name] != SHIPPED.get(told, ""):
        raise HabitusError(
            f"{source}: its betas belong to {shown(told) or 'SMPL-H or a like body'}; on "
            f"{model.name} they would be "
            "another person; give the body that they belong to, --body FILE"
        )
    if "age_years" in arrays and model.age is None and model.ages is not None:
        model = model.at_age(float(arrays["age_years"]))
    return (
        model
        if character is None
        else recentred(model, character, str(arrays["surface_model_type"]))
    )


def _motion(source: Path, arrays: dict[str, np.ndarray], body: BodyModel) -> BodyMotion:
    betas = np.asarray(
        arrays.get("body_betas", arrays.get("betas", np.zeros(0))), np.float64
    ).ravel()
    if len(betas) > body.num_betas:
        if betas[body.num_betas :].any():
            raise HabitusError(
                f"{source}: {len(betas)} betas; {body.name} has {body.num_betas}; give its own body"
            )
        betas = betas[: body.num_betas]
    rate = next((float(arrays[name]) for name in _RATES if name in arrays), np.nan)
    made = (
        tuple(map(str, np.atleast_1d(arrays["made"])))
        if "made" in arrays
        else (f"read from {source.name}",)
    )
    if np.any(arrays.get("dmpls", 0)):
        made += ("its dmpls, soft tissue in a basis of SMPL's, were left out",)
    return BodyMotion(
        body=body,
        betas=np.pad(betas, (0, body.num_betas - len(betas))),
        pose=_pose(source, np.asarray(arrays["poses"], np.float64), body),
        trans=np.asarray(arrays["trans"], np.float64),
        rate_hz=rate,
        up_axis=str(arrays["up_axis"]) if "up_axis" in arrays else "+z",
        soft_tissue=_optional(arrays, "soft_tissue_betas"),
        dynamics=_optional(arrays, "soft_tissue_dynamics"),
        capture_name=str(arrays["capture"]) if "capture" in arrays else source.stem,
        body_name=str(arrays.get("surface_model_type", arrays.get("body", body.name))),
        gender=str(arrays["gender"]) if "gender" in arrays else "neutral",
        made=made,
    )


def _pose(
    source: Path, poses: Float[np.ndarray, "T N"], body: BodyModel
) -> Float[np.ndarray, "T J 3"]:
    """Rotation vectors of this body's joints, by their names where the file has those of another
    skeleton.
    """
    given = poses.reshape(len(poses), -1, 3)
    if given.shape[1] == body.num_joints:
        return given
    layout = _COLUMNS.get(3 * given.shape[1])
    if layout is None:
        raise HabitusError(
            f"{source}: poses of {given.shape[1]} joints; {body.name} has {body.num_joints}; "
            "expected those of SMPL, "
            "SMPL-H or SMPL-X, or of the body"
        )
    pose = np.zeros((len(given), body.num_joints, 3))
    for joint, name in enumerate(body.joint_names):
        if name in layout.joint_names:
            pose[:, joint] = given[:, layout.joint_names.index(name)]
    return pose


def _optional(arrays: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    return np.asarray(arrays[name], np.float64) if name in arrays else None


def _checked(motion: BodyMotion) -> BodyMotion:
    """The motion as it is. Raises ValueError where its arrays do not fit together."""
    frames = len(motion.trans)
    body = motion.body
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        "poses": (motion.pose, (frames, body.num_joints, 3)),
        "trans": (motion.trans, (frames, 3)),
        "soft_tissue_betas": (motion.soft_tissue, (frames, body.num_betas)),
        "soft_tissue_dynamics": (motion.dynamics, (frames, body.num_dynamics)),
    }
    for name, (array, shape) in shapes.items():
        if array is not None and (array.shape != shape or not np.isfinite(array).all()):
            raise ValueError(f"{name} of shape {array.shape}; expected finite numbers {shape}")
    if not frames or not np.isfinite(motion.betas).all():
        raise ValueError("no frames" if not frames else "betas that are not finite")
    if not 0 < motion.rate_hz < 1e6:
        raise ValueError(
            f"the rate is {motion.rate_hz:g} Hz; expected mocap_framerate, frames a second"
        )
    if motion.up_axis not in ("+x", "+y", "+z", "-x", "-y", "-z"):
        raise ValueError(f"up_axis is {shown(motion.up_axis)}")
    return motion
