"""From captures to moving bodies: read, fit, write. ``habitus mosh`` and ``habitus.mosh`` both call
this.
"""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypedDict, Unpack, overload

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.export.amass import check_npz_style
from habitus.files import locked
from habitus.fit.markers.attempts import iterate_attempts
from habitus.fit.markers.live import LiveFit
from habitus.fit.markers.recipe import warm_up
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import SOFT_SPACE, MoshSettings, MoshWeights
from habitus.io.captures.read import Capture, read_captures
from habitus.io.layouts.draft import found_layout_text
from habitus.io.streams.wiring import find_wiring
from habitus.jobs.ages import read_age
from habitus.jobs.bodies import loaded, with_fingers
from habitus.jobs.discovering import check_layout
from habitus.jobs.genders import check_sex, model_of, of_sex
from habitus.jobs.held_out import errors_of, rotate_hold_out, silent
from habitus.jobs.label import check_labelling, labelled_capture
from habitus.jobs.live_subject import Wanted, learnt
from habitus.jobs.results import MarkerResult, capture_folders, save_fit
from habitus.jobs.subjects import Person, check_each, gather, leave_out
from habitus.jobs.told_places import check_told, told_errors
from habitus.parallel.choose import WorkersLike
from habitus.report import write_index
from habitus.results.save import MARKER_FILES
from habitus.types import PathLike, Progress

Source = Capture | PathLike


class _Options(TypedDict, total=False):
    out: PathLike | None
    hold_out: Sequence[str]
    hold_out_every: int | None
    placements_from: Source | Sequence[Source]
    obj: bool
    npz_style: str
    workers: WorkersLike
    progress: Progress | None


