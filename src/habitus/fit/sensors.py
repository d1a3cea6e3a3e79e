"""What several sensors observed of one person, for `habitus.fit.problem`: data, its noise, and
which poses it belongs to.

Noise is the standard deviation of one observation, including what the body model cannot explain of
it; without one it is that of the sensor's own recipe (`FitSettings`). A view or scan either names
the frame of a capture in which it was taken, and is then in the capture's world, or has a pose and
a world of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from habitus.errors import HabitusError
from habitus.fit.markers.recordings import Recording
from habitus.fit.points.scan import Scan
from habitus.markers.layouts import MarkerLayout
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections

if TYPE_CHECKING:  # depth views need PyTorch; markers and scans do not
    from habitus.observe.camera import DepthView


class FrameOf(NamedTuple):
    """A frame of one of the captures, both counted from 0."""

    capture: int
    frame: int


@dataclass(frozen=True, eq=False)
class MarkerData:
    """A recording on the layout of all captures; noise (m) of a marker.

    frames: those that are solved with the other sensors; chosen for spread poses without it.
    """

    recording: Recording
    noise: float | None = None
    frames: tuple[int, ...] | None = None


@dataclass(frozen=True, eq=False)
class ViewData:
    """A depth view; at: when it was taken, None: a pose of its own.

    camera and depth are the view's; the body is in the camera's frame, or with ``at`` in the
    capture's world. noise: sd of depth over its square (1 / m).
    """

    view: "DepthView"
    at: FrameOf | None = None
    noise: float | None = None


@dataclass(frozen=True, eq=False)
class ScanData:
    """A scan; at: as in `ViewData`. With it the points are metres in the capture's world.

    noise (m): along the normal.
    """

    scan: Scan
    at: FrameOf | None = None
    noise: float | None = None


@dataclass(frozen=True, eq=False)
class DetectionData:
    """Keypoints in calibrated cameras of the capture's world; the first frame was taken ``delay``
    seconds after the first of the capture.
    """

    detections: Detections
    cameras: CameraRig
    capture: int = 0
    delay: float = 0.0


@dataclass(frozen=True, eq=False)
class SensorData:
    """All that was observed of one person. layout: of all captures, whose latent markers are the
    same. unit, up: of scans with a pose of their own, or "auto".
    """

    captures: tuple[MarkerData, ...] = ()
    layout: MarkerLayout | None = None
    views: tuple[ViewData, ...] = ()
    scans: tuple[ScanData, ...] = ()
    detections: tuple[DetectionData, ...] = ()
    unit: str = "auto"
    up: str = "auto"

    def named_frames(self, capture: int) -> tuple[int, ...]:
        """Frames of a capture in which views and scans were taken."""
        given: Sequence[ViewData | ScanData] = (*self.views, *self.scans)
        return tuple(each.at.frame for each in given if each.at and each.at.capture == capture)

    def check(self) -> None:
        """Raises HabitusError where there is no sensor, keypoints have no capture, and for frames
        that no capture has.
        """
        if self.detections and not self.captures:
            raise HabitusError(
                "keypoints were given without a capture; expected markers in the same world, or "
                "the keypoints alone, without terms or a prior"
            )
        if not (self.captures or self.views or self.scans):
            raise HabitusError("no sensor; expected markers, keypoints, depth views or scans")
        for each in self.detections:
            if not 0 <= each.capture < len(self.captures):
                raise HabitusError(
                    f"keypoints are of capture {each.capture}; {len(self.captures)} are given"
                )
        named = sorted({each.at for each in (*self.views, *self.scans) if each.at is not None})
        for capture, frame in named:
            if not 0 <= capture < len(self.captures):
                raise HabitusError(
                    f"frame {frame} of capture {capture} is named, and {len(self.captures)} "
                    "captures are given; leave frames out, or give the markers too"
                )
        for k, each in enumerate(self.captures):
            frames = (*self.named_frames(k), *(each.frames or ()))
            check_frames(each.recording.name, len(each.recording.observed), frames)


def check_frames(capture: str, count: int, frames: Sequence[int]) -> None:
    """Raises HabitusError for a frame that a capture of ``count`` frames does not have."""
    for frame in frames:
        if not 0 <= frame < count:
            raise HabitusError(
                f"frame {frame} is named; the capture {capture} has 0 to {count - 1}"
            )
