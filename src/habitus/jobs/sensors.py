"""Several sensors, one person, in one call: `Fit` reads what its sensors name, and fits all at
once.

```python
both = hb.Fit(body, [hb.Markers("walk.c3d"), hb.Depth("views", frames=(10, 45))]).solve()
```

Sensors of one kind alone are fitted by the recipe of that kind, `habitus.Mosh`,
`habitus.register_scans`, `habitus.fit_rgbd` or `habitus.fit_cameras`; `habitus.fit.problem` says
what is minimised for several kinds.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Union

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior, prior_of
from habitus.body.state import BodyState
from habitus.errors import HabitusError, TorchIsAnExtra
from habitus.fit.body_fit import BodyFit, FitSettings
from habitus.fit.points.scan import Scan as ReadScan
from habitus.fit.problem import distances_to, fit_sensors, pose_name, verdicts_of
from habitus.fit.sensors import (
    DetectionData,
    FrameOf,
    MarkerData,
    ScanData,
    SensorData,
    ViewData,
    check_frames,
)
from habitus.fit.starts import into_frame
from habitus.io.captures.read import Capture, read_capture
from habitus.io.scans import read_scan
from habitus.jobs.bodies import loaded
from habitus.jobs.cameras import CameraResult, fit_cameras, read_cameras
from habitus.jobs.mosh import Mosh
from habitus.jobs.options import CameraOptions
from habitus.jobs.register import ScanResult, register_scans
from habitus.jobs.results import MarkerResult
from habitus.jobs.subjects import LayoutChoice, subject_of
from habitus.markers.layouts import MarkerLayout
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections
from habitus.solve.terms import Term
from habitus.types import PathLike, Progress

if TYPE_CHECKING:  # depth views need PyTorch; markers and scans do not
    from habitus.jobs.rgbd import DepthResult
    from habitus.observe.camera import DepthView, RgbdCapture


@dataclass(frozen=True, eq=False)
class Markers:
    """A capture of labelled markers, for `Fit`; give several for several captures of the person.

    capture: a file, what `habitus.read_capture` read, or an array (T, M, 3) in metres, NaN where
    missing, in the order of ``layout``, which then is a `MarkerLayout`. layout: as `Mosh` takes it,
    the same for all captures. noise: sd (m) of a marker, with skin that slides and what the model
    cannot explain; that of MoSh's weight by default. frames: those that are solved with the other
    sensors; by default 12 of spread poses, and those that views and scans name. fps: of an array.
    """

    capture: Capture | PathLike | np.ndarray
    layout: LayoutChoice = "auto"
    noise: float | None = None
    frames: Sequence[int] | None = None
    fps: float = 100.0

    def read(self) -> Capture:
        """The capture. Raises HabitusError."""
        if isinstance(self.capture, Capture):
            return self.capture
        if not isinstance(self.capture, np.ndarray):
            return read_capture(self.capture)
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
        return Capture("markers", self.layout.labels, np.array(self.capture, float), self.fps, "+y")


@dataclass(frozen=True, eq=False)
class Depth:
    """Views of a depth camera, for `Fit`.

    views: a folder, what `habitus.read_views` read, a view or several. frames: of the capture, one
    a view, at which they were taken; their cameras then take points of the capture's world to
    pixels. Without them each view has a pose of its own, in its camera's frame. capture: number of
    the capture that has the frames, where there are several. noise: sd of depth over its square
    (1 / m); by default what a shot of the empty room shows, else that of the recipe.
    """

    views: Union["RgbdCapture", "DepthView", Sequence["DepthView"], PathLike]
    frames: Sequence[int] | None = None
    noise: float | None = None
    capture: int | None = None

    def read(self) -> "RgbdCapture":
        """The views. Raises HabitusError."""
        with TorchIsAnExtra("habitus.Depth"):
            from habitus.io.rgbd.read import read_views
            from habitus.observe.camera import DepthView, RgbdCapture

        if isinstance(self.views, RgbdCapture):
            return self.views
        if isinstance(self.views, str | os.PathLike):
            return read_views(self.views)
        views = (self.views,) if isinstance(self.views, DepthView) else tuple(self.views)
        return RgbdCapture("views", views)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of a detector in calibrated cameras, one camera or several, for `Fit`.

    detections: what `habitus.read_detections` read, or the folder it reads (then with ``fps``).
    calibration: what `habitus.read_calibration` read, or its file, in the capture's world and
    metres. delay: seconds from the capture's first frame to the detections' first; frames are
    matched by time. capture: number of the capture that was filmed, where there are several. Of
    several people the one is taken who is seen most.
    """

    detections: Detections | PathLike
    calibration: CameraRig | PathLike
    fps: float | None = None
    delay: float = 0.0
    capture: int | None = None

    def read(self) -> tuple[Detections, CameraRig]:
        """Detections and cameras. Raises HabitusError."""
        return read_cameras(self.detections, self.calibration, CameraOptions(fps=self.fps))


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan of the person, for `Fit`; give several for several scans.

    scan: a file, points (P, 3), a pair (vertices, faces), or what `habitus.io.scans` read. frame:
    of the capture, in whose world and metres the scan then is; without it the scan has a pose of
    its own, and unit and up are as `habitus.register_scans` takes them, alike for all scans.
    capture: number of the capture that has the frame, where there are several. noise: sd (m) of a
    point along the normal; that of the recipe by default.
    """

    scan: ReadScan | PathLike | np.ndarray | tuple[np.ndarray, np.ndarray]
    frame: int | None = None
    noise: float | None = None
    unit: str = "auto"
    up: str = "auto"
    capture: int | None = None

    def read(self) -> ReadScan:
        """The scan's points. Raises HabitusError."""
        scan: Any = self.scan
        if isinstance(scan, str | os.PathLike):
            return read_scan(Path(scan))
        if isinstance(scan, np.ndarray):
            return ReadScan("scan", scan)
        if isinstance(scan, tuple):
            vertices, faces = (np.asarray(part) for part in scan)
            return ReadScan("scan", vertices.astype(float), faces=faces)
        return scan


