"""Held-out markers judged fairly: at places on the body that other captures of the same person
told.

The layout's default places hold the technician's placement, 6 to 12 cm for wands, which is no error
of the body (M 8.1 counts it). Another capture with the same markers tells where each really sits;
in the capture that is judged a held-out marker is still left out of everything.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.errors import HabitusError, listed
from habitus.fit.markers.recipe import iterate_fits
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.solution import HeldOut
from habitus.io.captures.read import Capture
from habitus.jobs.finding import Worn
from habitus.jobs.subjects import Person, person, put_right
from habitus.markers.labels import normalised
from habitus.parallel.blocks import distances


def told_errors(
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
    every = put_right(person([*whole.captures, *others], whole.wanted, whole.fingers))
    own = every[: len(whole.captures)]
    rest = every[len(whole.captures) :]
    together = person(
        [*(_hidden(capture, held) for capture in own), *rest], whole.wanted, whole.fingers
    )
    fits = iterate_fits(body, prior, together.layout, together.recordings, settings)
    return [
        _errors(fit, tuple(held), _seen(capture, held))
        for fit, capture in zip(islice(fits, len(own)), own, strict=True)
    ]


def check_told(
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
    own = [Worn.of(replace(capture, subject=None)) for capture in whole.captures]
    for other in others:
        if not any(Worn.of(replace(other, subject=None)).like(worn) for worn in own):
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
