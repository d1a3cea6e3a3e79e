"""A hasty fit of a little of a real capture: it is asked what can be made of a fit, not how good it
is.
"""

from functools import cache
from pathlib import Path

from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_capture
from habitus.jobs import mosh

FRAMES = slice(0, 120, 3)


def real_capture(shared: Path) -> Capture:
    """40 frames of a real capture, 40 Hz."""
    return read_capture(shared / "mocap" / "85_02.c3d")[FRAMES]


@cache
def real_fit(shared: Path, folder: Path) -> tuple[MarkerFit, Path]:
    """The fit of these frames with some samples of three markers hidden, and the C3D file that was
    fitted.
    """
    capture = real_capture(shared)
    markers = capture.markers.copy()
    for marker, gap in ((5, slice(10, 22)), (20, slice(0, 6)), (32, slice(30, 40))):
        markers[gap, marker] = float("nan")
    path = folder / "gappy.c3d"
    write_c3d(Capture("gappy", capture.labels, markers, capture.rate_hz, capture.up_axis), path)
    settings = mosh.MoshSettings
    mosh.MoshSettings = lambda **given: MoshSettings(**given | {"annealing": (10.0,), "frames": 3})  # type: ignore
    try:
        return mosh.Mosh(layout="cmu-41").fit(path), path
    finally:
        mosh.MoshSettings = settings
