"""Who is who: detections of several people in several cameras, grouped by where their rays meet and
followed over time.

In each frame, detections near the pixels that a person's last points in space predict are that
person's, one a camera, by least sum of distances: so people who touch keep their own. Of the rest,
detections of different cameras whose keypoints meet in space to within a share of the person's size
are merged, the closest first, one detection a camera; such a group is a person who was lost
nearby, or somebody new.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from habitus.errors import HabitusError
from habitus.fit.cameras.settings import CAMERAS, CameraSettings, PeopleSettings
from habitus.fit.cameras.triangulate import triangulated
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections

GAIN = 0.7
"""Share of the way from a predicted point to the one seen that a track takes,"""
MAX_JUMP = 0.25
"""up to which distance (m): a keypoint further off is another person's."""


@dataclass(frozen=True, eq=False)
class Track:
    """One person: pixels (T, C, K, 2), ideal, NaN where missing, and confidence (T, C, K)."""

    pixels: Float[np.ndarray, "T C K 2"]
    confidence: Float[np.ndarray, "T C K"]

    @property
    def seen(self) -> Bool[np.ndarray, "T C"]:
        """In which frames each camera has the person."""
        return np.asarray((self.confidence > 0.0).any(-1))


def tracks(detections: Detections, rig: CameraRig, settings: CameraSettings) -> list[Track]:
    """Everybody who is seen long enough, the one who is seen most and largest first.

    Raises HabitusError where nobody is.
    """
    pixels = np.stack(
        [
            rig_camera.ideal(own)
            for rig_camera, own in zip(
                rig.cameras, np.moveaxis(detections.pixels, 1, 0), strict=True
            )
        ],
        1,
    )
    confidence = np.where(np.isfinite(pixels).all(-1), detections.confidence, 0.0)
    size = box_sizes(pixels, confidence)
    if detections.people == 1:
        found = [np.zeros((len(pixels), pixels.shape[1]), np.int64)]
    elif len(rig.cameras) == 1:
        found = [_largest(size)]
    else:
        found = _followed(pixels, confidence, size, rig, detections.rate_hz, settings.people)
    people = []
    for who in found:
        own = who >= 0
        rows = np.maximum(who, 0)[:, :, None, None]
        sure = np.take_along_axis(confidence, rows, 2)[:, :, 0] * own[..., None]
        at = np.take_along_axis(pixels, rows[..., None], 2)[:, :, 0]
        at = np.where(sure[..., None] > 0.0, at, np.nan)
        if own.any(1).mean() >= settings.people.min_share and (sure > 0).any():
            area = np.where(own, np.take_along_axis(size, rows[..., 0], 2)[..., 0], 0.0)
            people.append((float(np.nansum(area)), Track(at, sure)))
    if not people and len(rig.cameras) == 1:
        raise HabitusError(f"{detections.name}: nobody is seen in a fifth of the frames")
    if not people:
        raise HabitusError(
            "nobody is seen by two cameras at once in a fifth of the frames; check that the "
            "calibration belongs to these detections, and that frames have the same numbers in all "
            "cameras"
        )
    return [track for _, track in sorted(people, key=lambda each: -each[0])]


def one_person(
    detections: Detections, rig: CameraRig, settings: CameraSettings = CAMERAS
) -> tuple[Detections, CameraRig]:
    """The detections of the person who is seen most, and the cameras without their distortion, in
    which these pixels are. Raises HabitusError where nobody is seen.
    """
    own = detections.of_cameras(rig.names)
    person = tracks(own, rig, settings)[0]
    cameras = tuple(replace(camera, distortion=np.zeros(8)) for camera in rig.cameras)
    followed = replace(
        own, pixels=person.pixels[:, :, None], confidence=person.confidence[:, :, None]
    )
    return followed, replace(rig, cameras=cameras)


def box_sizes(pixels: np.ndarray, confidence: np.ndarray) -> Float[np.ndarray, "T C P"]:
    """The diagonal (px) of each detection's box, NaN where there is none."""
    at = np.where(confidence[..., None] > 0.0, pixels, np.nan)
    with np.errstate(all="ignore"):
        high = np.nanmax(np.where(np.isfinite(at), at, -np.inf), axis=3)
        low = np.nanmin(np.where(np.isfinite(at), at, np.inf), axis=3)
        diagonal = np.linalg.norm(high - low, axis=-1)
    return np.where(np.isfinite(diagonal), diagonal, np.nan)


def _largest(size: Float[np.ndarray, "T C P"]) -> Int[np.ndarray, "T C"]:
    """The largest detection of each frame and camera, -1 for none."""
    filled = np.nan_to_num(size, nan=-1.0)
    return np.where(filled.max(2) > 0.0, filled.argmax(2), -1)


