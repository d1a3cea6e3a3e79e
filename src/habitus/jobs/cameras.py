"""Bodies from calibrated cameras: keypoints of a detector in, a folder of results for each person
out.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.cameras.recipe import fit_cameras as fitted
from habitus.fit.cameras.result import CameraFit
from habitus.fit.cameras.settings import CAMERAS
from habitus.io.cameras.read import read_calibration
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
from habitus.report.cameras import camera_page
from habitus.results.cameras import CAMERA_FILES, save_cameras
from habitus.results.save import MARKER_FILES, result_lock
from habitus.types import PathLike


class CameraResult(Exportable, CameraFit):
    """A fit to keypoints that can write itself."""

    @classmethod
    def of(cls, fit: CameraFit) -> Self:
        """The same fit, with the methods."""
        return with_methods(cls, fit)

    def save(self, folder: PathLike) -> None:
        """Write body.npz, body.glb, measurements.csv, metrics.json and report.html, as ``habitus
        cameras`` does.

        Raises HabitusError where the folder cannot be written.
        """
        save_cameras(self, folder, camera_page)


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
    with one_blas_thread():
        fits = fitted(
            model,
            prior_of(model),
            detections,
            rig,
            options.settings or CAMERAS,
            people=people,
            height=options.height,
            correct=not options.keep_cameras and calibration is not None,
            up=options.up,
        )
    return [CameraResult.of(fit) for fit in fits]


@takes(CameraOptions)
def cameras(
    folder: PathLike,
    calibration: PathLike | None,
    out: PathLike,
    body: BodyModel | PathLike = "default",
    *,
    options: CameraOptions,
    progress: Callable[[str], Any] = lambda text: None,
) -> list[CameraResult | MarkerResult]:
    """Read detections and calibration, fit, and write the results into the folder ``out``, of
    several people into ``out``/person_N, as ``habitus cameras`` does. Raises HabitusError.
    """
    if options.source == "sam3d":
        return [sam3d(folder, out, body, options=options, progress=progress)]
    with result_lock(out, CAMERA_FILES):
        progress("reading")
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
            fit.save(out if len(fits) == 1 else Path(out) / f"person_{k}")
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


def _count(text: str) -> int:
    """How many people."""
    if not (text.isdigit() and 0 < int(text[:6]) < 100):
        raise HabitusError(f"people is {text!r}; expected a number, or auto")
    return int(text)
