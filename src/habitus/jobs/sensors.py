"""Several sensors, one person, in one call: `Fit` reads what its sensors name, and fits all at
once.

```python
both = hb.Fit(body, [hb.Markers("walk.c3d"), hb.Depth("views", frames=(10, 45))]).solve()
```

`habitus.fit.problem` says what is minimised.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.errors import HabitusError
from habitus.fit.body_fit import BodyFit, FitSettings
from habitus.fit.markers.recordings import Recording
from habitus.fit.points.scan import Scan as ReadScan
from habitus.fit.problem import fit_sensors
from habitus.fit.sensors import MarkerData, ScanData, SensorData, ViewData
from habitus.io.captures.read import Capture, read_capture
from habitus.io.rgbd.read import read_views
from habitus.io.scans import read_scan
from habitus.jobs.bodies import loaded
from habitus.jobs.results import MarkerResult
from habitus.jobs.subjects import LayoutChoice, person_of
from habitus.markers.layouts import MarkerLayout
from habitus.observe.depth_views import DepthView, RgbdCapture
from habitus.solve.terms import Term
from habitus.types import PathLike, Progress


@dataclass(frozen=True, eq=False)
class Markers:
    """A capture of labelled markers, for `Fit`.

    capture: a file, what `habitus.read_capture` read, or an array (T, M, 3) in metres, NaN where
    missing, in the order of ``layout``, which then is a `MarkerLayout`. layout: as `Mosh` takes it.
    noise: sd (m) of a marker, skin that slides and what the model cannot explain included; the
    default is MoSh's weight. frames: those that are solved with the other sensors; by itself 12 of
    spread poses, and those that views and scans name. fps: of an array.
    """

    capture: Capture | PathLike | np.ndarray
    layout: LayoutChoice = "auto"
    noise: float = 0.0115
    frames: Sequence[int] | None = None
    fps: float = 100.0

    def read(self, body: BodyModel) -> MarkerData:
        """The markers on their layout. Raises HabitusError."""
        frames = None if self.frames is None else tuple(self.frames)
        if isinstance(self.capture, np.ndarray):
            if not isinstance(self.layout, MarkerLayout):
                raise HabitusError(
                    "markers are an array without labels; give the layout of its columns, as "
                    "habitus.load_layout gives it"
                )
            expected = (len(self.layout), 3)
            if self.capture.ndim != 3 or self.capture.shape[1:] != expected:
                raise HabitusError(
                    f"markers have shape {self.capture.shape}; the layout has {expected[0]}: "
                    f"expected (frames, {expected[0]}, 3)"
                )
            recording = Recording("markers", np.asarray(self.capture, float), self.fps, "+y")
            return MarkerData(recording, self.layout, self.noise, frames)
        read = self.capture if isinstance(self.capture, Capture) else read_capture(self.capture)
        known = person_of([read], self.layout)
        return MarkerData(known.recordings[0], known.layout, self.noise, frames)


@dataclass(frozen=True, eq=False)
class Depth:
    """Views of a depth camera, for `Fit`.

    views: a folder, what `habitus.read_views` read, a view or several. frames: of the capture, one
    a view, at which they were taken; their cameras then take points of the capture's world to
    pixels. Without them each view has a pose of its own, in its camera's frame. noise: sd of depth
    over its square (1 / m), 1.5e-3 without it.
    """

    views: RgbdCapture | DepthView | Sequence[DepthView] | PathLike
    frames: Sequence[int] | None = None
    noise: float | None = None

    def read(self) -> tuple[ViewData, ...]:
        """The views, one by one. Raises HabitusError."""
        views: Any = self.views
        if isinstance(views, str | os.PathLike):
            views = read_views(views)
        if isinstance(views, RgbdCapture):
            views = views.views
        views = [views] if isinstance(views, DepthView) else list(views)
        frames = _frames(self.frames, len(views), "views")
        return tuple(
            ViewData(view, frame, self.noise) for view, frame in zip(views, frames, strict=True)
        )


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan of the person, for `Fit`; give several for several scans.

    scan: a file, points (P, 3), a pair (vertices, faces), or what `habitus.io.scans` read. frame:
    of the capture, in whose world and metres the scan then is; without it the scan has a pose of
    its own, and unit and up are as `habitus.register_scans` takes them. noise: sd (m) of a point
    along the normal.
    """

    scan: ReadScan | PathLike | np.ndarray | tuple[np.ndarray, np.ndarray]
    frame: int | None = None
    noise: float = 0.005
    unit: str = "auto"
    up: str = "auto"

    def read(self) -> ScanData:
        """The scan's points. Raises HabitusError."""
        scan: Any = self.scan
        if isinstance(scan, str | os.PathLike):
            scan = read_scan(Path(scan))
        elif isinstance(scan, np.ndarray):
            scan = ReadScan("scan", scan)
        elif isinstance(scan, tuple):
            vertices, faces = (np.asarray(part) for part in scan)
            scan = ReadScan("scan", vertices.astype(float), faces=faces)
        return ScanData(scan, self.frame, self.noise, self.unit, self.up)


