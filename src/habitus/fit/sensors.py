"""What several sensors observed of one person, for `habitus.fit.problem`: data, its noise, and
which poses it belongs to.

Noise is a standard deviation of one observation, with what the body model cannot explain of it. A
view or scan either names the frames of the capture in which it was taken, and is then in the
capture's world, or has a pose and a world of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from habitus.fit.markers.recordings import Recording
from habitus.fit.points.scan import Scan
from habitus.markers.layouts import MarkerLayout
from habitus.observe.depth_views import DepthView


@dataclass(frozen=True, eq=False)
class MarkerData:
    """A recording on its layout; noise (m) is MoSh's weight of 0.75 per cm^2 (M 6) by default.

    frames: those that are solved with the other sensors; chosen for spread poses without it.
    """

    recording: Recording
    layout: MarkerLayout
    noise: float = 0.0115
    frames: tuple[int, ...] | None = None


@dataclass(frozen=True, eq=False)
class ViewData:
    """A depth view; frame: of the capture, None: a pose of its own.

    camera and depth are the view's: the camera's frame, or with ``frame`` the capture's world, is
    where the body is. noise: sd of depth over its square (1 / m); None: what the view tells, else
    1.5e-3.
    """

    view: DepthView
    frame: int | None = None
    noise: float | None = None


@dataclass(frozen=True, eq=False)
class ScanData:
    """A scan; frame as in `ViewData`. With it the points are metres in the capture's world, without
    it ``unit`` and ``up`` say what they are, or "auto".

    noise (m) along the normal: 5 mm is what the last steps of a registration's model have.
    """

    scan: Scan
    frame: int | None = None
    noise: float = 0.005
    unit: str = "auto"
    up: str = "auto"


@dataclass(frozen=True, eq=False)
class SensorData:
    """All that was observed of one person."""

    markers: MarkerData | None = None
    views: tuple[ViewData, ...] = ()
    scans: tuple[ScanData, ...] = ()

    @property
    def frames(self) -> tuple[int, ...]:
        """Frames of the capture that views and scans were taken in."""
        given: Sequence[ViewData | ScanData] = (*self.views, *self.scans)
        return tuple(sorted({each.frame for each in given if each.frame is not None}))


@dataclass(frozen=True, eq=False)
class SegmentedView:
    """A view with the person's pixels known, and the pose (row of the state) it shows."""

    data: ViewData
    mask: Bool[np.ndarray, "H W"]
    noise: float
    row: int


@dataclass(frozen=True, eq=False)
class Cloud:
    """Some points of a scan and their normals, and the pose (row of the state) they show."""

    data: ScanData
    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"] | None
    row: int
