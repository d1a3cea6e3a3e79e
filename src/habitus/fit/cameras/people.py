"""Who is who: detections of several people in several cameras, grouped by where their rays meet and
followed over time.

In each frame, detections of different cameras whose keypoints meet in space to within a share of
the person's size are merged, the closest first, one detection a camera; groups are followed by
their middles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError
from habitus.fit.cameras.settings import CAMERAS, CameraSettings, PeopleSettings
from habitus.fit.cameras.triangulate import triangulated
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections


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
    size = _size(pixels, confidence)
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


def _size(pixels: np.ndarray, confidence: np.ndarray) -> Float[np.ndarray, "T C P"]:
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


def _followed(
    pixels: np.ndarray,
    confidence: np.ndarray,
    size: np.ndarray,
    rig: CameraRig,
    rate_hz: float,
    settings: PeopleSettings,
) -> list[Int[np.ndarray, "T C"]]:
    """The detection of each person in each frame and camera, -1 for none."""
    frames, cameras = pixels.shape[:2]
    distance = _distances(pixels, confidence, size, rig, settings)
    open_tracks: list[tuple[np.ndarray, int, np.ndarray]] = []  # middle, last frame, who
    for t in range(frames):
        groups = _groups(distance[t], np.isfinite(size[t]), settings)
        groups = [who for who in groups if (who >= 0).sum() >= settings.min_views]
        middles = [_middle(pixels[t], confidence[t], who, rig) for who in groups]
        pairs = sorted(
            (float(np.linalg.norm(middle - place)), g, k)
            for g, middle in enumerate(middles)
            for k, (place, last, _) in enumerate(open_tracks)
            if t - last <= settings.max_gap * rate_hz
        )
        used_groups: set[int] = set()
        used_tracks: set[int] = set()
        for off, g, k in pairs:
            _, last, who = open_tracks[k]
            if g in used_groups or k in used_tracks:
                continue
            if off < settings.max_step * np.sqrt(max(1.0, t - last)):
                who[t] = groups[g]
                open_tracks[k] = (middles[g], t, who)
                used_groups.add(g)
                used_tracks.add(k)
        for g, who_now in enumerate(groups):
            if g not in used_groups and np.isfinite(middles[g]).all():
                who = np.full((frames, cameras), -1)
                who[t] = who_now
                open_tracks.append((middles[g], t, who))
    return [who for _, _, who in open_tracks]


def _distances(
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


def _groups(
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


def _middle(
    pixels: np.ndarray, confidence: np.ndarray, who: np.ndarray, rig: CameraRig
) -> Float[np.ndarray, "3"]:
    """The median of a group's points in space (m)."""
    own = who >= 0
    rows = np.flatnonzero(own)
    cameras = CameraRig(tuple(rig.cameras[c] for c in rows))
    at = np.stack([pixels[c, who[c]] for c in rows])
    sure = np.stack([confidence[c, who[c]] for c in rows])
    points = triangulated(cameras, at, sure, np.inf)[0]
    with np.errstate(all="ignore"):
        return np.nanmedian(points, axis=0)


def chosen(people: Sequence[Track], count: int | None) -> list[Track]:
    """The first ``count`` people, or all. Raises HabitusError where there are fewer."""
    if count is not None and count > len(people):
        raise HabitusError(
            f"people is {count}; {len(people)} were followed through the cameras: give fewer, or "
            "'auto'"
        )
    return list(people if count is None else people[:count])
