"""The start of a live fit to markers, and its result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError, listed
from habitus.fit.markers.gaps import MarkerTargets
from habitus.fit.markers.live import (
    Quality,
    QualityLimits,
    marker_tracker,
    saved_subject,
    subject_of,
)
from habitus.fit.markers.recipe import PoseStage, assemble, warm_up
from habitus.fit.markers.recordings import MIN_MARKERS, Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.sequence import SequenceResult
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import Subject
from habitus.fit.markers.suspects import exchange
from habitus.io.captures.read import Capture, captures_of
from habitus.io.layouts.files import list_layouts
from habitus.io.streams.open import open_source
from habitus.io.streams.source import Source
from habitus.io.streams.wiring import find_wiring
from habitus.io.units import METRES
from habitus.jobs.bodies import aged_body, of_sex, with_fingers
from habitus.jobs.live_start import Evidence, Followed, Gathered, LivePerson, Track
from habitus.jobs.options import LiveOptions, MoshOptions
from habitus.jobs.results import save_fit
from habitus.jobs.subjects import LayoutChoice, Person, gather
from habitus.kernels.threads import one_blas_thread
from habitus.solve.terms import geman_mcclure_weight
from habitus.types import PathLike


@dataclass(frozen=True)
class MarkerStart:
    """How a live fit to markers starts: the options, the body to fit or the earlier fit whose shape
    is taken, the recipe's settings, and whether ``options.fps`` is the stream's own rate.
    """

    options: LiveOptions
    source: MarkerFit | BodyModel
    settings: MoshSettings
    fps_is_rate: bool = True

    @property
    def fit(self) -> MarkerFit | None:
        """The earlier fit."""
        return self.source if isinstance(self.source, MarkerFit) else None

    @property
    def is_known(self) -> bool:
        """Whether there is one."""
        return self.fit is not None

    @property
    def model(self) -> BodyModel:
        """The body."""
        return self.source.body if isinstance(self.source, MarkerFit) else self.source

    @property
    def rate_hz(self) -> float | None:
        """Rate of the stream, where it is given."""
        return self.options.fps if self.fps_is_rate else None

    def open(self, source: str, address: PathLike | None) -> Source:
        """A stream of markers. Raises HabitusError."""
        return open_source(source, address, self.options.fps)

    def learn(self, name: str, gathered: Gathered) -> Followed:
        """The subject of the frames. Raises HabitusError where they do not tell it."""
        return _learn(name, gathered, self)

    def save(self, fit: MarkerFit, folder: PathLike) -> None:
        """Write all files of a marker fit."""
        save_fit(fit, folder)


def _learn(name: str, gathered: Gathered, start: MarkerStart) -> Followed:
    """Who the gathered frames show. Raises HabitusError where they do not tell it."""
    heading = gathered.heading
    rate = gathered.rate_hz
    points = np.stack([frame.points for frame in gathered.frames])
    if not np.isfinite(points).any():
        raise HabitusError(f"{name}: no labelled point is seen")
    captures = captures_of(replace(heading, points=points, rate_hz=rate), rate, name, name)
    options = start.options
    if start.fit is None:
        known, recording, capture = learn_subject(
            captures, start.model, options.body, options, start.settings
        )
    else:
        known, recording, capture = known_subject(captures, start.fit, options, start.settings)
    wiring = find_wiring(points, recording.observed, METRES[capture.unit])
    lost = [label for label, k in zip(known.layout.labels, wiring.columns, strict=True) if k < 0]
    if lost:
        raise HabitusError(
            f"{name}: which of its points are {listed(lost)} is not clear; check for labels that "
            "repeat"
        )
    markers = np.stack([wiring.markers(each) for each in points])
    tracker = marker_tracker(known, start.settings, rate)
    frames = tuple(tracker.step(each) for each in markers)
    layout = known.layout
    by = f"{len(layout)} markers ({layout.name})"
    return Followed(
        LivePerson(known.body, known.betas, layout.labels, by, recording.up_axis, rate),
        "as saved" if start.is_known else f"shape in {known.seconds:.1f} s",
        recording.warnings,
        wiring,
        tracker,
        Quality(layout.labels, rate, QualityLimits.of_markers(start.settings)),
        frames,
        markers,
        lambda observed: Evidence(observed, observed),
        partial(marker_result, known, recording, start.settings),
    )


def marker_result(
    known: Subject,
    recording: Recording,
    settings: MoshSettings,
    track: Track,
    notes: Sequence[str],
) -> MarkerFit:
    """The fit of all frames; those without anybody are flagged."""
    observed = exchange(track.observed, known.exchanged)
    scale = np.full(observed.shape[1], settings.robust_scale[1])
    result = SequenceResult(
        track.pose,
        track.trans,
        None,
        {"frames": float(track.costs.sum())},
        track.costs,
        np.ones(observed.shape[:2]),
        "causal",
        len(track.costs),
        (float(track.costs.sum()),),
    )
    stage = PoseStage(result, observed, MarkerTargets(observed, None), scale)
    recording = replace(recording, warnings=(*recording.warnings, *notes))
    seconds = {"shape": known.seconds, "pose": None, "soft_tissue": None}
    fit = assemble(recording, known, stage, None, seconds, settings)
    distances = np.linalg.norm(fit.observed_markers - fit.predicted_pose_stage, axis=2)
    return replace(fit, marker_weights=np.nan_to_num(geman_mcclure_weight(distances, scale)))


def learn_subject(
    captures: Sequence[Capture],
    model: BodyModel,
    given: PathLike | BodyModel,
    options: MoshOptions | LiveOptions,
    settings: MoshSettings,
) -> tuple[Subject, Recording, Capture]:
    """The person of some frames, shape and placements estimated from them; the frames on the
    markers in use, and as they were captured. ``given``: the body as it was asked for.

    Raises HabitusError where they hold several people, or too few known markers.
    """
    people = gather([captures], options.layout, options.subject, model)
    people, model = with_fingers(people, model, given, options.joints)
    model = aged_body(model, options.age, people[0])[0]
    model = of_sex(model, "neutral" if options.sex == "auto" else options.sex)
    if len(people) > 1 or len(people[0].captures) > 1:
        raise HabitusError("the capture holds several people; name one with subject")
    warm_up(model)
    person = people[0]
    with one_blas_thread():  # the matrices are small: more threads only wait for each other
        known = subject_of(model, prior_of(model), person.layout, person.recordings[0], settings)
    return known, _of(person.recordings[0], person, known), person.captures[0]


def known_subject(
    captures: Sequence[Capture], fit: MarkerFit, options: LiveOptions, settings: MoshSettings
) -> tuple[Subject, Recording, Capture]:
    """A person known from an earlier fit; the frames on the markers that both have, and as
    captured.

    Raises HabitusError where fewer than four labels of the stream were in that fit.
    """
    chosen = _chosen(captures, options.subject)
    shared = [label for label in fit.labels if label in chosen.labels]
    if len(shared) < MIN_MARKERS:
        raise HabitusError(
            f"of the saved subject's markers ({listed(fit.labels, 6)}) the stream has "
            f"{len(shared)}; it has "
            f"{listed(chosen.labels, 6)}; expected at least {MIN_MARKERS}: the same labels as "
            f"in {fit.capture_name}"
        )
    people = gather([[chosen]], _layout_of(fit, options), None, fit.body)
    layout = people[0].layout
    layout = layout.restricted_to(tuple(label for label in layout.labels if label in fit.labels))
    warm_up(fit.body)
    known = saved_subject(fit, prior_of(fit.body), layout, settings)
    return known, _of(people[0].recordings[0], people[0], known), chosen


def _layout_of(fit: MarkerFit, options: LiveOptions) -> LayoutChoice:
    """The fit's, where it is a shipped one and no other is asked for."""
    return (
        fit.layout_name
        if str(options.layout) == "auto" and fit.layout_name in list_layouts()
        else options.layout
    )


def _chosen(captures: Sequence[Capture], name: str | None) -> Capture:
    if name is None:
        return captures[0]
    for capture in captures:
        if (capture.subject or "").lower() == name.lower():
            return capture
    raise HabitusError(
        f"the stream has no person called {name!r}; it holds "
        f"{listed(c.subject or '(unnamed)' for c in captures)}"
    )


def _of(recording: Recording, person: Person, known: Subject) -> Recording:
    """The recording on the known subject's markers."""
    columns = [person.layout.labels.index(label) for label in known.layout.labels]
    return replace(recording, observed=np.ascontiguousarray(recording.observed[:, columns]))