Sensor = Markers | Depth | Keypoints | Scan
"""What `Fit` takes."""


@dataclass(frozen=True, eq=False)
class PersonFit(BodyFit):
    """A `BodyFit` whose parts can write themselves: ``fit.motion.save(folder)``.

    results: with sensors of one kind all that its recipe returns, one a capture or scan, or one of
    all views; with several kinds the motions.
    """

    motions: tuple[MarkerResult, ...] = ()
    results: tuple[Union[MarkerResult, ScanResult, CameraResult, "DepthResult"], ...] = ()

    @property
    def motion(self) -> MarkerResult | None:
        """The whole capture, the first of several; None without markers."""
        return self.motions[0] if self.motions else None


@dataclass(frozen=True, eq=False)
class Fit:
    """One person from any sensors: `solve` gives the shape they share and the poses they saw.

    body: loaded, "default" or a file. sensors: `Markers`, `Depth`, `Keypoints`, `Scan`, any number
    of each; keypoints alone, or with the captures that were filmed. settings: weights and schedule.
    terms: terms of your own by name, functions or `habitus.Term`, of betas, pose (F, J, 3) and
    trans (F, 3); the F poses are those of the result. prior: of poses; the body's own or the
    shipped one without it.

    Sensors of one kind, with the recipe's own noise and without terms or a prior of your own, are
    fitted by `habitus.Mosh`, `habitus.register_scans`, `habitus.fit_rgbd` or
    `habitus.fit_cameras`, with their settings.
    """

    body: BodyModel | PathLike
    sensors: Sequence[Sensor] | Sensor
    settings: FitSettings = field(default_factory=FitSettings)
    terms: Mapping[str, Any] = field(default_factory=dict)
    prior: PosePrior | None = None

    def solve(self, progress: Progress = lambda stage, share: None) -> PersonFit:
        """Start, all sensors together, and the motion of the whole captures.

        progress: called with the stage and the share done. Raises HabitusError for what cannot be
        read, no sensor, frames that the capture does not have, and captures or scans whose options
        disagree.
        """
        sensors = [self.sensors] if isinstance(self.sensors, Sensor) else list(self.sensors)
        for each in sensors:
            if not isinstance(each, Sensor):
                raise HabitusError(
                    f"a sensor is a {type(each).__name__}; expected Markers, Depth, Keypoints or "
                    "Scan"
                )
        kinds = {type(each) for each in sensors}
        if len(kinds) == 1 and not self._beyond_a_recipe(sensors):
            return RECIPES[kinds.pop()](self, sensors, progress)
        return self._jointly(sensors, progress)

    def _beyond_a_recipe(self, sensors: Sequence[Sensor]) -> bool:
        """Whether something is given that the recipes of one kind have no option for."""
        if self.terms or self.prior is not None:
            return True
        named = any(getattr(each, "frame", None) is not None for each in sensors)
        named |= any(isinstance(each, Depth) and each.frames is not None for each in sensors)
        return named or any(getattr(each, "noise", None) is not None for each in sensors)

    def _jointly(self, sensors: Sequence[Sensor], progress: Progress) -> PersonFit:
        body = loaded(self.body)
        data = _read(sensors, body, progress)
        terms = {
            name: each if isinstance(each, Term) else Term(each, name=name)
            for name, each in self.terms.items()
        }
        prior = prior_of(body) if self.prior is None else self.prior
        fit = fit_sensors(body, prior, data, self.settings, terms, progress)
        motions = tuple(MarkerResult.of(each) for each in fit.motions)
        return PersonFit(**{**vars(fit), "motions": motions, "results": motions})


