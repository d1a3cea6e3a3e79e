"""Options of the jobs that learn and evaluate bodies: `habitus train` and `evaluate`."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from habitus.evaluate.counts import COUNTS
from habitus.jobs.options import Flag, PythonOnly, metavar, unset
from habitus.learn.options import SETTINGS, TrainOptions, TrainSettings

if TYPE_CHECKING:
    from habitus.body.model import BodyModel
    from habitus.mesh.registrations import Registrations
    from habitus.mesh.template import Template
    from habitus.types import PathLike

    AnyTemplate = PathLike | Template | BodyModel
    Clean = PathLike | Registrations | None
    Counts = Sequence[int]
else:  # what a command line can say
    AnyTemplate = str
    Clean = Path | None
    Counts = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class UnitOption:
    """Of jobs that read registrations."""

    unit: Annotated[str, metavar("m|cm|mm|…")] = "m"
    """Unit of the registrations, where the data do not give it."""


@dataclass(frozen=True, kw_only=True)
class TrainingOptions(TrainOptions, UnitOption):
    """Options of `habitus train`: those of the training itself, of its data and of its results."""

    template: Annotated[AnyTemplate, metavar("default|female|male|FILE")] = "default"
    """Mesh with parts and joints: npz, toml with a mesh, or a body model; "default" is the bundled
    body.
    """
    detail: Literal["coarse", "full"] = "coarse"
    """Level of detail of a body that has two; "full" gives a body of two levels again."""
    joints: Annotated[Literal["smpl", "smplh", "smplx"] | None, unset("{smpl,smplh,smplx}")] = None
    """Joints of a body that has more; by default as in the file, and "smpl" of the bundled body."""
    sex: Literal["all", "each", "female", "male"] = "all"
    """One model of all people, one of each sex (in OUT/female and OUT/male), or one of them."""
    baselines: Flag = False
    """Also train plain LBS and plain DQBS on the same registrations."""
    every: Annotated[int, metavar("K")] = 1
    """Take one frame in K of sequences (h5)."""
    settings: Annotated[TrainSettings, PythonOnly] = SETTINGS
    """Tuning of the trainer's parts."""
    include_failed: Flag = False
    """Also train on registrations that `habitus register` judged failed."""

    @property
    def training(self) -> TrainOptions:
        """The options of the training itself."""
        return TrainOptions(**{f.name: getattr(self, f.name) for f in fields(TrainOptions)})


@dataclass(frozen=True, kw_only=True)
class DatasetOptions(UnitOption):
    """Which registrations of a dataset are measured."""

    split: Literal["test", "pose", "shape"] = "test"
    """Set of the dataset."""
    sex: Annotated[Literal["female", "male"] | None, unset("{female,male}")] = None
    """Only people of this sex."""


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions(DatasetOptions):
    """Options of `habitus evaluate`."""

    counts: Annotated[Counts, metavar("K1 K2 …")] = COUNTS
    """Numbers of shape coefficients to fit with, as far as a model has them."""
    clean: Annotated[Clean, unset("DATASET")] = None
    """The same registrations without noise, by the same names: errors are also reported against
    these.
    """
    plain: Flag = False
    """Also measure each model without its pose blend shapes."""
    repeats: Annotated[int, metavar("N")] = 20
    """Repetitions of each run-time measurement."""
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random shapes and poses of the run times."""
