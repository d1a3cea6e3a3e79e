"""Tasks of an archive's processes and their results; a subject whose shape is known, as a file."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.fit.markers.shape import ShapeFit, Subject
from habitus.fit.markers.suspects import Suspect
from habitus.io.archives import open_archive, reason
from habitus.io.limits import read_json
from habitus.jobs.bodies import PersonBody
from habitus.jobs.finding import MarkerSet
from habitus.jobs.mosh import Mosh, recipe_of
from habitus.jobs.options import ArchiveOptions
from habitus.jobs.subjects import Agreed
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.observe.markers import MarkerAttachment

_ARRAYS = ("betas", "latent_markers", "pose", "trans")


@dataclass(frozen=True)
class BodyChoice:
    """Which body a subject is fitted with, in words that any process can load it by; see `Mosh` and
    `PersonBody`.
    """

    joints: str
    age: float | None
    sex: str
    female_probability: float | None
    notes: tuple[str, ...]


@dataclass(frozen=True)
class KnownSubject:
    """What a subject's captures told together: its body, layout and shape, and where each marker
    sits.
    """

    choice: BodyChoice
    agreed: Agreed
    shape: ShapeFit
    exchanged: tuple[tuple[int, int], ...]
    misplaced: tuple[int, ...]
    seconds: float
    discovered_layout: str = ""

    def subject(self, body: BodyModel) -> Subject:
        """As the recipe has it."""
        prior = prior_of(body).for_joints(body.joint_names)
        layout = self.agreed.layout
        return Subject(
            body, prior, layout, self.shape, self.exchanged, self.misplaced, self.seconds
        )

    def chosen(self, body: BodyModel) -> PersonBody:
        """The body and what is to be said of it."""
        return PersonBody(body, self.choice.sex, self.choice.female_probability, self.choice.notes)


def write_known(known: KnownSubject, path: Path) -> str:
    """Write a subject as npz, whole or not at all, and return a digest of all that a fit depends
    on.
    """
    shape = known.shape
    arrays = {name: np.asarray(getattr(shape, name), dtype=np.float64) for name in _ARRAYS}
    arrays |= {
        "triangles": shape.attachment.triangles,
        "coefficients": shape.attachment.coefficients,
    }
    record = {
        "choice": asdict(known.choice),
        "layout": asdict(known.agreed.layout),
        "agreed": asdict(replace(known.agreed, layout=None)),  # type: ignore[arg-type]
        "exchanged": known.exchanged,
        "misplaced": known.misplaced,
        "discovered_layout": known.discovered_layout,
        "shape": {"costs": shape.costs, "status": shape.status, "iterations": shape.iterations},
    }
    text = json.dumps(record, sort_keys=True, default=_plain)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            record=np.array(text),
            seconds=np.float64(known.seconds),
            **arrays,
        )
    digest = blake2b(text.encode(), digest_size=16)
    for name in sorted(arrays):
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def read_known(path: Path) -> KnownSubject:
    """What `write_known` wrote. Raises HabitusError for any other file."""
    try:
        with open_archive(path) as file:
            arrays = {name: file.read(name) for name in (*_ARRAYS, "triangles", "coefficients")}
            record = read_json(str(file.read("record")))
            seconds = float(file.read("seconds"))
        _check_arrays(arrays | {"seconds": np.array(seconds)})
        attachment = MarkerAttachment(arrays.pop("triangles"), arrays.pop("coefficients"))
        shape = ShapeFit(**arrays, attachment=attachment, **record["shape"])
        return KnownSubject(
            BodyChoice(**record["choice"] | {"notes": tuple(record["choice"]["notes"])}),
            _agreed(record["agreed"], _layout(record["layout"])),
            shape,
            tuple((i, j) for i, j in record["exchanged"]),
            tuple(record["misplaced"]),
            seconds,
            record["discovered_layout"],
        )
    except Exception as error:  # a damaged record may hold anything
        raise HabitusError(
            f"{path}: is no subject that habitus archive wrote ({reason(error)}); remove it and go "
            "on"
        ) from error


def _check_arrays(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError where arrays are not a subject's: finite numbers, as many rows as markers or
    frames.
    """
    markers = len(arrays["latent_markers"])
    shapes = {
        "latent_markers": (markers, 3),
        "triangles": (markers, 3),
        "coefficients": (markers, 3),
        "trans": (len(arrays["pose"]), 3),
    }
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"{name} of shape {arrays[name].shape}; expected {shape}")
    if arrays["betas"].ndim != 1 or arrays["pose"].ndim != 3 or arrays["pose"].shape[2] != 3:
        raise ValueError("betas or pose of another shape")
    if arrays["triangles"].dtype.kind not in "iu" or (arrays["triangles"] < 0).any():
        raise ValueError("triangles are no indices")
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} are not finite")
    if arrays["seconds"] < 0:
        raise ValueError(f"seconds are {arrays['seconds']}; expected none below 0")