# ---- several kinds of sensors --------------------------------------------------------------------


def _read(sensors: Sequence[Sensor], body: BodyModel, progress: Progress) -> SensorData:
    """All data, captures on one layout."""
    markers = [each for each in sensors if isinstance(each, Markers)]
    scans = [each for each in sensors if isinstance(each, Scan)]
    count = len(markers)
    captures: tuple[MarkerData, ...] = ()
    layout = None
    if markers:
        read = [each.read() for each in markers]
        person = subject_of(read, _layout(markers), body, progress)
        layout = person.layout
        captures = tuple(
            MarkerData(recording, each.noise, None if each.frames is None else tuple(each.frames))
            for recording, each in zip(person.recordings, markers, strict=True)
        )
    unit, up = _axes([each for each in scans if each.frame is None])
    return SensorData(
        captures,
        layout,
        tuple(view for each in sensors if isinstance(each, Depth) for view in _views(each, count)),
        tuple(ScanData(each.read(), _at(each, each.frame, count), each.noise) for each in scans),
        tuple(_detections(each, count) for each in sensors if isinstance(each, Keypoints)),
        unit,
        up,
    )


def _views(sensor: Depth, captures: int) -> list[ViewData]:
    views = sensor.read().views
    frames = [None] * len(views) if sensor.frames is None else list(sensor.frames)
    if len(frames) != len(views):
        raise HabitusError(f"{len(frames)} frames for {len(views)} views; give one for each")
    return [
        ViewData(view, _at(sensor, frame, captures), sensor.noise)
        for view, frame in zip(views, frames, strict=True)
    ]


def _detections(sensor: Keypoints, captures: int) -> DetectionData:
    if sensor.capture is None and captures > 1:
        raise HabitusError(
            f"keypoints with {captures} captures; say of which with capture=0, the first"
        )
    return DetectionData(*sensor.read(), sensor.capture or 0, sensor.delay)


def _at(sensor: Depth | Scan, frame: int | None, captures: int) -> FrameOf | None:
    """The frame that a view or scan was taken in, of the capture that it names."""
    if frame is None:
        return None
    if sensor.capture is None and captures > 1:
        raise HabitusError(
            f"frame {frame} is named with {captures} captures; say which with capture=0, the first"
        )
    return FrameOf(sensor.capture or 0, int(frame))


def _layout(markers: Sequence[Markers]) -> LayoutChoice:
    """The layout of all captures: they share their latent markers."""
    layout = markers[0].layout
    if any(each.layout is not layout and each.layout != layout for each in markers):
        raise HabitusError(
            "captures of one person are given with different layouts; expected one layout, with "
            "the markers of all"
        )
    return layout


def _axes(scans: Sequence[Scan]) -> tuple[str, str]:
    """Unit and upward axis of all scans."""
    given = sorted({(each.unit, each.up) for each in scans}) or [("auto", "auto")]
    if len(given) > 1:
        raise HabitusError(
            f"scans of one person are given with different unit or up, {given[0]} and {given[1]}; "
            "expected the same for all, such as auto, by which each scan's is estimated"
        )
    return given[0]


# ---- sensors of one kind -------------------------------------------------------------------------


