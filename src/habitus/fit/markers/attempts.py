"""A fit that failed is tried again before it is called so: other frames, other starts, the worst
labels left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.hold_out import held_out_errors
from habitus.fit.markers.judge import may_improve
from habitus.fit.markers.recipe import fit_recording, iterate_fits, known_subject
from habitus.fit.markers.recordings import MIN_MARKERS, Recording, few_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings, RetrySettings
from habitus.fit.markers.shape import Subject
from habitus.fit.markers.suspects import Suspect
from habitus.fit.verdict import FAILED, LEVELS
from habitus.kernels.threads import one_blas_thread
from habitus.markers.layouts import MarkerLayout
from habitus.parallel.blocks import distances, mapped
from habitus.types import Progress


@dataclass(frozen=True)
class _Attempt:
    """A fit of a capture's middle, the subject that its shape stage found, and what makes a fit of
    the whole of it.
    """

    words: str
    fit: MarkerFit
    subject: Subject
    recording: Recording
    settings: MoshSettings

    def whole(self) -> MarkerFit:
        """The fit of all frames, with all stages."""
        fit = fit_recording(self.recording, self.subject, self.settings)
        return replace(fit, left_out=self.fit.left_out)


@dataclass(frozen=True)
class _Case:
    """What is to be fitted again."""

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    recording: Recording
    settings: MoshSettings

    def attempt(self, words: str, **changes: object) -> _Attempt:
        settings = replace(self.settings, **changes)
        with one_blas_thread():
            (recording,), subject = known_subject(
                self.body,
                self.prior.for_joints(self.body.joint_names),
                self.layout,
                [self.recording],
                settings,
            )
            count = len(recording.observed)
            first = max(0, (count - settings.retry.frames) // 2)
            middle = recording.observed[first : first + settings.retry.frames]
            if few_markers(middle).all():
                middle = recording.observed
            judged = replace(recording, observed=np.ascontiguousarray(middle))
            fit = fit_recording(judged, subject, replace(settings, soft_tissue=False))
        return _Attempt(words, fit, subject, recording, settings)

    def leaving_out(self, labels: Sequence[str]) -> _Attempt:
        rest = self._only([label for label in self.layout.labels if label not in labels])
        attempt = rest.attempt(f"{len(labels)} labels left out")
        return replace(attempt, fit=replace(attempt.fit, left_out=tuple(labels)))

    def with_suspects(self, fit: MarkerFit) -> MarkerFit:
        """The fit that names the labels that were left out for it as suspects, with a warning."""
        if not fit.left_out:
            return fit
        frames = np.isfinite(self.recording.observed[..., 0]).sum(axis=0).tolist()
        seen = dict(zip(self.layout.labels, frames, strict=True))
        left_out = (
            Suspect(label, "left out: nothing fits it", seen[label]) for label in fit.left_out
        )
        others = (s for s in fit.suspects if s.label not in fit.left_out)
        warning = f"left out because nothing fits them: {', '.join(fit.left_out)}"
        return replace(fit, suspects=(*others, *left_out), warnings=(*fit.warnings, warning))

    def fitting(self, attempt: _Attempt, labels: Sequence[str]) -> tuple[str, ...]:
        """Which of the labels that were left out lie where the layout puts them on the body found
        without them.
        """
        held = self._only(labels)
        first = max(0, (len(held.recording.observed) - len(attempt.fit.pose)) // 2)
        observed = held.recording.observed[first : first + len(attempt.fit.pose)]
        errors = held_out_errors(attempt.fit, held.layout, observed).pose
        middle = [
            np.median(each[np.isfinite(each)]) if np.isfinite(each).any() else np.inf
            for each in errors.T
        ]
        return tuple(
            label
            for label, error in zip(held.layout.labels, middle, strict=True)
            if error < self.settings.retry.return_distance
        )

    def _only(self, labels: Sequence[str]) -> "_Case":
        kept = [k for k, label in enumerate(self.layout.labels) if label in labels]
        markers = tuple(self.layout.markers[k] for k in kept)
        recording = replace(
            self.recording, observed=mapped(lambda part: part[:, kept], self.recording.observed)
        )
        return replace(self, layout=replace(self.layout, markers=markers), recording=recording)


def iterate_attempts(
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recordings: Sequence[Recording],
    settings: MoshSettings | None = None,
    progress: Progress = lambda stage, share: None,
) -> Iterator[MarkerFit]:
    """`iterate_fits`, where a fit that failed is tried again; the best attempt is kept and says
    what was done.

    A capture of several is tried again by itself, so that its shape is then its own.
    """
    settings = settings or MoshSettings()
    fits = iterate_fits(body, prior, layout, recordings, settings, progress)
    for recording, fit in zip(recordings, fits, strict=True):
        yield attempted(
            fit, body, prior, layout, recording, settings, len(recordings) > 1, progress
        )


def attempted(
    fit: MarkerFit,
    body: BodyModel,
    prior: PosePrior,
    layout: MarkerLayout,
    recording: Recording,
    settings: MoshSettings,
    several: bool,
    progress: Progress = lambda stage, share: None,
) -> MarkerFit:
    """The fit of a recording, or a better one of it where that has failed; ``several``: it is one
    of a subject's.
    """
    if not may_improve(fit, fit.verdict):
        return fit
    progress(f"{recording.name}: again", 0.0)
    return _try_again(fit, _Case(body, prior, layout, recording, settings), several)


def _try_again(fit: MarkerFit, case: _Case, several: bool) -> MarkerFit:
    attempts = []
    for attempt in islice(_attempts(case, fit), case.settings.retry.shape_stages):
        attempts.append(attempt)
        if attempt.fit.verdict.level != FAILED:
            break
    if not attempts:
        return fit
    best = min(attempts, key=lambda attempt: _rank(attempt.fit))
    better = _rank(best.fit) < _rank(fit)
    tried = ", ".join(f"{each.words} ({_mean_mm(each.fit):.0f} mm)" for each in attempts)
    kept = f"that with {best.words} is kept" if better else "the first is kept"
    alone = ", fitted apart from the other captures" if several and better else ""
    text = (
        f"A first attempt failed ({_mean_mm(fit):.0f} mm); it was tried again with {tried}: "
        f"{kept}{alone}."
    )
    return replace(case.with_suspects(best.whole() if better else fit), tried=(text,))


def _attempts(case: _Case, fit: MarkerFit) -> Iterator[_Attempt]:
    """Without the labels that the fit distrusts, some of which may return; from other frames and
    starts where there are none, or too many.
    """
    retry = case.settings.retry
    gone = worst_labels(fit, retry)
    if 0 < len(gone) <= retry.max_left_out * len(case.layout):
        attempt = case.leaving_out(gone)
        yield attempt
        rest = tuple(label for label in gone if label not in case.fitting(attempt, gone))
        more = tuple(label for label in worst_labels(attempt.fit, retry) if label not in rest)
        wrong = (*rest, *more)
        if 0 < len(wrong) <= retry.max_left_out * len(case.layout) and set(wrong) != set(gone):
            yield case.leaving_out(wrong)
        return
    yield case.attempt("other frames", frame_choice="random", seed=case.settings.seed + 1)
    yield case.attempt("other starts", start_markers="all")


def worst_labels(fit: MarkerFit, settings: RetrySettings) -> tuple[str, ...]:
    """Labels whose markers the fit distrusts in most frames in which it sees them, the worst
    first.
    """
    count = np.maximum(fit.visible.sum(axis=0), 1)
    low = mapped(lambda part: part < settings.min_weight, fit.marker_weights)
    share = (fit.visible & low).sum(axis=0) / count
    order = np.argsort(-share, kind="stable")[: max(0, len(fit.labels) - MIN_MARKERS)]
    return tuple(fit.labels[k] for k in order if share[k] > settings.distrusted)


def _rank(fit: MarkerFit) -> tuple[int, float]:
    return LEVELS.index(fit.verdict.level), _mean_mm(fit)


def _mean_mm(fit: MarkerFit) -> float:
    errors = distances(fit.observed_markers, fit.predicted_pose_stage)
    return 1e3 * float(np.nanmean(errors)) if fit.visible.any() else float("inf")