@dataclass(eq=False)
class _Followed:
    """A track that may go on: its detection in each frame and camera, the last frame in which
    enough cameras saw it, its points (m) there, NaN where unknown, and their velocity (m/frame).
    """

    who: Int[np.ndarray, "T C"]
    last: int
    points: Float[np.ndarray, "K 3"]
    velocity: Float[np.ndarray, "3"]

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """The median of its points (m)."""
        return _median(self.points)

    def predicted(self, frame: int) -> Float[np.ndarray, "K 3"]:
        """Its points (m) in a later frame, moved on as one."""
        return self.points + self.velocity * (frame - self.last)

    def seen(self, frame: int, who: Int[np.ndarray, " C"], points: np.ndarray) -> None:
        """Go on with detections and the points that they triangulate to; points that are not seen,
        or are far from where they were expected, move on with the others.
        """
        step = _median(points - self.points) / (frame - self.last)
        expected = self.predicted(frame)
        near = np.linalg.norm(points - expected, axis=-1, keepdims=True) < MAX_JUMP
        followed = np.where(near, expected + GAIN * (points - expected), expected)
        self.points = np.where(np.isfinite(expected), followed, points)
        self.velocity = np.where(np.isfinite(step), step, self.velocity)
        self.who[frame] = who
        self.last = frame


def _followed(
    pixels: np.ndarray,
    confidence: np.ndarray,
    size: np.ndarray,
    rig: CameraRig,
    rate_hz: float,
    settings: PeopleSettings,
) -> list[Int[np.ndarray, "T C"]]:
    """The detection of each person in each frame and camera, -1 for none. Detections near what a
    track's last points predict are its own; the others are grouped by their rays.
    """
    frames = len(pixels)
    distance = line_distances(pixels, confidence, size, rig, settings)
    everybody: list[_Followed] = []
    for t in range(frames):
        active = [k for k in everybody if t - k.last <= settings.max_gap * rate_hz]
        free = np.isfinite(size[t])
        waiting = []
        expected = [rig.project(track.predicted(t)) for track in active]
        rows = near_prediction(expected, pixels[t], confidence[t], size[t], settings)
        for track, who in zip(active, rows, strict=True):
            who = _meeting(distance[t], who, free.shape[1], settings)
            own = np.flatnonzero(who >= 0)
            if len(own):
                free[own, who[own]] = False
                if len(own) < settings.min_views:
                    track.who[t] = who
                    continue
                track.seen(t, who, _points(pixels[t], confidence[t], size[t], who, rig, settings))
            else:
                waiting.append(track)
        groups = [
            who
            for who in grouped(distance[t], free, settings)
            if (who >= 0).sum() >= settings.min_views
        ]
        points = [_points(pixels[t], confidence[t], size[t], who, rig, settings) for who in groups]
        for who, own in _by_middles(waiting, groups, points, t, settings):
            if own is None:
                everybody.append(_started(t, groups[who], points[who], frames))
            else:
                own.seen(t, groups[who], points[who])
    return [track.who for track in everybody]