def _by_mosh(fit: Fit, sensors: Sequence[Markers], progress: Progress) -> PersonFit:
    """The captures by `habitus.Mosh`; the poses are those of ``frames``, by default of all."""
    mosh = fit.settings.mosh
    recipe = Mosh(
        layout=_layout(sensors),
        settings=mosh,
        soft_tissue=mosh.soft_space if mosh.soft_tissue else "none",
        causal=mosh.causal,
        seed=mosh.seed,
    )
    captures = [each.read() for each in sensors]
    for each, sensor in zip(captures, sensors, strict=True):
        check_frames(each.name, len(each), sensor.frames or ())
    results = recipe.fit(captures, fit.body, progress=progress)
    parts = [
        (k, frame)
        for k, (result, sensor) in enumerate(zip(results, sensors, strict=True))
        for frame in (range(result.num_frames) if sensor.frames is None else sensor.frames)
    ]
    several = len(results) > 1
    off = np.concatenate([1e-3 * each.errors_mm.ravel() for each in results])
    return PersonFit(
        body=results[0].body,
        betas=results[0].betas,
        pose=np.stack([results[k].pose[frame] for k, frame in parts]),
        trans=np.stack([results[k].trans[frame] for k, frame in parts]),
        poses=tuple(pose_name(k, frame, len(results)) for k, frame in parts),
        status=results[0].status,
        costs={
            f"capture {k} {name}" if several else name: cost
            for k, each in enumerate(results)
            for name, cost in each.costs.items()
        },
        residuals={"markers": off[np.isfinite(off)]},
        latent_markers=results[0].latent_markers,
        motions=tuple(results),
        verdicts=verdicts_of(results),
        seconds={name: each for name, each in results[0].stage_seconds.items() if each is not None},
        results=tuple(results),
    )


def _by_register(fit: Fit, sensors: Sequence[Scan], progress: Progress) -> PersonFit:
    """The scans by `habitus.register_scans`; shape and poses are those of the model."""
    unit, up = _axes(sensors)
    settings = fit.settings
    results = register_scans(
        [each.read() for each in sensors],
        fit.body,
        unit=unit,
        up=up,
        seed=settings.seed,
        settings=settings.scans,
        progress=progress,
    )
    first = next((each for each in results if each.person), results[0])
    return PersonFit(
        body=first.body,
        betas=first.betas,
        pose=np.stack([each.pose for each in results]),
        trans=np.stack([each.trans for each in results]),
        poses=tuple(each.scan_name for each in results),
        status=first.status,
        costs=first.costs,
        residuals={f"scan {k}": each.to_model for k, each in enumerate(results)},
        verdicts={each.scan_name: each.verdict for each in results},
        seconds=first.stage_seconds,
        results=tuple(results),
    )


def _by_rgbd(fit: Fit, sensors: Sequence[Depth], progress: Progress) -> PersonFit:
    """The views by `habitus.fit_rgbd`; poses are in the cameras' frames."""
    from habitus.jobs.rgbd import fit_rgbd
    from habitus.observe.camera import RgbdCapture

    read = [each.read() for each in sensors]
    views = tuple(view.in_camera_frame() for each in read for view in each.views)
    notes = tuple(note for each in read for note in each.notes)
    result = fit_rgbd(
        RgbdCapture(read[0].name, views, notes), fit.body, settings=fit.settings.depth
    )
    state = BodyState(result.betas, result.pose, result.trans)
    moved = [
        into_frame(result.body, state[k : k + 1], each.turn, each.shift)
        for k, each in enumerate(result.prepared_views)
    ]
    pose, trans = (np.stack(part) for part in zip(*moved, strict=True))
    return PersonFit(
        body=result.body,
        betas=result.betas,
        pose=pose,
        trans=trans,
        poses=tuple(view.name or f"view {k}" for k, view in enumerate(views)),
        status=result.status,
        costs=result.costs,
        residuals={
            f"depth {k}": distances_to(result.body, state[k], each.points[each.mask])
            for k, each in enumerate(result.prepared_views)
        },
        verdicts={"depth": result.verdict},
        seconds=result.stage_seconds,
        results=(result,),
    )


def _by_cameras(fit: Fit, sensors: Sequence[Keypoints], progress: Progress) -> PersonFit:
    """The person who is seen most, by `habitus.fit_cameras`."""
    if len(sensors) > 1:
        raise HabitusError(
            f"{len(sensors)} sets of keypoints; expected one, with all cameras of one calibration"
        )
    (result,) = fit_cameras(*sensors[0].read(), fit.body)
    size = np.maximum(result.size_px, 1.0)[..., None]
    off = (result.errors_px / size * result.height).ravel()
    return PersonFit(
        body=result.body,
        betas=result.betas,
        pose=result.pose,
        trans=result.trans,
        poses=tuple(f"frame {result.first_frame + k}" for k in range(len(result.pose))),
        status=result.status,
        costs=result.costs,
        residuals={"keypoints": off[np.isfinite(off)]},
        verdicts={"keypoints": result.verdict},
        seconds=result.stage_seconds,
        results=(result,),
    )


RECIPES: Mapping[type, Callable[[Fit, Any, Progress], PersonFit]] = MappingProxyType(
    {Markers: _by_mosh, Depth: _by_rgbd, Keypoints: _by_cameras, Scan: _by_register}
)
"""Of sensors of one kind."""
