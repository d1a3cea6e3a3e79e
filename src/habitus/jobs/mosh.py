"""From captures to moving bodies: read, fit, write. ``habitus mosh`` and ``habitus.mosh`` both call
this.

Held-out markers have their errors at the expected placements, and at placements that other captures
of the same person give. The layout's default places hold the technician's placement, 6 to 12 cm for
wands, which is no error of the body (M 8.1 counts it). Another capture with the same markers shows
where each really sits; in the capture that is evaluated a held-out marker is still excluded from
everything.
"""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.errors import HabitusError, listed
from habitus.export.npz import check_npz_style
from habitus.files import locked
from habitus.fit.markers.attempts import iterate_attempts
from habitus.fit.markers.hold_out import HeldMarkers, expected_offsets, held_out_errors, merged
from habitus.fit.markers.recipe import fit_markers, iterate_fits, warm_up
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import SOFT_SPACE, MoshSettings
from habitus.fit.markers.solution import HeldOut
from habitus.io.captures.read import Capture, read_captures
from habitus.io.layouts.files import load_placements
from habitus.jobs.bodies import body_of, loaded, of_sex, with_fingers
from habitus.jobs.finding import MarkerSet
from habitus.jobs.options import MarkerOptions, MoshOptions, read_age, silent, takes
from habitus.jobs.results import MarkerResult, capture_folders, save_fit
from habitus.jobs.subjects import (
    Person,
    check_each,
    check_layout,
    gather,
    leave_out,
    person_of,
    relabelled,
)
from habitus.markers.labels import normalised
from habitus.markers.placements import PlacementPrior
from habitus.parallel.blocks import distances
from habitus.parallel.workers import WorkersLike, open_workers
from habitus.report import write_index
from habitus.results.save import MARKER_FILES
from habitus.types import PathLike, Progress

if TYPE_CHECKING:
    from habitus.fit.markers.live import LiveFit

Source = Capture | PathLike