Sensor = Markers | Depth | Scan
"""What `Fit` takes."""


class PersonFit(BodyFit):
    """A `BodyFit` whose motion can write itself: ``fit.motion.save(folder)``."""

    motion: MarkerResult | None


@dataclass(frozen=True, eq=False)
class Fit:
    """One person from any sensors: `solve` gives the shape they share and the poses they saw.

    body: loaded, "default" or a file. sensors: `Markers` (one at most), `Depth`, `Scan`. settings:
    weights and schedule. terms: terms of your own by name, functions or `habitus.Term`, of betas,
    pose (F, J, 3) and trans (F, 3); the F poses are those of the result. prior: of poses; the
    body's own or the shipped one without it.
    """

    body: BodyModel | PathLike
    sensors: Sequence[Sensor] | Sensor
    settings: FitSettings = field(default_factory=FitSettings)
    terms: Mapping[str, Any] = field(default_factory=dict)
    prior: PosePrior | None = None

    def solve(self, progress: Progress = lambda stage, share: None) -> PersonFit:
        """Start, all sensors together, and the motion of the whole capture.

        progress: called with the stage and the share done. Raises HabitusError for what cannot be
        read, no sensor, two captures, and frames that the capture does not have.
        """
        body = loaded(self.body)
        sensors = [self.sensors] if isinstance(self.sensors, Sensor) else list(self.sensors)
        wrong = [each for each in sensors if not isinstance(each, Sensor)]
        if wrong:
            raise HabitusError(
                f"a sensor is a {type(wrong[0]).__name__}; expected Markers, Depth or Scan"
            )
        captures = [each for each in sensors if isinstance(each, Markers)]
        if len(captures) > 1:
            raise HabitusError(
                f"{len(captures)} captures were given; expected one at most (habitus.Mosh fits a "
                "list of captures of one subject)"
            )
        data = SensorData(
            captures[0].read(body) if captures else None,
            tuple(view for each in sensors if isinstance(each, Depth) for view in each.read()),
            tuple(each.read() for each in sensors if isinstance(each, Scan)),
        )
        terms = {
            name: each if isinstance(each, Term) else Term(each, name=name)
            for name, each in self.terms.items()
        }
        prior = prior_of(body) if self.prior is None else self.prior
        found = fit_sensors(body, prior, data, self.settings, terms, progress)
        motion = None if found.motion is None else MarkerResult.of(found.motion)
        return PersonFit(**{**vars(found), "motion": motion})


def _frames(given: Sequence[int] | None, count: int, what: str) -> Sequence[int | None]:
    if given is None:
        return [None] * count
    if len(given) != count:
        raise HabitusError(f"{len(given)} frames for {count} {what}; give one for each")
    return [int(frame) for frame in given]
