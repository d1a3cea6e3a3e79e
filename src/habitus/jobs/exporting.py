"""``habitus export``: a body in motion, or a person who stands still, into the files that other
programs read.
"""

import os
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.errors import HabitusError, shown
from habitus.export.motion import Exported, check_motion_path, export_motion
from habitus.io.archives import open_archive
from habitus.io.fits import load_fit
from habitus.io.models.bodies import SHIPPED, load_body
from habitus.io.motions import load_motion
from habitus.jobs.ages import at_age
from habitus.types import PathLike


def export_file(
    source: Moving | PathLike,
    to: PathLike,
    *,
    body: BodyModel | PathLike | None = None,
    fps: float | None = None,
    correctives: str = "auto",
    detail: str = "full",
    frame: int | None = None,
) -> Exported:
    """A fit, a motion, or the npz of one, as one file by its ending
    (`habitus.export.motion.export_motion`).

    Of a person without a motion (the npz of ``habitus body``, or "neutral", "female", "male": the
    mean person) it is the rig: two frames at rest, standing on the ground, +y up. body: the model
    that the betas belong to, where the file names none that comes along. Raises HabitusError.
    """
    check_motion_path(to)
    return export_motion(
        read_moving(source, body), to, fps=fps, correctives=correctives, detail=detail, frame=frame
    )


def read_moving(source: Moving | PathLike, body: BodyModel | PathLike | None = None) -> Moving:
    """A body in motion out of an npz, with its markers where it is a fit's; one that is read
    already as it is.
    """
    if isinstance(source, Moving):
        return source
    path = Path(source)
    names = _names(source)
    if "marker_triangles" in names:
        return load_fit(source, body)
    named = str(source) in SHIPPED and not path.exists()
    return (
        _still(path, body)
        if named or ("betas" in names and "poses" not in names)
        else load_motion(source, body)
    )


def _names(source: PathLike) -> frozenset[str]:
    try:
        with open_archive(Path(source)) as file:
            return frozenset(file.names)
    except (OSError, HabitusError):
        return frozenset()  # whoever reads it says what is wrong


def _still(source: Path, body: BodyModel | PathLike | None) -> BodyMotion:
    """A person at rest on the ground, for two frames."""
    held: dict[str, np.ndarray] = {}
    if str(source) not in SHIPPED:
        with open_archive(source) as file:
            held = {name: file.read(name) for name in _OF_A_PERSON if name in file.names}
    told = str(held.get("body", held.get("surface_model_type", source)))
    if body is None and told not in SHIPPED:
        raise HabitusError(
            f"{source}: its betas belong to the body {shown(told)!r}; give it, --body FILE"
        )
    model = (
        body
        if isinstance(body, BodyModel)
        else load_body(os.fspath(told if body is None else body))
    )
    model = at_age(model, float(held["age_years"]) if "age_years" in held else None)
    betas = np.asarray(held.get("body_betas", held.get("betas", np.zeros(0))), np.float64).ravel()
    if len(betas) > model.num_betas:
        raise HabitusError(
            f"{source}: {len(betas)} betas; {model.name} has {model.num_betas}; give its own body"
        )
    betas = np.pad(betas, (0, model.num_betas - len(betas)))
    floor = np.array([0.0, -float(model.rest_vertices(betas)[:, 1].min()), 0.0])
    still = np.zeros((2, model.num_joints, 3)), np.tile(floor, (2, 1))
    named = {
        "capture_name": source.stem,
        "body_name": told,
        "gender": str(held.get("gender", "neutral")),
    }
    return BodyMotion(
        model, betas, *still, 30.0, "+y", made=(f"at rest, from {source.name}",), **named
    )


_OF_A_PERSON = ("betas", "body_betas", "surface_model_type", "body", "age_years", "gender")