@dataclass(frozen=True)
class Mosh(MoshOptions):
    """Fits a body to motion captures: shape, pose in every frame, soft tissue, and the placement of
    each marker (MoSh).

    The options are those of ``habitus mosh``. Raises HabitusError for an option without meaning.
    """

    @property
    def recipe_settings(self) -> MoshSettings:
        """The settings of the recipe, with the options that override them."""
        base = self.settings or MoshSettings()
        if self.weights is not None:
            base = replace(base, shape=self.weights.shape_stage, pose=self.weights.pose_stage)
        space = self.soft_tissue if isinstance(self.soft_tissue, str) else SOFT_SPACE
        soft = bool(self.soft_tissue) and space != "none" and not self.causal
        return replace(
            base,
            soft_tissue=soft,
            soft_space=SOFT_SPACE if space == "none" else space,
            causal=self.causal,
            seed=self.seed,
        )

    @overload
    def fit(
        self,
        captures: Source,
        body: PathLike | BodyModel = ...,
        *,
        out: PathLike | None = ...,
        workers: WorkersLike = ...,
        progress: Progress | None = ...,
    ) -> MarkerResult: ...
    @overload
    def fit(
        self,
        captures: Sequence[Source],
        body: PathLike | BodyModel = ...,
        *,
        out: PathLike | None = ...,
        workers: WorkersLike = ...,
        progress: Progress | None = ...,
    ) -> list[MarkerResult]: ...
    def fit(
        self,
        captures: Source | Sequence[Source],
        body: PathLike | BodyModel = "default",
        *,
        out: PathLike | None = None,
        workers: WorkersLike = None,
        progress: Progress | None = None,
    ) -> MarkerResult | list[MarkerResult]:
        """The fit of one capture (read, or a file), or the list of fits of several, which are one
        subject.

        Where the files of a list hold several people, each is fitted separately. body: loaded,
        "default" or a file. out: a folder that receives ``<capture's name>/`` with body.npz,
        body.glb, metrics.json and report.html. workers (a number of threads, the address of a Dask
        scheduler, or `Workers`) share the fits of ``hold_out_every``; by default these follow each
        other, each on all cores. progress: called with (stage, share done). Raises HabitusError
        with one clear line on bad input.
        """
        single = isinstance(captures, Capture | str | os.PathLike)
        sources = _listed(captures)
        if not sources:
            raise HabitusError(
                "no capture was given; expected one file or more (C3D, TRC, CSV, TSV or npz)"
            )
        model = self.body(body)
        folder = None if out is None else Path(out)
        progress = progress or silent
        self.check(model)
        with nullcontext() if folder is None else locked(folder, MARKER_FILES):
            progress("read", 0.0)
            began = time.perf_counter()
            read = [self.read(source) for source in sources]
            read_seconds = time.perf_counter() - began
            people = gather(read, self.layout, self.subject, model, progress)
            people, model = with_fingers(people, model, body, self.joints)
            together = [capture for person in people for capture in person.captures]
            if single and len(together) > 1:
                names = ", ".join(capture.subject or "(unnamed)" for capture in together)
                raise HabitusError(
                    f"the capture holds several people: {names}; name one with subject, or give a "
                    "list"
                )
            folders = {} if folder is None else capture_folders(folder, together, len(people) > 1)
            fitted = self.fit_people(model, people, read_seconds, workers, progress)
            if folder is None:
                fits = [MarkerResult.of(fit) for _, fit in fitted]
            else:
                fits = [
                    MarkerResult.of(save_fit(fit, folders[id(capture)], self.obj, self.npz_style))
                    for capture, fit in fitted
                ]
                write_index(folder)
        return fits[0] if single else fits

    def check(self, body: BodyModel) -> None:
        """Raises HabitusError for options that do not go together, or not with this body."""
        check_npz_style(self.npz_style, body)
        check_layout(self.layout, self.hold_out, self.hold_out_every)

    def fit_people(
        self,
        body: BodyModel,
        people: Sequence[Person],
        read_seconds: float = 0.0,
        workers: WorkersLike = None,
        progress: Progress = silent,
    ) -> Iterator[tuple[Capture, MarkerFit]]:
        """Each capture of these people with its fit, as they are done; reading them took
        ``read_seconds``.

        Raises HabitusError for a capture without enough markers, before anything is fitted.
        """
        others = [capture for s in _listed(self.placements_from) for capture in self.read(s)]
        for person in people:
            check_each(person)
        if self.sex in ("female", "male"):
            body = of_sex(body, self.sex)
        progress("start", 0.0)
        startup = warm_up(body)
        share = read_seconds / max(1, sum(len(person.captures) for person in people))
        for person in people:
            notes = check_placements(person, others, self.hold_out, self.hold_out_every)
            choice = body_of(body, self, person, self.recipe_settings, progress)
            fits = self._fits(choice.body, person, others, workers, progress)
            for fit, capture in zip(fits, person.captures, strict=True):
                layout = _layout_text(person, capture)
                yield (
                    capture,
                    choice.noted(
                        fit.annotated(
                            stage_seconds={"read": share, **fit.stage_seconds},
                            startup_seconds=startup,
                            discovered_layout=layout,
                            warnings=(*fit.warnings, *notes),
                        )
                    ),
                )

    def start(self, captures: Source, body: PathLike | BodyModel = "default") -> "LiveFit":
        """A live fit: shape and marker places from these frames now, then ``.step(markers)`` for
        each frame to come.

        A few seconds in varied poses are enough. ``step`` takes the markers in the order of this
        capture's labels. Raises HabitusError with one clear line on bad input.
        """
        from habitus.fit.markers.live import LiveFit
        from habitus.io.streams.wiring import find_wiring
        from habitus.jobs.live_markers import learn_subject

        read = self.read(captures)
        settings = replace(self.recipe_settings, causal=True, soft_tissue=False)
        known, recording, capture = learn_subject(read, self.body(body), body, self, settings)
        wiring = find_wiring(capture.markers, recording.observed, 1.0)
        return LiveFit(known, capture.labels, wiring.columns, settings, recording.rate_hz)

    def body(self, given: PathLike | BodyModel) -> BodyModel:
        """The body that is fitted, with its joints and, where one is given, at its age. Raises
        HabitusError.
        """
        return loaded(given, self.joints, read_age(self.age))

    def read(self, source: Source) -> tuple[Capture, ...]:
        """The captures of a file, one a person. Raises HabitusError."""
        if self.label == "auto":
            from habitus.jobs.label import label

            return (label(source, layout=self.layout, fps=self.fps).capture(),)
        if not isinstance(source, Capture):
            return read_captures(source, fps=self.fps)
        return (source if self.fps is None else replace(source, rate_hz=self.fps),)

    def _fits(
        self,
        body: BodyModel,
        person: Person,
        others: Sequence[Capture],
        workers: WorkersLike,
        progress: Progress,
    ) -> Iterator[MarkerFit]:
        """A person's fits, one after another, with the errors of held-out markers where asked
        for.
        """
        prior = prior_of(body)
        settings = self.recipe_settings
        if self.hold_out:
            kept, held = leave_out(person, self.hold_out)
            fits = iterate_attempts(body, prior, kept.layout, kept.recordings, settings, progress)
            labels = held.layout.labels
            known = (
                known_placement_errors(body, prior, person, labels, others, settings)
                if others
                else [None] * len(held.observed)
            )
            for index, (fit, errors) in enumerate(zip(fits, known, strict=True)):
                yield fit.annotated(
                    held_out=errors_of(fit, held, index), held_out_known_placement=errors
                )
            return
        every = self.hold_out_every
        rotated = (
            None
            if every is None
            else rotate_hold_out(body, person, every, settings, progress, workers, others)
        )
        for index, fit in enumerate(
            iterate_attempts(body, prior, person.layout, person.recordings, settings, progress)
        ):
            default, known_placement = (
                (None, None) if rotated is None else (rotated[0][index], rotated[1][index])
            )
            yield fit.annotated(held_out=default, held_out_known_placement=known_placement)


