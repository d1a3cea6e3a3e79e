"""What a training leaves on disk: the model, the poses of its registrations, and how it went."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import habitus
from habitus.body.model import BodyModel
from habitus.io.files import atomic_write
from habitus.io.model_forms import is_official
from habitus.io.models import save_body

if TYPE_CHECKING:
    from habitus.learn.estimate import Estimate
    from habitus.learn.options import TrainOptions
    from habitus.learn.registrations import Registrations
    from habitus.learn.train import TrainedBody
    from habitus.training import Training


def write_model(body: BodyModel, folder: Path, stem: str = "model") -> list[str]:
    """The body under official names, as ``.npz`` and, the main one, in SMPL's form ``.pkl``; gives warnings back."""
    save_body(body, folder / f"{stem}.npz")
    if stem == "model" and is_official(body):
        save_body(body, folder / "model.pkl")
    elif stem == "model":
        (folder / "model.pkl").unlink(missing_ok=True)  # of an earlier run
        driven = f"{body.pose_features!r} and {body.shape_features} shape coefficients"
        return [f"no model.pkl: SMPL's form has no word for pose blend shapes driven by {driven}"]
    return []


def write_poses(path: Path, registrations: "Registrations", estimate: "Estimate") -> None:
    """Poses (N,J,3; rad), places (N,3; m), and the subjects' rest surfaces (S,V,3) and joints (S,J,3; m) as ``.npz``.

    ``registrations`` are those of the pose set; ``name`` and ``subject`` (N,) are theirs, ``subjects`` (S,) gives the
    order of the rest surfaces.
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


def write_record(
    done: "Training", registrations: "Registrations", options: "TrainOptions", seconds: Mapping[str, Sequence[float]]
) -> None:
    """training.json: version, sizes, options, energies of every step, seconds, variances along the shape directions.

    ``seconds`` has for each model those of work at which its steps ended.
    """
    body, sets = done.trained.body, Counter(registrations.set)
    record = {
        "version": habitus.__version__,
        "sex": done.sex,
        "sizes": {
            "vertices": body.num_vertices,
            "faces": body.num_faces,
            "joints": body.num_joints,
            "betas": body.num_betas,
            "pose_registrations": sets["pose"],
            "pose_subjects": len(registrations.where(set="pose").subjects),
            "shape_registrations": sets["shape"],
        },
        "options": asdict(options),
        "warnings": list(done.warnings),
        "seconds": dict(done.seconds),
        **_story(done.trained, seconds["model"]),
        "baselines": {name: _story(one, seconds[name]) for name, one in done.baselines.items()},
    }
    with atomic_write(done.folder / "training.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8")


def _story(trained: "TrainedBody", seconds: Sequence[float]) -> dict[str, Any]:
    energies = [
        {"round": r.round, "step": r.step, "total": r.energy.total, "terms": dict(r.energy.terms), "seconds": at}
        for r, at in zip(trained.history, seconds, strict=True)
    ]
    return {"energies": energies, "shape_variances": trained.shape.variances.tolist()}