@dataclass(frozen=True)
class Mosh:
    """Fits a body to motion captures: shape, pose in every frame, soft tissue, and where each
    marker sat (MoSh).

    The options are those of ``habitus mosh``. Raises HabitusError for a sex or an age that is
    none.
    """

    layout: PathLike = "auto"
    """Which marker sits where: "auto" (by the capture's labels), "discover" (by fitting), a shipped
    name or a file.
    """
    weights: MoshWeights = field(default_factory=MoshWeights)
    """Of the energy's terms."""
    sex: str = "neutral"
    """Which model of the body: "neutral", "female", "male", or "auto": of the sex that a neutral
    fit is sure of.
    """
    soft_tissue: bool | str = True
    """Whether the last stage lets soft tissue move, and along what: "shape" (also True), "dynamics"
    or "both".
    """
    causal: bool = False
    """Frame after frame, never looking ahead, as a live system would (no soft tissue then)."""
    subject: str | None = None
    """Which person, where a file holds several."""
    fps: float | None = None
    """Frames a second, where a file does not say or says it wrong."""
    joints: str = "auto"
    """Of the body: "smpl", "smplh" (fingers), "smplx" (jaw, eyes), "auto" (fingers where they have
    markers).
    """
    seed: int = 0
    """Of what is drawn at random."""
    age: float | str | None = None
    """Of the person, in years, for a body that has ages; "auto": what the capture's file says."""
    label: str = "given"
    """Whose labels: "given" by the file, or "auto": found on ``layout``, whatever the file calls
    its points.
    """

    def __post_init__(self) -> None:
        check_labelling(self.label)
        check_sex(self.sex)
        read_age(self.age)

    @property
    def settings(self) -> MoshSettings:
        """The settings of the recipe."""
        weights = self.weights
        return MoshSettings(
            shape=weights.shape_stage,
            pose=weights.pose_stage,
            soft_tissue=bool(self.soft_tissue) and not self.causal,
            soft_space=self.soft_tissue if isinstance(self.soft_tissue, str) else SOFT_SPACE,
            causal=self.causal,
            seed=self.seed,
        )

    @overload
    def fit(
        self, captures: Source, body: PathLike | BodyModel = ..., **options: Unpack[_Options]
    ) -> MarkerResult: ...
    @overload
    def fit(
        self, captures: Sequence[Source], body: PathLike | BodyModel = ..., **options: object
    ) -> list[MarkerResult]: ...
    def fit(
        self,
        captures: Source | Sequence[Source],
        body: PathLike | BodyModel = "default",
        *,
        out: PathLike | None = None,
        hold_out: Sequence[str] = (),
        hold_out_every: int | None = None,
        placements_from: Source | Sequence[Source] = (),
        obj: bool = False,
        npz_style: str = "habitus",
        workers: WorkersLike = None,
        progress: Progress | None = None,
    ) -> MarkerResult | list[MarkerResult]:
        """The fit of one capture (read, or a file), or the list of fits of several, which are one
        subject.

        Where the files of a list hold several people, each is fitted by itself. body: loaded,
        "default" or a file. out: a folder that receives ``<capture's name>/`` with body.npz,
        body.glb, metrics.json and report.html, and with ``obj`` a mesh a frame; npz_style "amass"
        writes body.npz as AMASS scripts slice it. hold_out leaves markers out of everything and
        reports their error; hold_out_every does so for all, one in so many at a time;
        placements_from are other captures of the same person that tell where held-out markers sit,
        for a second report; workers (a number of threads, the address of a Dask scheduler, or
        `Workers`) share these fits, which without any follow each other, each on all cores.
        progress: told (stage, share done). Raises HabitusError with one clear line on bad input.
        """
        one = isinstance(captures, Capture | str | os.PathLike)
        sources = _listed(captures)
        if not sources:
            raise HabitusError(
                "no capture was given; expected one file or more (C3D, TRC, CSV, TSV or npz)"
            )
        model = self.body(body)
        folder = None if out is None else Path(out)
        progress = progress or silent
        check_npz_style(npz_style, model)
        check_layout(self.layout, hold_out, hold_out_every)
        with nullcontext() if folder is None else locked(folder, MARKER_FILES):
            progress("read", 0.0)
            began = time.perf_counter()
            read = [self.read(source) for source in sources]
            read_seconds = time.perf_counter() - began
            people = gather(read, self.layout, self.subject, model, progress)
            people, model = with_fingers(people, model, body, self.joints)
            found = [capture for person in people for capture in person.captures]
            if one and len(found) > 1:
                names = ", ".join(capture.subject or "(unnamed)" for capture in found)
                raise HabitusError(
                    f"the capture holds several people: {names}; name one with subject, or give a "
                    "list"
                )
            folders = {} if folder is None else capture_folders(folder, found, len(people) > 1)
            told = self.read_all(_listed(placements_from))
            each = self.each_fit(
                model, people, hold_out, hold_out_every, workers, progress, read_seconds, told
            )
            if folder is None:
                fits = [MarkerResult.of(fit) for _, fit in each]
            else:
                fits = [
                    MarkerResult.of(save_fit(fit, folders[id(capture)], obj, npz_style))
                    for capture, fit in each
                ]
                write_index(folder)
        return fits[0] if one else fits

    def each_fit(
        self,
        body: BodyModel,
        people: Sequence[Person],
        hold_out: Sequence[str],
        hold_out_every: int | None,
        workers: WorkersLike,
        progress: Progress,
        read_seconds: float = 0.0,
        told: Sequence[Capture] = (),
    ) -> Iterator[tuple[Capture, MarkerFit]]:
        """Each capture of these people with its fit, as they are done; ``read_seconds`` were spent
        on reading them, and ``told`` are captures that tell where held-out markers sit.

        Raises HabitusError for a capture without enough markers, before anything is fitted.
        """
        for person in people:
            check_each(person)
        if self.sex in ("female", "male"):
            body = of_sex(body, self.sex)
        progress("start", 0.0)
        startup = warm_up(body)
        count = sum(len(person.captures) for person in people)
        for person in people:
            notes = check_told(person, told, hold_out, hold_out_every)
            model = model_of(body, self.age, self.sex, person, self.settings, progress)
            fits = self._fits(
                model.body, person, (hold_out, hold_out_every, told), workers, progress
            )
            for fit, capture in zip(fits, person.captures, strict=True):
                found = (
                    ""
                    if person.discovery is None
                    else found_layout_text(person.discovery, capture.name)
                )
                seconds = {"read": read_seconds / count, **fit.stage_seconds}
                fit = replace(
                    fit, stage_seconds=seconds, startup_seconds=startup, found_layout=found
                )
                yield capture, model.told(replace(fit, warnings=(*fit.warnings, *notes)))

    def start(self, captures: Source, body: PathLike | BodyModel = "default") -> LiveFit:
        """A live fit: shape and marker places from these frames now, then ``.step(markers)`` for
        each frame to come.

        A few seconds in varied poses are enough. ``step`` takes the markers in the order of this
        capture's labels. Raises HabitusError with one clear line on bad input.
        """
        read = self.read(captures)
        settings = replace(self.settings, causal=True, soft_tissue=False)
        wanted = Wanted(self.layout, body, self.subject, self.sex, self.joints, self.age)
        known, recording, capture = learnt(read, self.body(body), wanted, settings)
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
            return (labelled_capture(source, self.layout, self.fps),)
        if not isinstance(source, Capture):
            return read_captures(source, fps=self.fps)
        return (source if self.fps is None else replace(source, rate_hz=self.fps),)

    def read_all(self, sources: Sequence[Source]) -> list[Capture]:
        """The captures of several files. Raises HabitusError."""
        return [capture for source in sources for capture in self.read(source)]

    def _fits(
        self,
        body: BodyModel,
        person: Person,
        held_out: tuple[Sequence[str], int | None, Sequence[Capture]],
        workers: WorkersLike,
        progress: Progress,
    ) -> Iterator[MarkerFit]:
        """A person's fits, one after another, with the errors of held-out markers where they were
        asked for.
        """
        prior = prior_of(body)
        settings = self.settings
        labels, every, told = held_out
        if labels:
            kept, held = leave_out(person, labels)
            fits = iterate_attempts(body, prior, kept.layout, kept.recordings, settings, progress)
            gone = held.layout.labels
            at_told = (
                told_errors(body, prior, person, gone, told, settings)
                if told
                else [None] * len(held.observed)
            )
            for index, (fit, errors) in enumerate(zip(fits, at_told, strict=True)):
                yield replace(fit, held_out=errors_of(fit, held, index), held_out_told=errors)
            return
        rotated = (
            None
            if every is None
            else rotate_hold_out(body, person, every, settings, progress, workers, told)
        )
        for index, fit in enumerate(
            iterate_attempts(body, prior, person.layout, person.recordings, settings, progress)
        ):
            default, at_told = (
                (None, None) if rotated is None else (rotated[0][index], rotated[1][index])
            )
            yield replace(fit, held_out=default, held_out_told=at_told)


