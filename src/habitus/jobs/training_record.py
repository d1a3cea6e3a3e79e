"""What one training came to, and training.json, which tells it."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import habitus
from habitus.evaluate.baselines.blendscape import BlendScape
from habitus.io.files import atomic_write
from habitus.learn.options import TrainOptions
from habitus.learn.train import TrainedBody
from habitus.mesh.registrations import Registrations


@dataclass(frozen=True, eq=False)
class Training:
    """One model and what came with it: the folder it lies in, whose it is ("" for all), warnings, seconds of work.

    ``baselines`` are the models without pose blend shapes, by name; with them comes BlendSCAPE.
    """

    sex: str
    folder: Path
    trained: TrainedBody
    warnings: tuple[str, ...]
    seconds: Mapping[str, float]
    baselines: Mapping[str, TrainedBody] = field(default_factory=dict)
    blendscape: BlendScape | None = None


def write_record(
    done: Training, registrations: Registrations, options: TrainOptions, seconds: Mapping[str, Sequence[float]]
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


def _story(trained: TrainedBody, seconds: Sequence[float]) -> dict[str, Any]:
    energies = [
        {"round": r.round, "step": r.step, "total": r.energy.total, "terms": dict(r.energy.terms), "seconds": at}
        for r, at in zip(trained.history, seconds, strict=True)
    ]
    return {"energies": energies, "shape_variances": trained.shape.variances.tolist()}
