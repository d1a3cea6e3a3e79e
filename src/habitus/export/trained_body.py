"""What a training leaves on disk: the model, the poses of its registrations, and how it went."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from habitus.body.model import BodyModel
from habitus.files import atomic_write
from habitus.io.models.bodies import save_body
from habitus.io.models.details import is_official
from habitus.io.models.levels import save_like

if TYPE_CHECKING:
    from habitus.learn.estimate import Estimate
    from habitus.mesh.registrations import Registrations


def write_model(
    body: BodyModel, folder: Path, stem: str = "model", like: str | None = None
) -> list[str]:
    """The body under official names, as ``.npz`` and, the main one, in SMPL's form ``.pkl``; gives
    warnings back.

    The full level of a body of two levels, ``like`` that of a file, goes to a ``.npz`` of two
    levels.
    """
    if like is not None:
        save_like(body, like, folder / f"{stem}.npz")
        return [
            f"no model.pkl: {stem}.npz has two levels of detail; save_body writes one of them for "
            "others"
        ]
    save_body(body, folder / f"{stem}.npz")
    if stem == "model" and is_official(body):
        save_body(body, folder / "model.pkl")
    elif stem == "model":
        driven = f"{body.pose_features!r} and {body.shape_features} shape coefficients"
        return [f"no model.pkl: SMPL's form has no word for pose blend shapes driven by {driven}"]
    return []


def write_poses(path: Path, registrations: "Registrations", estimate: "Estimate") -> None:
    """Poses (N,J,3; rad), places (N,3; m), and the subjects' rest surfaces (S,V,3) and joints
    (S,J,3; m) as ``.npz``.

    ``registrations`` are those of the pose set; ``name`` and ``subject`` (N,) are theirs,
    ``subjects`` (S,) gives the order of the rest surfaces.
    """
    arrays = {
        "poses": estimate.pose,
        "trans": estimate.trans,
        "name": np.array(registrations.name, np.str_),
        "subject": np.array(registrations.subject, np.str_),
        "subjects": np.array(registrations.subjects, np.str_),
        "templates": estimate.templates,
        "joints": estimate.joints,
    }
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