def _listed(sources: Source | Sequence[Source]) -> list[Source]:
    return [sources] if isinstance(sources, Capture | str | os.PathLike) else list(sources)


def mosh(
    captures: Source | Sequence[Source],
    out: PathLike | None = None,
    *,
    layout: PathLike = "auto",
    weights: MoshWeights | None = None,
    body: PathLike | BodyModel = "default",
    sex: str = "neutral",
    soft_tissue: bool | str = True,
    causal: bool = False,
    hold_out: Sequence[str] = (),
    hold_out_every: int | None = None,
    placements_from: Source | Sequence[Source] = (),
    subject: str | None = None,
    fps: float | None = None,
    joints: str = "auto",
    obj: bool = False,
    npz_style: str = "habitus",
    seed: int = 0,
    age: float | str | None = None,
    label: str = "given",
    workers: WorkersLike = None,
    progress: Progress | None = None,
) -> list[MarkerResult]:
    """Fit a body to the captures of one subject and, where ``out`` is given, write what comes out:
    a fit a capture.

    ``habitus mosh`` as a function; see `Mosh` and `Mosh.fit` for the options. Where a file holds
    several people, each is fitted by itself, or only the one named ``subject``. Raises HabitusError
    with one clear line on bad input.
    """
    told = (
        layout,
        weights or MoshWeights(),
        sex,
        soft_tissue,
        causal,
        subject,
        fps,
        joints,
        seed,
        age,
        label,
    )
    held_out = _Options(
        hold_out=hold_out, hold_out_every=hold_out_every, placements_from=placements_from
    )
    written = _Options(out=out, obj=obj, npz_style=npz_style)
    return Mosh(*told).fit(
        _listed(captures), body, **held_out, **written, workers=workers, progress=progress
    )
