"""Recordings of one subject: checks, samples out of reach, frames with enough markers, and which
frames the shape stage uses: the paper's random ones, or spread poses with complete markers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.fit.markers.gaps import fill_short_gaps
from habitus.fit.markers.settings import (
    FLIPS,
    FRAME_CHOICE,
    OUTLIERS,
    FlipSettings,
    FrameSettings,
    MoshSettings,
    OutlierSettings,
)
from habitus.fit.markers.suspects import Suspect, find_flips, put_back, undo_swaps
from habitus.mesh.proximity import farthest_points
from habitus.parallel.blocks import blocks, joined, mapped

MIN_MARKERS = 4  # a frame with fewer keeps the prior's motion and is flagged


@dataclass(frozen=True)
class Recording:
    """One capture: markers (T, M, 3) in the layout's order, metres, NaN where missing; suspects
    found so far.

    recorded: what the capture says of the person; layout_confidence: how sure the choice of the
    layout is, 0..1; doubts: what speaks against the layout's places, a sentence each.
    """

    name: str
    observed: Float[np.ndarray, "T M 3"]
    rate_hz: float
    up_axis: str = "+z"
    warnings: tuple[str, ...] = ()
    suspects: tuple[Suspect, ...] = ()
    recorded: Mapping[str, float | str] = field(default_factory=dict)
    layout_confidence: float | None = None
    doubts: tuple[str, ...] = ()


def check_recordings(recordings: Sequence[Recording]) -> None:
    """HabitusError where no frame holds enough markers to fit a body to."""
    most_visible = max(
        (int(visible_markers(r.observed).max(initial=0)) for r in recordings), default=0
    )
    if most_visible < MIN_MARKERS:
        raise HabitusError(
            f"{', '.join(r.name for r in recordings)}: at most {most_visible} known markers are "
            "visible in any frame; "
            f"expected at least {MIN_MARKERS}; check the labels with `habitus layout check`"
        )


def with_labels_restored(
    recording: Recording, labels: tuple[str, ...], settings: FlipSettings = FLIPS
) -> Recording:
    """The recording with labels that change places for a time put back, and the suspects that tell
    of it.
    """
    flips = find_flips(recording.observed, settings)
    if not flips:
        return recording
    suspects = (*recording.suspects, *put_back(labels, flips))
    return replace(recording, observed=undo_swaps(recording.observed, flips), suspects=suspects)


def shape_frames(
    recordings: Sequence[Recording], settings: MoshSettings
) -> tuple[Float[np.ndarray, "F M 3"], tuple[int, ...]]:
    """The frames of all captures that the shape stage looks at, and the captures, by number, that
    they are of.
    """
    together = joined([fill_short_gaps(r.observed, r.rate_hz, settings.gaps) for r in recordings])
    chosen = (
        random_frames(together, settings.frames, settings.seed)
        if settings.frame_choice == "random"
        else spread_frames(together, settings.frames, settings.seed, settings.spread_frames)
    )
    ends = np.cumsum([len(r.observed) for r in recordings])
    return together[chosen], tuple(np.unique(np.searchsorted(ends, chosen, side="right")).tolist())


def few_markers(observed: Float[np.ndarray, "T M 3"]) -> Bool[np.ndarray, " T"]:
    """Frames with fewer than `MIN_MARKERS`."""
    return visible_markers(observed) < MIN_MARKERS


def visible_markers(observed: Float[np.ndarray, "T M 3"]) -> Int[np.ndarray, " T"]:
    """How many markers are seen in each frame."""
    return mapped(lambda part: np.isfinite(part[..., 0]).sum(axis=1), observed)


def first_frame(observed: Float[np.ndarray, "T M 3"]) -> int:
    """The first frame with enough markers, 0 where there is none."""
    return int(np.argmax(~few_markers(observed)))


def ever_seen(observed: Float[np.ndarray, "T M 3"]) -> Bool[np.ndarray, " M"]:
    """Which markers are seen in any frame."""
    return np.any(
        [np.isfinite(observed[part, :, 0]).any(axis=0) for part in blocks(len(observed))], axis=0
    )


def of_markers(
    observed: Float[np.ndarray, "T M 3"], chosen: Bool[np.ndarray, " M"]
) -> Float[np.ndarray, "T N 3"]:
    """The chosen markers alone, C-ordered."""
    return mapped(lambda part: np.ascontiguousarray(part[:, chosen]), observed)


def flag_warning(few: Bool[np.ndarray, " T"]) -> tuple[str, ...]:
    """A warning where any frame holds too few markers."""
    if not few.any():
        return ()
    return (
        f"{int(few.sum())} of {len(few)} frames hold fewer than {MIN_MARKERS} markers; they "
        "keep the prior's motion",
    )


def without_outliers(
    recording: Recording, labels: Sequence[str], settings: OutlierSettings = OUTLIERS
) -> Recording:
    """The recording without samples that lie further from a frame's other markers than anybody
    reaches.

    One marker at a kilometre would pull the body there. Each is named as a suspect, and a warning
    says how many.
    """
    observed = recording.observed
    far = mapped(lambda part: _outliers(part, settings), observed)
    frames = far.sum(axis=0)
    if not frames.any():
        return recording
    reason = "further away than anybody reaches; left out there"
    outliers = tuple(
        Suspect(x, reason, count) for x, count in zip(labels, frames.tolist(), strict=True) if count
    )
    warning = (
        f"{int(frames.sum())} samples lie further from the other markers than anybody "
        "reaches; they are left out"
    )
    return replace(
        recording,
        observed=mapped(lambda away, part: np.where(away[..., None], np.nan, part), far, observed),
        suspects=(*recording.suspects, *outliers),
        warnings=(*recording.warnings, warning),
    )


def _outliers(
    observed: Float[np.ndarray, "T M 3"], settings: OutlierSettings
) -> Bool[np.ndarray, "T M"]:
    far = np.zeros(observed.shape[:2], bool)
    some = np.isfinite(observed[..., 0]).any(axis=1)
    if not some.any():
        return far
    distance = np.linalg.norm(
        observed[some] - np.nanmedian(observed[some], axis=1, keepdims=True), axis=2
    )
    usual = np.nanmedian(distance, axis=1, keepdims=True)
    far[some] = distance > np.maximum(
        settings.distance, settings.ratio * usual
    )  # NaN compares false
    return far


def random_frames(
    observed: Float[np.ndarray, "T M 3"], count: int, seed: int
) -> Int[np.ndarray, " F"]:
    """``count`` frames with a marker in them, drawn at random (MoSh 6: 12 random frames)."""
    usable = np.flatnonzero(np.isfinite(observed[..., 0]).any(axis=1))
    chosen = np.random.default_rng(seed).choice(usable, size=min(count, len(usable)), replace=False)
    return np.sort(chosen)


def spread_frames(
    observed: Float[np.ndarray, "T M 3"],
    count: int,
    seed: int,
    settings: FrameSettings = FRAME_CHOICE,
) -> Int[np.ndarray, " F"]:
    """``count`` frames whose poses differ most among the most complete ones, each marker seen where
    it can be.

    Poses are compared by distances between pairs of markers, which do not change when the body
    moves as a whole.
    """
    seen = np.isfinite(observed[..., 0])
    usable = np.flatnonzero(seen.any(axis=1))
    complete = seen[usable].mean(axis=1)
    best = usable[complete >= np.quantile(complete, settings.completeness)]
    best = best[np.linspace(0, len(best) - 1, min(settings.candidates, len(best))).astype(int)]
    features = _pair_distances(observed[best], seed, settings.pairs)
    middle = np.linalg.norm(features - np.median(features, axis=0), axis=1)
    chosen = farthest_points(features, count, first=int(middle.argmin()))
    return np.sort(np.array(_cover(list(best[chosen]), seen, settings.views), dtype=np.int64))


def _pair_distances(observed: np.ndarray, seed: int, count: int) -> np.ndarray:
    """(N, count) distances between random pairs of markers, unseen ones at their median."""
    pairs = np.random.default_rng(seed).integers(observed.shape[1], size=(count, 2))
    distance = np.linalg.norm(observed[:, pairs[:, 0]] - observed[:, pairs[:, 1]], axis=2)
    known = np.isfinite(distance).any(axis=0)
    middle = np.zeros(count)
    middle[known] = np.nanmedian(distance[:, known], axis=0)
    return np.where(np.isfinite(distance), distance, middle)


def _cover(frames: list[int], seen: np.ndarray, times: int) -> list[int]:
    """Frames added until each marker that is ever seen is seen ``times`` times, as far as it can
    be.
    """
    for marker in range(seen.shape[1]):
        lacking = times - int(seen[frames, marker].sum())
        others = np.setdiff1d(np.flatnonzero(seen[:, marker]), frames)
        if lacking > 0 and len(others):
            picks = np.linspace(0, len(others) - 1, min(lacking, len(others))).astype(int)
            frames = frames + list(others[picks])
    return frames
