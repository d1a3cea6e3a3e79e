"""Bodies from calibrated cameras: keypoints of a detector in, a folder of results for each person
out.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import UInt8

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.cameras.recipe import fit_cameras as fitted
from habitus.fit.cameras.result import CameraFit
from habitus.fit.cameras.settings import CAMERAS, Known
from habitus.io.cameras.read import read_calibration
from habitus.io.cameras.videos import read_videos, stills
from habitus.io.keypoints.points import POINT_ENDINGS, read_points
from habitus.io.keypoints.read import read_detections
from habitus.io.keypoints.sam3d import read_sam3d
from habitus.jobs.bodies import loaded
from habitus.jobs.mosh import Mosh
from habitus.jobs.options import CameraOptions, takes
from habitus.jobs.results import Exportable, MarkerResult, with_methods
from habitus.kernels.threads import one_blas_thread
from habitus.observe.camera_rig import CameraRig
from habitus.observe.detections import Detections
from habitus.report.cameras import camera_page, moments
from habitus.results.cameras import CAMERA_FILES, save_cameras
from habitus.results.save import MARKER_FILES, result_lock
from habitus.types import PathLike

MAX_FLOOR = 1000.0


class CameraResult(Exportable, CameraFit):
    """A fit to keypoints that can write itself."""

    @classmethod
    def of(cls, fit: CameraFit) -> Self:
        """The same fit, with the methods."""
        return with_methods(cls, fit)

    def save(self, folder: PathLike, videos: PathLike | None = None) -> None:
        """Write body.npz, body.glb, measurements.csv, metrics.json and report.html, as ``habitus
        cameras`` does; with a folder of the cameras' ``videos`` the report shows the body over
        their pictures (the extra ``video``).

        Raises HabitusError where the folder cannot be written, or the videos cannot be read.
        """
        pictures = None if videos is None else _stills(self, videos)
        save_cameras(self, folder, partial(camera_page, pictures=pictures))


@takes(CameraOptions)
def fit_cameras(
    detections: Detections | PathLike,
    calibration: CameraRig | PathLike | None = None,
    body: BodyModel | PathLike = "default",
    *,
    options: CameraOptions,
) -> list[CameraResult]:
    """The bodies in motion of people whom calibrated cameras saw, the one who is seen most first.

    detections: what `habitus.read_detections` read, or the folder it reads (then with ``fps``); or
    a .trc, .c3d or .npy of keypoints in space. calibration: what `habitus.read_calibration` read,
    or its file; None for keypoints in space. body: a model, a file,
    "default", "female", "male". One camera leaves depth open: its verdict is doubtful at best.
    Raises HabitusError where names of cameras differ, and where nobody is seen by two cameras at
    once.
    """
    detections, rig = read_cameras(detections, calibration, options)
    model = loaded(body, age=options.age)
    people = None if options.people == "auto" else _count(options.people)
    if options.height is not None and not 0.4 < options.height < 2.6:
        raise HabitusError(f"height is {options.height}; expected metres, .4 to 2.6")
    if options.floor is not None and len(rig.cameras) > 1:
        raise HabitusError("floor is given; it is used with one camera alone: leave it out")
    if options.floor is not None and not abs(options.floor) < MAX_FLOOR:
        raise HabitusError(f"floor is {options.floor}; expected metres in the calibration's world")
    with one_blas_thread():
        fits = fitted(
            model,
            prior_of(model),
            detections,
            rig,
            options.settings or CAMERAS,
            people=people,
            known=Known(options.height, options.floor, options.up),
            correct=not options.keep_cameras and calibration is not None,
        )
    return [CameraResult.of(fit) for fit in fits]


@takes(CameraOptions)
def cameras(
    folder: PathLike,
    calibration: PathLike | None,
    out: PathLike,
    body: BodyModel | PathLike = "default",
    *,
    videos: PathLike | None = None,
    options: CameraOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> list[CameraResult | MarkerResult]:
    """Read detections and calibration, fit, and write the results into the folder ``out``, of
    several people into ``out``/person_N, as ``habitus cameras`` does. videos: a folder with each
    camera's, for the report. Raises HabitusError.
    """
    if videos is not None and (calibration is None or options.source == "sam3d"):
        raise HabitusError("videos are given; expected them beside a calibration of their cameras")
    if options.source == "sam3d":
        return [sam3d(folder, out, body, options=options, progress=progress)]
    with result_lock(out, CAMERA_FILES):
        progress("reading")
        if videos is not None:
            options = _with_rate(options, videos, calibration)
        detections, rig = read_cameras(folder, calibration, options)
        progress(
            f"fitting {detections.num_frames} frames of {len(rig.cameras)} cameras, keypoints "
            f"{detections.convention}"
        )
        if calibration is None:
            options = replace(options, keep_cameras=True)
        fits = fit_cameras(detections, rig, body, options=options)
        progress("writing")
        for k, fit in enumerate(fits, 1):
            fit.save(out if len(fits) == 1 else Path(out) / f"person_{k}", videos)
    return [*fits]


@takes(CameraOptions)
def sam3d(
    folder: PathLike,
    out: PathLike | None = None,
    body: BodyModel | PathLike = "default",
    *,
    options: CameraOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> MarkerResult:
    """The body in motion of a person in a video, from SAM 3D Body's output for each of its frames:
    one shape, smooth poses (`habitus.Mosh` on points of the skin). Raises HabitusError.
    """
    if options.fps is None:
        raise HabitusError("fps is missing (--fps HZ); expected the video's frames a second")
    model = loaded(body, age=options.age)
    progress("reading")
    capture, layout = read_sam3d(folder, options.fps, model)
    progress(f"fitting {len(capture)} frames")
    fit = Mosh(layout=layout).fit(capture, model)
    if options.height is not None:
        scale = options.height / fit.body.measure(fit.betas)["height_m"]
        capture, layout = read_sam3d(folder, options.fps, model, scale)
        fit = Mosh(layout=layout).fit(capture, model)
    if out is not None:
        with result_lock(out, MARKER_FILES):
            progress("writing")
            fit.save(out)
    return fit


def read_cameras(
    detections: Detections | PathLike,
    calibration: CameraRig | PathLike | None,
    options: CameraOptions,
) -> tuple[Detections, CameraRig]:
    """Detections and cameras; of keypoints in space those of the axes."""
    if calibration is None:
        if (
            isinstance(detections, Detections)
            or Path(detections).suffix.lower() not in POINT_ENDINGS
        ):
            raise HabitusError(
                "no calibration; expected one (--calibration FILE), or keypoints in space as .trc, "
                ".c3d or .npy"
            )
        return read_points(detections, options.fps, options.convention)
    if not isinstance(detections, Detections):
        if options.fps is None:
            raise HabitusError("fps is missing (--fps HZ); detections do not say it")
        detections = read_detections(detections, options.fps, options.convention, options.names)
    rig = calibration if isinstance(calibration, CameraRig) else read_calibration(calibration)
    return detections, rig


def _with_rate(
    options: CameraOptions, videos: PathLike, calibration: PathLike | None
) -> CameraOptions:
    """The options with the videos' frame rate, where none is given; the videos are checked."""
    assert calibration is not None
    rates = {v.rate_hz for v in read_videos(videos, read_calibration(calibration)).values()}
    if options.fps is not None:
        return options
    if max(rates) > 1.001 * min(rates):
        raise HabitusError(
            f"the videos run at {', '.join(f'{rate:g}' for rate in sorted(rates))} frames a "
            "second; expected one rate, or --fps HZ"
        )
    return replace(options, fps=max(rates))


def _stills(fit: CameraFit, videos: PathLike) -> dict[tuple[int, int], UInt8[np.ndarray, "H W 3"]]:
    """Pictures of each camera at the report's moments, by camera and frame of the fit."""
    cameras = fit.cameras
    assert cameras is not None
    late = np.rint(fit.late * fit.rate_hz).astype(int)
    number = {
        (c, t): fit.first_number + t + int(late[c])
        for c in range(len(cameras.cameras))
        for t in moments(len(fit.pose))
    }
    asked = {
        name: [number[c, t] for c, t in number if c == k] for k, name in enumerate(cameras.names)
    }
    taken = stills(read_videos(videos, cameras), asked)
    keys = {key: (cameras.names[key[0]], frame) for key, frame in number.items()}
    return {key: taken[at] for key, at in keys.items() if at in taken}


def _count(text: str) -> int:
    """How many people."""
    if not (text.isdigit() and 0 < int(text[:6]) < 100):
        raise HabitusError(f"people is {text!r}; expected a number, or auto")
    return int(text)
