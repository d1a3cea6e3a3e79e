"""Who is followed through a stream: a person from its first frames, or one who was fitted
before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError, listed
from habitus.fit.markers.live import saved_subject, subject_of
from habitus.fit.markers.recipe import warm_up
from habitus.fit.markers.recordings import FEWEST_MARKERS, Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.subject import Subject
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import list_layouts
from habitus.jobs.ages import told_age
from habitus.jobs.bodies import with_fingers
from habitus.jobs.genders import of_sex
from habitus.jobs.subjects import Person, gather
from habitus.kernels.threads import one_blas_thread
from habitus.types import PathLike


@dataclass(frozen=True)
class Wanted:
    """Who and what is asked for: the layout, which person of several, sex, joints, age, as
    `habitus.Mosh` has it.

    ``given`` is the body as it was asked for, by name or whole.
    """

    layout: PathLike
    given: PathLike | BodyModel
    person: str | None
    sex: str
    joints: str
    age: float | str | None


def learnt(
    captures: Sequence[Capture], model: BodyModel, wanted: Wanted, settings: MoshSettings
) -> tuple[Subject, Recording, Capture]:
    """The person of some frames, shape and marker places found from them; the frames on the markers
    in use, and as they were captured.

    Raises HabitusError where they hold several people, or too few known markers.
    """
    people = gather([captures], wanted.layout, wanted.person, model)
    people, model = with_fingers(people, model, wanted.given, wanted.joints)
    model = told_age(model, wanted.age, people[0])[0]
    model = of_sex(model, "neutral" if wanted.sex == "auto" else wanted.sex)
    if len(people) > 1 or len(people[0].captures) > 1:
        raise HabitusError("the capture holds several people; name one with subject")
    warm_up(model)
    person = people[0]
    with one_blas_thread():  # the matrices are small: more threads only wait for each other
        known = subject_of(model, prior_of(model), person.layout, person.recordings[0], settings)
    return known, _of(person.recordings[0], person, known), person.captures[0]


def saved(
    captures: Sequence[Capture], fit: MarkerFit, wanted: Wanted, settings: MoshSettings
) -> tuple[Subject, Recording, Capture]:
    """A person who was fitted before; the frames on the markers that both have, and as they were
    captured.

    Raises HabitusError where fewer than four labels of the stream were in that fit.
    """
    chosen = _chosen(captures, wanted.person)
    shared = [label for label in fit.labels if label in chosen.labels]
    if len(shared) < FEWEST_MARKERS:
        raise HabitusError(
            f"of the saved subject's markers ({listed(fit.labels, 6)}) the stream has "
            f"{len(shared)}; it has "
            f"{listed(chosen.labels, 6)}; expected at least {FEWEST_MARKERS}: the same labels as "
            f"in {fit.capture_name}"
        )
    people = gather([[chosen]], _layout_of(fit, wanted), None, fit.body)
    layout = people[0].layout
    layout = layout.restricted_to(tuple(label for label in layout.labels if label in fit.labels))
    warm_up(fit.body)
    known = saved_subject(fit, prior_of(fit.body), layout, settings)
    return known, _of(people[0].recordings[0], people[0], known), chosen


def _layout_of(fit: MarkerFit, wanted: Wanted) -> PathLike:
    """The fit's, where it is one that comes along and nobody asks for another."""
    return (
        fit.layout_name
        if str(wanted.layout) == "auto" and fit.layout_name in list_layouts()
        else wanted.layout
    )


def _chosen(captures: Sequence[Capture], name: str | None) -> Capture:
    if name is None:
        return captures[0]
    for capture in captures:
        if (capture.subject or "").lower() == name.lower():
            return capture
    raise HabitusError(
        f"the stream holds nobody called {name!r}; it holds "
        f"{listed(c.subject or '(unnamed)' for c in captures)}"
    )


def _of(recording: Recording, person: Person, known: Subject) -> Recording:
    """The recording on the known subject's markers."""
    columns = [person.layout.labels.index(label) for label in known.layout.labels]
    return replace(recording, observed=np.ascontiguousarray(recording.observed[:, columns]))
