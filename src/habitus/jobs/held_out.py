"""Held-out markers: their errors at the expected placements, and at placements that other captures
of the same person give.

The layout's default places hold the technician's placement, 6 to 12 cm for wands, which is no error
of the body (M 8.1 counts it). Another capture with the same markers shows where each really sits;
in the capture that is evaluated a held-out marker is still excluded from everything.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.errors import HabitusError, listed
from habitus.fit.markers.hold_out import HeldMarkers, expected_offsets, held_out_errors, merged
from habitus.fit.markers.recipe import fit_markers, iterate_fits
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.solution import HeldOut
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_placements
from habitus.jobs.finding import MarkerSet
from habitus.jobs.options import silent
from habitus.jobs.subjects import Person, leave_out, person_of, relabelled
from habitus.markers.labels import normalised
from habitus.markers.placements import PlacementPrior
from habitus.parallel.blocks import distances
from habitus.parallel.choose import WorkersLike, open_workers
from habitus.types import Progress


def rotate_hold_out(
    body: BodyModel,
    person: Person,
    every: int,
    settings: MoshSettings,
    progress: Progress = silent,
    workers: WorkersLike = None,
    others: Sequence[Capture] = (),
    placements: PlacementPrior | None = None,
) -> tuple[list[HeldOut], list[HeldOut | None]]:
    """Each marker's held-out error, one in ``every`` left out at a time: ``every`` fits of each
    capture.

    Also the same at places that ``others`` tell, with as many fits again; None without any.
    placements: the prior that says where held-out markers are expected, by itself the one that
    comes with habitus.
    """
    if not 2 <= every <= len(person.layout):
        raise HabitusError(
            f"hold-out-every is {every}; expected 2 to {len(person.layout)}, the number of "
            "matched markers"
        )
    folds = []
    shared = (body, prior_of(body), person, every, settings, others, placements)
    progress(f"hold out 1 of {every}", 0.0)
    with open_workers(1 if workers is None else workers) as team:
        for fold in team.map(_fold, shared, range(every)):
            folds.append(fold)
            progress(f"hold out {min(len(folds) + 1, every)} of {every}", len(folds) / every)
    count = range(len(person.captures))
    told = [merged([fold[1][r] for fold in folds]) if others else None for r in count]
    return [merged([fold[0][r] for fold in folds]) for r in count], told


def errors_of(
    fit: MarkerFit, held: HeldMarkers, index: int, placements: PlacementPrior | None = None
) -> HeldOut:
    """Errors of the held-out markers in one capture of a person, where the prior expects them."""
    offsets = expected_offsets(fit, held, placements or load_placements())
    return held_out_errors(fit, held.layout, held.observed[index], offsets)


_Shared = tuple[
    BodyModel, PosePrior, Person, int, MoshSettings, Sequence[Capture], PlacementPrior | None
]


def _fold(shared: _Shared, k: int) -> tuple[list[HeldOut], list[HeldOut]]:
    body, prior, person, every, settings, others, placements = shared
    kept, held = leave_out(person, person.layout.labels[k::every])
    fits = fit_markers(body, prior, kept.layout, kept.recordings, settings)
    default = [errors_of(fit, held, index, placements) for index, fit in enumerate(fits)]
    return default, known_placement_errors(
        body, prior, person, held.layout.labels, others, settings
    ) if others else []


def known_placement_errors(
    body: BodyModel,
    prior: PosePrior,
    whole: Person,
    held: Sequence[str],
    others: Sequence[Capture],
    settings: MoshSettings,
) -> list[HeldOut]:
    """Errors of the held-out markers in each capture of a person, their places told by ``others``
    alone.

    All captures are fitted as one subject, the held-out markers hidden in the person's own. Labels
    that files exchange are put right first, judged by all captures: an identity is no place. NaN
    for markers that the others lack.
    """
    every = relabelled(person_of([*whole.captures, *others], whole.layout_choice, whole.fingers))
    own = every[: len(whole.captures)]
    rest = every[len(whole.captures) :]
    together = person_of(
        [*(_hidden(capture, held) for capture in own), *rest], whole.layout_choice, whole.fingers
    )
    fits = iterate_fits(body, prior, together.layout, together.recordings, settings)
    return [
        _errors(fit, tuple(held), _seen(capture, held))
        for fit, capture in zip(islice(fits, len(own)), own, strict=True)
    ]


def check_placements(
    whole: Person, others: Sequence[Capture], labels: Sequence[str], every: int | None
) -> tuple[str, ...]:
    """Warnings where other captures may not show the same person with the same markers.

    Raises HabitusError where nothing is held out, and where the others have none of the labels.
    """
    if not others:
        return ()
    if not labels and every is None:
        raise HabitusError(
            "placements-from tells where held-out markers sit, but none is held out: add "
            "hold-out-every K"
        )
    have = {normalised(label) for capture in others for label in capture.labels}
    wanted = tuple(labels) or whole.layout.labels
    lacking = [label for label in wanted if normalised(label) not in have]
    if len(lacking) == len(wanted):
        names = listed(tuple(capture.name for capture in others))
        raise HabitusError(
            f"placements-from: {names} has none of the held-out labels {listed(wanted)}; "
            "expected the same"
        )
    notes = [f"placements-from: not told there: {listed(lacking)}"] if lacking else []
    own = [MarkerSet.of(replace(capture, subject=None)) for capture in whole.captures]
    for other in others:
        if not any(MarkerSet.of(replace(other, subject=None)).like(worn) for worn in own):
            notes.append(
                f"placements-from: markers of {other.name} are not as far apart as here; is it the "
                "same person, and were "
                "the markers left where they were?"
            )
    return tuple(notes)


def _hidden(capture: Capture, labels: Sequence[str]) -> Capture:
    """The capture without a sample of some markers, their labels still there."""
    markers = np.array(capture.markers, dtype=float)
    markers[:, [k for k, label in enumerate(capture.labels) if label in labels]] = np.nan
    return replace(capture, markers=markers)


def _seen(capture: Capture, labels: Sequence[str]) -> np.ndarray:
    """(T, H, 3) the markers of some labels, NaN where the capture lacks one."""
    found = np.full((len(capture.markers), len(labels), 3), np.nan)
    for k, label in enumerate(labels):
        if label in capture.labels:
            found[:, k] = capture.markers[:, capture.labels.index(label)]
    return found


def _errors(fit: MarkerFit, labels: tuple[str, ...], observed: np.ndarray) -> HeldOut:
    """Distances of observed (T, H, 3) from predicted markers; the fit was told where they sit by
    other captures.
    """
    names = {normalised(label): column for column, label in enumerate(fit.labels)}
    columns = [names.get(normalised(label)) for label in labels]

    def of(predicted: np.ndarray) -> np.ndarray:
        chosen = np.full((len(predicted), len(labels), 3), np.nan)
        for k, column in enumerate(columns):
            if column is not None:
                chosen[:, k] = predicted[:, column]
        return distances(chosen, observed)

    soft = fit.predicted_soft_tissue
    return HeldOut(labels, of(fit.predicted_pose_stage), None if soft is None else of(soft))
