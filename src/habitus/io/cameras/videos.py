"""Pictures from the cameras' videos, for overlays: decoded by OpenCV, which is an extra."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from habitus.errors import HabitusError, listed, require_extra, shown
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import plain_camera_name
from habitus.types import PathLike

ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".webm")
MAX_SIZE_DIFFERENCE = 0.02
"""Share by which a video's size may differ from the calibration's: encoders pad and crop by some
pixels."""
MAX_SIDE = 16_384
"""Pixels of a frame's side."""


@dataclass(frozen=True)
class Video:
    """One camera's video: its file, the size of its frames (pixels), their rate and number."""

    path: Path
    width: int
    height: int
    rate_hz: float
    frames: int


def read_videos(folder: PathLike, rig: CameraRig) -> dict[str, Video]:
    """The videos in a folder, by the names of the cameras, which their own match by letters and
    numbers; other files are left out.

    Raises HabitusError where OpenCV is missing, where no video is a camera's, or where a video's
    size is another than its calibration's: keypoints of such videos are in other pixels.
    """
    where = Path(folder)
    if not where.is_dir():
        raise HabitusError(f"{where}: no such folder; expected one with the cameras' videos")
    files = sorted(path for path in where.iterdir() if path.suffix.lower() in ENDINGS)
    own = {plain_camera_name(path.stem): path for path in files}
    videos = {}
    for camera in rig.cameras:
        path = own.get(plain_camera_name(camera.name))
        if path is not None:
            video = _facts(path)
            sizes = (video.width, camera.width), (video.height, camera.height)
            if any(abs(own - given) > MAX_SIZE_DIFFERENCE * given for own, given in sizes):
                raise HabitusError(
                    f"{path}: {video.width} x {video.height} pixels, calibration of "
                    f"{shown(camera.name, 40)} {camera.width} x {camera.height}; expected the same "
                    "size: calibrate or detect at the other's"
                )
            videos[camera.name] = video
    if not videos:
        names = listed([path.name for path in files]) if files else "none"
        raise HabitusError(
            f"{where}: videos: {names}; expected names such as {rig.names[0]}.mp4, one a camera"
        )
    return videos


def stills(
    videos: Mapping[str, Video], frames: Mapping[str, Sequence[int]]
) -> dict[tuple[str, int], UInt8[np.ndarray, "H W 3"]]:
    """Pictures (sRGB) at some frames of each camera, by camera and frame; those that cannot be
    decoded are left out.
    """
    out = {}
    for name, video in videos.items():
        reader = _opened(video.path)
        for frame in frames.get(name, ()):
            if 0 <= frame < video.frames:
                reader.set(_cv2().CAP_PROP_POS_FRAMES, frame)
                done, picture = reader.read()
                if done and picture.ndim == 3:
                    out[name, frame] = np.ascontiguousarray(picture[..., ::-1])
        reader.release()
    return out


def _facts(path: Path) -> Video:
    reader = _opened(path)
    cv2 = _cv2()
    keys = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS,
            cv2.CAP_PROP_FRAME_COUNT)  # fmt: skip
    width, height, rate, frames = (float(reader.get(key)) for key in keys)
    reader.release()
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and 0 < frames < 1e9 and rate > 0):
        raise HabitusError(
            f"{path}: a video of {frames:g} frames of {width:g} x {height:g} at {rate:g} Hz; "
            "expected one with frames; convert it to .mp4 (H.264)"
        )
    return Video(path, int(width), int(height), rate, int(frames))


def _opened(path: Path) -> Any:
    reader = _cv2().VideoCapture(str(path))
    if not reader.isOpened():
        raise HabitusError(f"{path}: no video that OpenCV reads; convert it to .mp4 (H.264)")
    return reader


def _cv2() -> Any:
    return require_extra("cv2", "videos", "video")