def _layout(record: Mapping[str, Any]) -> MarkerLayout:
    tuples = {name: tuple(record[name]) for name in ("sources", "also_known_as", "fingerprint")}
    markers = {
        name: tuple(_marker(marker) for marker in record[name]) for name in ("markers", "fingers")
    }
    return MarkerLayout(**{**record, **tuples, **markers})


def _marker(record: Mapping[str, Any]) -> Marker:
    fields: dict[str, Any] = {
        name: tuple(x) if isinstance(x, list) else x for name, x in record.items()
    }
    return Marker(**fields)


def _agreed(record: Mapping[str, Any], layout: MarkerLayout) -> Agreed:
    suspects = tuple(Suspect(**suspect) for suspect in record["suspects"])
    return Agreed(
        layout, record["confidence"], tuple(record["warnings"]), suspects, tuple(record["doubts"])
    )


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


@dataclass(frozen=True)
class ArchiveJob:
    """Shared by all tasks: the options, and the folder of results."""

    options: ArchiveOptions
    out: Path

    @cached_property
    def recipe(self) -> Mosh:
        """How each capture is fitted."""
        return recipe_of(self.options)

    @property
    def body(self) -> str:
        """Name or file of the body, which every process loads."""
        return str(self.options.body)


@dataclass(frozen=True)
class Inspect:
    """A file to be read for who is in it."""

    path: Path


@dataclass(frozen=True)
class Seen:
    """Somebody in a file: the file's name for them, how much there is of them, and their marker
    set.
    """

    subject: str | None
    frames: int
    rate_hz: float
    markers: MarkerSet


@dataclass(frozen=True)
class FileContent:
    """Everybody in a file and a digest of its content, or why there is nobody; `no_capture`: which
    is no failure.
    """

    digest: str = ""
    people: tuple[Seen, ...] = ()
    reason: str = ""
    no_capture: bool = False


@dataclass(frozen=True)
class CaptureRef:
    """A capture as it was when it was inspected; ``person`` is somebody's name where the file holds
    several people.
    """

    path: Path
    person: str | None
    digest: str
    folder: Path


@dataclass(frozen=True)
class Shape:
    """A subject whose shape is to be found by its captures and written to a file, relative to the
    folder of results.
    """

    name: str
    captures: tuple[CaptureRef, ...]
    file: str


@dataclass(frozen=True)
class Shaped:
    """A subject's shape: a digest of it, the captures (by number) that gave frames, what it
    measures, a picture; those that cannot be fitted, by number; or why there is none, and each
    capture is to be fitted by itself.
    """

    digest: str = ""
    sources: tuple[int, ...] = ()
    bad: dict[int, str] = field(default_factory=dict)
    measured: dict[str, float] = field(default_factory=dict)
    betas: tuple[float, ...] = ()
    picture: bytes = b""
    seconds: float = 0.0
    reason: str = ""


@dataclass(frozen=True)
class Fit:
    """A capture to be fitted: with the shape in a file, or by itself."""

    capture: CaptureRef
    file: str | None


@dataclass(frozen=True)
class Fitted:
    """The numbers of a capture's metrics.json and a picture of it, or why there are none; seconds
    of CPU.
    """

    numbers: dict[str, Any] = field(default_factory=dict)
    picture: bytes = b""
    seconds: float = 0.0
    reason: str = ""


Task = Inspect | Shape | Fit
Done = FileContent | Shaped | Fitted
