"""A fit that failed is tried again before it is called so: other frames, other starts, the worst
labels left out.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.markers.evidence import HALF
from habitus.fit.markers.hold_out import held_out_errors
from habitus.fit.markers.judge import may_improve
from habitus.fit.markers.recipe import fit_markers, iterate_fits
from habitus.fit.markers.recordings import FEWEST_MARKERS, Recording
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.suspects import Suspect
from habitus.fit.verdict import FAILED, LEVELS
from habitus.markers.layouts import MarkerLayout
from habitus.parallel.blocks import distances, mapped
from habitus.types import Progress


@dataclass(frozen=True)
class _Case:
    """What is to be fitted again."""

    body: BodyModel
    prior: PosePrior
    layout: MarkerLayout
    recording: Recording
    settings: MoshSettings

    def fit(self, **changes: object) -> MarkerFit:
        settings = replace(self.settings, **changes)
        return fit_markers(self.body, self.prior, self.layout, [self.recording], settings)[0]

    def leaving_out(self, labels: Sequence[str]) -> MarkerFit:
        rest = self._only([label for label in self.layout.labels if label not in labels])
        fit = rest.fit()
        frames = np.isfinite(self.recording.observed[..., 0]).sum(axis=0).tolist()
        seen = dict(zip(self.layout.labels, frames, strict=True))
        found = (Suspect(label, "left out: nothing fits it", seen[label]) for label in labels)
        warning = f"left out because nothing fits them: {', '.join(labels)}"
        return replace(
            fit,
            left_out=tuple(labels),
            suspects=(*(s for s in fit.suspects if s.label not in labels), *found),
            warnings=(*fit.warnings, warning),
        )

    def fitting(self, fit: MarkerFit, labels: Sequence[str]) -> tuple[str, ...]:
        """Which of the labels that were left out lie where the layout puts them on the body found
        without them.
        """
        held = self._only(labels)
        errors = held_out_errors(fit, held.layout, held.recording.observed).pose
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
    attempts = [("", fit)]
    for words, found in _attempts(case, attempts):
        attempts.append((words, found))
        if found.verdict.level != FAILED:
            break
    best = min(range(len(attempts)), key=lambda k: _rank(attempts[k][1]))
    said = ", ".join(f"{words} ({_mean_mm(found):.0f} mm)" for words, found in attempts[1:])
    kept = "the first is kept" if best == 0 else f"that with {attempts[best][0]} is kept"
    alone = ", fitted apart from the other captures" if several and best else ""
    text = (
        f"A first attempt failed ({_mean_mm(fit):.0f} mm); it was tried again with {said}: "
        f"{kept}{alone}."
    )
    return replace(attempts[best][1], tried=(text,))


def _attempts(case: _Case, before: list[tuple[str, MarkerFit]]) -> Iterator[tuple[str, MarkerFit]]:
    """What is done and what came of it, one after another; ``before`` grows as it goes."""
    yield "other frames", case.fit(frame_choice="random", seed=case.settings.seed + 1)
    yield "other starts", case.fit(start_markers="all")
    for _ in range(2):
        best = min((fit for _, fit in before), key=_rank)
        gone = (*best.left_out, *worst_labels(best))
        if not worst_labels(best) or len(gone) > case.settings.retry.max_left_out * len(
            case.layout
        ):
            return
        found = case.leaving_out(gone)
        gone = tuple(label for label in gone if label not in case.fitting(found, gone))
        if gone != found.left_out:
            found = case.leaving_out(gone)
        yield f"{len(gone)} labels left out", found


def worst_labels(fit: MarkerFit) -> tuple[str, ...]:
    """Labels whose markers the fit distrusts in most frames in which it sees them, the worst
    first.
    """
    count = np.maximum(fit.visible.sum(axis=0), 1)
    share = (fit.visible & mapped(lambda part: part < HALF, fit.marker_weights)).sum(axis=0) / count
    order = np.argsort(-share, kind="stable")[: max(0, len(fit.labels) - FEWEST_MARKERS)]
    return tuple(fit.labels[k] for k in order if share[k] > HALF)


def _rank(fit: MarkerFit) -> tuple[int, float]:
    return LEVELS.index(fit.verdict.level), _mean_mm(fit)


def _mean_mm(fit: MarkerFit) -> float:
    errors = distances(fit.observed_markers, fit.predicted_pose_stage)
    return 1e3 * float(np.nanmean(errors)) if fit.visible.any() else float("inf")
