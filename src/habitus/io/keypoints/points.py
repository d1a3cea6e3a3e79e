"""Keypoints in space as three cameras would see them: TRC and C3D files of Pose2Sim, OpenCap and
others, and FreeMoCap's .npy (frames, points, 3).

Three cameras look along the axes from so far away, and so closely, that a pixel is a millimetre
anywhere in the scene: the fit to cameras, its verdict and its page then take points as they take
pixels.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.keypoints import CONVENTIONS
from habitus.errors import HabitusError, listed
from habitus.io.archives import read_npy
from habitus.io.captures.read import Capture, captures_of, read_raw
from habitus.io.keypoints.read import known_keypoint
from habitus.io.names import plain_name, shown_stem
from habitus.observe.camera_rig import CameraRig, RigCamera
from habitus.observe.detections import Detections
from habitus.types import PathLike

POINT_ENDINGS = (".trc", ".c3d", ".npy")
DISTANCE = 1000.0
"""Metres of the cameras from the middle: lines of sight are parallel to .1 %."""
PIXELS_A_METRE = 1000.0
MILLIMETRE = 0.001
MAX_METRES = 100.0
"""Across all points: beyond it numbers are millimetres."""
MIN_KEYPOINTS = 8
ADDED = "_study"
"""Ending of the names of markers that OpenCap's and Pose2Sim's networks add to keypoints."""


def read_points(
    source: PathLike, rate_hz: float | None = None, convention: str | None = None
) -> tuple[Detections, CameraRig]:
    """Keypoints in space as detections of three cameras, whose pixels are millimetres.

    rate_hz: of an .npy file, which does not say it; convention: of the order of its points,
    BlazePose's 33 by default. Raises HabitusError with the file named.
    """
    path = Path(source)
    if path.suffix.lower() == ".npy":
        names, points, rate, notes = _array(path, rate_hz, convention)
        labels = names
    else:
        capture = _detected(path)
        labels = capture.labels
        names = tuple(known_keypoint(label) for label in labels)
        points, rate = np.asarray(capture.markers, float), capture.rate_hz
        notes = tuple(capture.warnings)
    kept = [k for k, name in enumerate(names) if name and name not in names[:k]]
    if len(kept) < MIN_KEYPOINTS:
        raise HabitusError(
            f"{path}: {len(kept)} of its {len(names)} points are named as keypoints are; expected "
            f"{MIN_KEYPOINTS} or more, such as left_hip, LHip, RAnkle, Nose ({listed(labels)})"
        )
    points = points[:, kept]
    rig = axes_rig(points)
    pixels = np.moveaxis(rig.project(points), 0, 1)[:, :, None]
    seen = np.asarray(np.isfinite(pixels).all(-1))
    detections = Detections(
        plain_name(path.stem),
        convention or "named",
        tuple(names[k] for k in kept),
        rig.names,
        np.where(seen[..., None], pixels, np.nan),
        seen.astype(float),
        rate,
        (*notes, "keypoints in space: a pixel is a millimetre, cameras are the three axes"),
    )
    return detections, rig


def _detected(path: Path) -> Capture:
    """The points of a file without the markers that a network added to its keypoints, which
    `habitus mosh` takes instead. Raises HabitusError.
    """
    raw, rate = read_raw(path)
    kept = [k for k, label in enumerate(raw.labels) if not label.endswith(ADDED)]
    if 0 < len(kept) < len(raw.labels):
        labels = tuple(raw.labels[k] for k in kept)
        raw = replace(raw, labels=labels, points=np.asarray(raw.points)[:, kept])
    return captures_of(raw, rate, shown_stem(path), path.name)[0]


def axes_rig(points: Float[np.ndarray, "T K 3"]) -> CameraRig:
    """Cameras that look along the axes at points (m)."""
    seen = points[np.isfinite(points).all(-1)]
    if not len(seen):
        raise HabitusError("no point is there in any frame; expected keypoints in metres or mm")
    middle = 0.5 * (seen.min(0) + seen.max(0))
    size = int(2 * PIXELS_A_METRE * (1.0 + np.ptp(seen, axis=0).max()))
    cameras = []
    for axis, name in enumerate("xyz"):
        ahead, down = np.eye(3)[axis], -np.eye(3)[(axis + 1) % 3]
        turn = np.stack([np.cross(down, ahead), down, ahead])
        place = middle - DISTANCE * ahead
        focal = np.full(2, DISTANCE * PIXELS_A_METRE)
        cameras.append(
            RigCamera(
                name, size, size, focal, np.full(2, size / 2.0), turn, -turn @ place, np.zeros(8)
            )
        )
    return CameraRig(tuple(cameras))


def _array(
    path: Path, rate_hz: float | None, convention: str | None
) -> tuple[tuple[str, ...], Float[np.ndarray, "T K 3"], float, tuple[str, ...]]:
    """FreeMoCap's points (frames, points, 3), in mm."""
    if rate_hz is None or not 0.0 < rate_hz < 1e5:
        raise HabitusError(f"{path}: does not say its frame rate; give it (--fps)")
    table = read_npy(path)
    own = convention or "blazepose33"
    if own not in CONVENTIONS:
        raise HabitusError(f"convention is {own!r}; expected one of {', '.join(CONVENTIONS)}")
    names = CONVENTIONS[own]
    if table.ndim != 3 or table.shape[1] < len(names) or table.shape[2] != 3:
        raise HabitusError(
            f"{path}: an array of {table.shape}; expected (frames, {len(names)} or more, 3), in "
            f"{own}'s order"
        )
    if not np.issubdtype(table.dtype, np.floating):
        raise HabitusError(f"{path}: numbers of {table.dtype}; expected floating ones")
    points = table[:, : len(names)].astype(float)
    points = np.where(np.abs(points) < 1e7, points, np.nan)
    seen = points[np.isfinite(points).all(-1)]
    notes: tuple[str, ...] = ()
    if len(seen) and np.ptp(seen, axis=0).max() > MAX_METRES:
        points, notes = MILLIMETRE * points, ("its numbers were read as millimetres",)
    return names, points, float(rate_hz), notes
