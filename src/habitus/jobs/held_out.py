"""Every marker held out once, a few at a time."""

from collections.abc import Sequence

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.markers.hold_out import HeldMarkers, expected_offsets, held_out_errors, merged
from habitus.fit.markers.recipe import fit_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.solution import HeldOut
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_placements
from habitus.jobs.subjects import Person, leave_out
from habitus.jobs.told_places import told_errors
from habitus.markers.placements import PlacementPrior
from habitus.parallel.choose import WorkersLike, open_workers
from habitus.types import Progress


def silent(stage: str, share: float) -> None:
    """Tells nobody."""


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
    return default, told_errors(
        body, prior, person, held.layout.labels, others, settings
    ) if others else []
