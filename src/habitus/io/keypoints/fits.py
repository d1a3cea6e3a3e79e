"""Reads the body.npz of `habitus cameras` back as a fit."""

from pathlib import Path

import numpy as np

from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError, shown
from habitus.fit.cameras.result import CameraFit
from habitus.io.archives import open_archive
from habitus.io.limits import MAX_NAMES, check_count
from habitus.io.names import plain_name
from habitus.io.people import BodyLike, person_file, read_motion
from habitus.observe.camera_rig import CameraRig, RigCamera
from habitus.types import PathLike

ARRAYS = (
    "keypoint_names",
    "convention",
    "keypoints_observed",
    "keypoints_confidence",
    "keypoint_places",
    "camera_names",
    "camera_focal",
    "camera_centre",
    "camera_rotation",
    "camera_translation",
    "camera_corrections",
)
PERSON_HEIGHT = 1.7
"""Metres, of the size in pixels."""


def read_camera_fit(path: PathLike, body: BodyLike = None) -> CameraFit:
    """The fit of a body.npz, or of a result folder for its body.npz; without cameras as they were
    given, images' sizes, clocks, costs and timings, which are not in the file.

    body: as in `habitus.io.people.open_person`. Raises HabitusError, with the file named, where it
    is none of a fit to cameras.
    """
    source = person_file(path)
    motion = read_motion(source, body)
    try:
        with open_archive(source) as archive:
            if missing := [name for name in ARRAYS if name not in archive]:
                raise HabitusError(
                    f"{source}: holds no {missing[0]}; expected the body.npz of habitus cameras"
                )
            arrays = {name: archive.read(name) for name in ARRAYS}
    except OSError as error:
        raise HabitusError(f"{source}: cannot be read ({shown(error)})") from error
    try:
        fit = _fit(motion, arrays)
    except HabitusError:
        raise
    except Exception as error:
        raise HabitusError(
            f"{Path(source)}: its arrays do not fit together ({shown(error, 120)}); write it again"
        ) from error
    return fit


def _fit(motion: BodyMotion, arrays: dict[str, np.ndarray]) -> CameraFit:
    words = ("convention", "keypoint_names", "camera_names")
    numbers = {name: np.asarray(arrays[name], float) for name in ARRAYS if name not in words}
    names, cameras = (
        tuple(plain_name(str(name)) for name in np.atleast_1d(arrays[key]))
        for key in ("keypoint_names", "camera_names")
    )
    check_count(len(names), MAX_NAMES, "keypoint_names")
    frames, count = len(motion.pose), len(cameras)
    shapes = {
        "keypoints_observed": (frames, count, len(names), 2),
        "keypoints_confidence": (frames, count, len(names)),
        "keypoint_places": (len(names), 3),
        "camera_focal": (count, 2),
        "camera_centre": (count, 2),
        "camera_rotation": (count, 3, 3),
        "camera_translation": (count, 3),
        "camera_corrections": (count, 6),
    }
    for name, shape in shapes.items():
        if numbers[name].shape != shape:
            raise HabitusError(f"{name} of shape {numbers[name].shape}; expected {shape}")
        if name != "keypoints_observed" and not np.isfinite(numbers[name]).all():
            raise HabitusError(f"{name} holds numbers that are not finite")
    focal, centre = numbers["camera_focal"], numbers["camera_centre"]
    turn, shift = numbers["camera_rotation"], numbers["camera_translation"]
    rig = CameraRig(
        tuple(
            RigCamera(name, 1, 1, focal[c], centre[c], turn[c], shift[c], np.zeros(8))
            for c, name in enumerate(cameras)
        )
    )
    root = motion.body.rest_joints(motion.betas)[0] + motion.trans
    depth = root @ rig.rotation[:, 2].T + rig.translation[:, 2]
    return CameraFit(
        **{name: getattr(motion, name) for name in motion.__dataclass_fields__},
        keypoint_names=names,
        convention=str(arrays["convention"]),
        cameras=rig,
        corrections=numbers["camera_corrections"],
        late=np.zeros(count),
        observed=numbers["keypoints_observed"],
        confidence=numbers["keypoints_confidence"],
        size_px=PERSON_HEIGHT * rig.focal.mean(1) / np.maximum(depth, 0.3),
        exchanged=np.zeros((frames, count), bool),
        keypoint_places=numbers["keypoint_places"],
    )
