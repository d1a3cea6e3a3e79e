"""A subject whose shape stage is done, as a file: everything that a fit of one more of its captures
needs.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.fit.markers.suspects import Suspect
from habitus.fit.subject import ShapeFit, Subject
from habitus.jobs.genders import Chosen
from habitus.jobs.subjects import Agreed
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.observe.markers import MarkerAttachment

_ARRAYS = ("betas", "latent_markers", "pose", "trans")


@dataclass(frozen=True)
class BodyChoice:
    """Which body a subject is fitted with, in words that any process can load it by; see `Mosh` and
    `Chosen`.
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
    found_layout: str = ""

    def subject(self, body: BodyModel) -> Subject:
        """As the recipe has it."""
        prior = prior_of(body).for_joints(body.joint_names)
        layout = self.agreed.layout
        return Subject(
            body, prior, layout, self.shape, self.exchanged, self.misplaced, self.seconds
        )

    def chosen(self, body: BodyModel) -> Chosen:
        """The body and what is to be said of it."""
        return Chosen(body, self.choice.sex, self.choice.female_probability, self.choice.notes)


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
    told = {
        "choice": asdict(known.choice),
        "layout": asdict(known.agreed.layout),
        "agreed": asdict(replace(known.agreed, layout=None)),  # type: ignore[arg-type]
        "exchanged": known.exchanged,
        "misplaced": known.misplaced,
        "found_layout": known.found_layout,
        "shape": {"costs": shape.costs, "status": shape.status, "iterations": shape.iterations},
    }
    text = json.dumps(told, sort_keys=True, default=_plain)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            allow_pickle=False,
            told=np.array(text),
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
        with np.load(path) as file:
            arrays = {name: file[name] for name in (*_ARRAYS, "triangles", "coefficients")}
            told = json.loads(str(file["told"]))
            seconds = float(file["seconds"])
        attachment = MarkerAttachment(arrays.pop("triangles"), arrays.pop("coefficients"))
        shape = ShapeFit(**arrays, attachment=attachment, **told["shape"])
        return KnownSubject(
            BodyChoice(**told["choice"] | {"notes": tuple(told["choice"]["notes"])}),
            _agreed(told["agreed"], _layout(told["layout"])),
            shape,
            tuple((i, j) for i, j in told["exchanged"]),
            tuple(told["misplaced"]),
            seconds,
            told["found_layout"],
        )
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise HabitusError(
            f"{path}: is no subject that habitus archive wrote ({error}); remove it and go on"
        ) from error


def _layout(told: Mapping[str, Any]) -> MarkerLayout:
    tuples = {name: tuple(told[name]) for name in ("sources", "also_known_as", "fingerprint")}
    markers = {name: tuple(_marker(one) for one in told[name]) for name in ("markers", "fingers")}
    return MarkerLayout(**{**told, **tuples, **markers})


def _marker(told: Mapping[str, Any]) -> Marker:
    fields: dict[str, Any] = {
        name: tuple(x) if isinstance(x, list) else x for name, x in told.items()
    }
    return Marker(**fields)


def _agreed(told: Mapping[str, Any], layout: MarkerLayout) -> Agreed:
    suspects = tuple(Suspect(**one) for one in told["suspects"])
    return Agreed(
        layout, told["confidence"], tuple(told["warnings"]), suspects, tuple(told["doubts"])
    )


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")