def _median(points: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3"]:
    """Of those that are known, NaN where none is."""
    known = points[np.isfinite(points).all(-1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def near_prediction(
    expected: Sequence[Float[np.ndarray, "C K 2"]],
    pixels: Float[np.ndarray, "C P K 2"],
    confidence: Float[np.ndarray, "C P K"],
    size: Float[np.ndarray, "C P"],
    settings: PeopleSettings,
) -> Int[np.ndarray, "n C"]:
    """Of each track in each camera the detection, -1 for none: those with the least sum of mean
    distances from the ``expected`` pixels, up to a share of the person's size.
    """
    out = np.full((len(expected), len(size)), -1)
    if not len(expected):
        return out
    off = np.linalg.norm(np.stack(expected)[:, :, None] - pixels, axis=-1) / size[..., None]
    seen = np.isfinite(off) & (confidence > 0.0)
    count = seen.sum(-1)
    total = np.where(seen, np.minimum(off, 2.0 * settings.max_prediction), 0.0).sum(-1)
    share = np.where(count >= settings.min_common, total / np.maximum(count, 1), np.inf)
    for c in range(len(size)):
        cost = np.minimum(share[:, c], settings.max_prediction)
        for k, p in zip(*linear_sum_assignment(cost), strict=True):
            if cost[k, p] < settings.max_prediction:
                out[k, c] = p
    return out


def _meeting(
    distance: Float[np.ndarray, "n n"],
    who: Int[np.ndarray, " C"],
    people: int,
    settings: PeopleSettings,
) -> Int[np.ndarray, " C"]:
    """Those of a person's detections whose rays meet most of the others'."""
    own = np.flatnonzero(who >= 0)
    if len(own) < 2:
        return who
    rows = own * people + who[own]
    pairs = distance[np.ix_(rows, rows)].copy()
    np.fill_diagonal(pairs, np.nan)
    out = who.copy()
    out[own[np.nanmedian(pairs, axis=1) > settings.max_line_distance]] = -1
    return out


def _by_middles(
    waiting: Sequence[_Followed],
    groups: Sequence[np.ndarray],
    points: Sequence[np.ndarray],
    frame: int,
    settings: PeopleSettings,
) -> list[tuple[int, _Followed | None]]:
    """Which group is the track that waits nearest to it, or None: somebody new."""
    middles = [_median(each) for each in points]
    pairs = sorted(
        (float(np.linalg.norm(middle - track.middle)), g, k)
        for g, middle in enumerate(middles)
        for k, track in enumerate(waiting)
    )
    out: dict[int, _Followed | None] = {}
    used: set[int] = set()
    for off, g, k in pairs:
        near = off < settings.max_step * np.sqrt(max(1.0, frame - waiting[k].last))
        if near and g not in out and k not in used:
            out[g] = waiting[k]
            used.add(k)
    new = {g: None for g in range(len(groups)) if g not in out and np.isfinite(middles[g]).all()}
    return list((out | new).items())


def _started(
    frame: int, who: Int[np.ndarray, " C"], points: Float[np.ndarray, "K 3"], frames: int
) -> _Followed:
    """A track whose first frame this is."""
    rows = np.full((frames, len(who)), -1)
    rows[frame] = who
    return _Followed(rows, frame, points, np.zeros(3))


def line_distances(
    pixels: np.ndarray,
    confidence: np.ndarray,
    size: np.ndarray,
    rig: CameraRig,
    settings: PeopleSettings,
) -> Float[np.ndarray, "T n n"]:
    """Of each pair of detections (camera and person side by side), how far apart their rays are, as
    a share of their size; infinite for those that are too far or have too little in common.
    """
    frames, cameras, people = pixels.shape[:3]
    out = np.full((frames, cameras * people, cameras * people), np.inf)
    for a, b in combinations(range(cameras), 2):
        pair = CameraRig((rig.cameras[a], rig.cameras[b]))
        for i in range(people):
            for j in range(people):
                both = (confidence[:, a, i] > 0.0) & (confidence[:, b, j] > 0.0)
                enough = both.sum(1) >= settings.min_common
                if not enough.any():
                    continue
                rows = np.flatnonzero(enough)
                two = np.stack([pixels[rows, a, i], pixels[rows, b, j]])
                sure = np.broadcast_to(both[rows], (2, *both[rows].shape)).astype(float)
                error = triangulated(pair, two, sure, np.inf)[1]
                scale = np.stack([size[rows, a, i], size[rows, b, j]])[..., None]
                with np.errstate(all="ignore"):
                    off = np.nanmedian((error / scale).max(0), axis=-1)
                off = np.where(np.isfinite(off), off, np.inf)
                out[rows, a * people + i, b * people + j] = off
                out[rows, b * people + j, a * people + i] = off
    return out


def grouped(
    distance: Float[np.ndarray, "n n"], present: Bool[np.ndarray, "C P"], settings: PeopleSettings
) -> list[Int[np.ndarray, " C"]]:
    """Detections that are one person: of each camera which, -1 for none; the closest pairs are
    merged first, groups by their mean distance.
    """
    cameras, people = present.shape
    members = [[c * people + p] for c in range(cameras) for p in range(people) if present[c, p]]
    while len(members) > 1:
        best = (settings.max_line_distance, -1, -1)
        for a, b in combinations(range(len(members)), 2):
            owners = {m // people for m in members[a]} & {m // people for m in members[b]}
            if owners:
                continue
            off = float(np.mean(distance[np.ix_(members[a], members[b])]))
            if off < best[0]:
                best = (off, a, b)
        if best[1] < 0:
            break
        _, a, b = best
        members[a] = members[a] + members.pop(b)
    groups = []
    for group in members:
        who = np.full(cameras, -1)
        for member in group:
            who[member // people] = member % people
        groups.append(who)
    return groups


def _points(
    pixels: np.ndarray,
    confidence: np.ndarray,
    size: np.ndarray,
    who: np.ndarray,
    rig: CameraRig,
    settings: PeopleSettings,
) -> Float[np.ndarray, "K 3"]:
    """A group's points in space (m), NaN where fewer than two of its cameras agree on one."""
    rows = np.flatnonzero(who >= 0)
    own = who[rows]
    cameras = CameraRig(tuple(rig.cameras[c] for c in rows))
    reach = settings.max_line_distance * size[rows, own, None]
    return triangulated(cameras, pixels[rows, own], confidence[rows, own], reach)[0]


def chosen(people: Sequence[Track], count: int | None) -> list[Track]:
    """The first ``count`` people, or all. Raises HabitusError where there are fewer."""
    if count is not None and count > len(people):
        raise HabitusError(
            f"people is {count}; {len(people)} were followed through the cameras: give fewer, or "
            "'auto'"
        )
    return list(people if count is None else people[:count])