def _layout_text(person: Person, capture: Capture) -> str:
    """The layout that was found by fitting, as a file's text; empty where one was known."""
    if person.discovery is None:
        return ""
    from habitus.io.layouts.draft import discovered_layout_text

    return discovered_layout_text(person.discovery, capture.name)


def _listed(sources: Source | Sequence[Source]) -> list[Source]:
    return [sources] if isinstance(sources, Capture | str | os.PathLike) else list(sources)


@takes(MoshOptions)
def mosh(
    captures: Source | Sequence[Source],
    out: PathLike | None = None,
    body: PathLike | BodyModel = "default",
    *,
    options: MoshOptions,
    workers: WorkersLike = None,
    progress: Progress | None = None,
) -> list[MarkerResult]:
    """Fit a body to the captures of one subject: a fit for each; ``out`` receives the files of
    each.

    ``habitus mosh`` as a function; see `Mosh` for the options and `Mosh.fit` for the rest. Where a
    file holds several people, each is fitted separately, or only the one named ``subject``. Raises
    HabitusError with one clear line on bad input.
    """
    return recipe_of(options).fit(
        _listed(captures), body, out=out, workers=workers, progress=progress
    )


def recipe_of(options: MarkerOptions) -> Mosh:
    """The recipe with the options that it shares with a job's."""
    names = {field.name for field in fields(Mosh)}
    return Mosh(**{f.name: getattr(options, f.name) for f in fields(options) if f.name in names})


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
    known = [merged([fold[1][r] for fold in folds]) if others else None for r in count]
    return [merged([fold[0][r] for fold in folds]) for r in count], known


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
    """Errors of the held-out markers in each capture of a person, their placements taken from
    ``others`` alone.

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
            "placements-from gives placements of held-out markers, but none is held out: add "
            "hold-out-every K"
        )
    have = {normalised(label) for capture in others for label in capture.labels}
    required = tuple(labels) or whole.layout.labels
    lacking = [label for label in required if normalised(label) not in have]
    if len(lacking) == len(required):
        names = listed(tuple(capture.name for capture in others))
        raise HabitusError(
            f"placements-from: {names} has none of the held-out labels {listed(required)}; "
            "expected the same"
        )
    notes = [f"placements-from: no placement there for {listed(lacking)}"] if lacking else []
    own = [MarkerSet.of(replace(capture, subject=None)) for capture in whole.captures]
    for other in others:
        if not any(MarkerSet.of(replace(other, subject=None)).matches(markers) for markers in own):
            notes.append(
                f"placements-from: markers of {other.name} are not as far apart as here; is it the "
                "same person, and were "
                "the markers left where they were?"
            )
    return tuple(notes)


def _hidden(capture: Capture, labels: Sequence[str]) -> Capture:
    """The capture without a sample of some markers, their labels still there."""
    markers = np.array(capture.markers, dtype=float)
    markers[:, [k for k, name in enumerate(capture.labels) if name in labels]] = np.nan
    return replace(capture, markers=markers)


def _seen(capture: Capture, labels: Sequence[str]) -> np.ndarray:
    """(T, H, 3) the markers of some labels, NaN where the capture lacks one."""
    markers = np.full((len(capture.markers), len(labels), 3), np.nan)
    for k, name in enumerate(labels):
        if name in capture.labels:
            markers[:, k] = capture.markers[:, capture.labels.index(name)]
    return markers


def _errors(fit: MarkerFit, labels: tuple[str, ...], observed: np.ndarray) -> HeldOut:
    """Distances of observed (T, H, 3) from predicted markers; their placements come from
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
