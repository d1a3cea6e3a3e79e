"""Result of one training, its files, and training.json."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import habitus
from habitus.body.model import BodyModel
from habitus.export.trained_body import write_model, write_poses
from habitus.files import atomic_write, writable_folder
from habitus.learn.options import TrainOptions
from habitus.learn.train import TrainedBody
from habitus.mesh.registrations import Registrations
from habitus.types import PathLike


@dataclass(frozen=True, eq=False)
class Training:
    """One trained model with its energies, estimate, warnings and seconds of work.

    ``sex`` is "female", "male" or "" (a model of all people). ``folder`` is where the files are,
    None where nothing was written. ``step_seconds`` holds for each model the seconds of work at the
    end of each step of its history. ``baselines`` are the models without pose blend shapes, by
    name. ``like`` is the body's file of two levels of detail whose full one was trained, where it
    was.
    """

    sex: str
    trained: TrainedBody
    registrations: Registrations
    options: TrainOptions
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    step_seconds: Mapping[str, Sequence[float]]
    folder: Path | None = None
    baselines: Mapping[str, TrainedBody] = field(default_factory=dict)
    like: str | None = None

    @property
    def body(self) -> BodyModel:
        """The trained body model."""
        return self.trained.body

    def save(self, folder: PathLike) -> "Training":
        """Write model.npz, model.pkl, poses.npz, training.json and the baselines' models, each
        atomically.

        The same result is returned with its folder, and with a warning where SMPL's pickle cannot
        express the model (no model.pkl is written then). Raises HabitusError where the folder
        cannot be written to.
        """
        folder = writable_folder(Path(folder))
        notes = write_model(self.body, folder, like=self.like)
        write_poses(
            folder / "poses.npz", self.registrations.where(set="pose"), self.trained.estimate
        )
        for name, baseline in self.baselines.items():
            write_model(baseline.body, folder, name)
        warnings = (*self.warnings, *(note for note in notes if note not in self.warnings))
        saved = replace(self, folder=folder, warnings=warnings)
        write_record(saved, folder)
        return saved


def write_record(done: Training, folder: Path) -> None:
    """training.json: version, sizes, options, energies of every step, seconds, variances along the
    shape directions.
    """
    body = done.body
    sets = Counter(done.registrations.set)
    seconds = done.step_seconds
    record = {
        "version": habitus.__version__,
        "sex": done.sex,
        "sizes": {
            "vertices": body.num_vertices,
            "faces": body.num_faces,
            "joints": body.num_joints,
            "betas": body.num_betas,
            "pose_registrations": sets["pose"],
            "pose_subjects": len(done.registrations.where(set="pose").subjects),
            "shape_registrations": sets["shape"],
        },
        "options": asdict(done.options),
        "warnings": list(done.warnings),
        "seconds": dict(done.seconds),
        **_history(done.trained, seconds["model"]),
        "baselines": {name: _history(one, seconds[name]) for name, one in done.baselines.items()},
    }
    with atomic_write(folder / "training.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False), encoding="utf-8")


def _history(trained: TrainedBody, seconds: Sequence[float]) -> dict[str, Any]:
    energies = [
        {
            "round": r.round,
            "step": r.step,
            "total": r.energy.total,
            "terms": dict(r.energy.terms),
            "seconds": at,
        }
        for r, at in zip(trained.history, seconds, strict=True)
    ]
    return {"energies": energies, "shape_variances": trained.shape.variances.tolist()}
