"""`habitus cameras`: bodies in motion from keypoints of calibrated cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from habitus.cli.screen import FAILED_FIT, Strict, plain, say, screen
from habitus.jobs.options import CameraOptions, metavar, unset

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True, kw_only=True)
class _Files:
    folder: Annotated[Path, tyro.conf.Positional, metavar("FOLDER")]
    """Detections: a folder or a file for each camera, as OpenPose, MMPose (RTMPose), AlphaPose,
    COCO or DeepLabCut write them, or FreeMoCap's .npy of 2D points; or keypoints in space (.trc,
    .c3d, .npy), without a calibration.
    """
    calibration: Annotated[Path | None, unset("FILE|FOLDER")] = None
    """The cameras: .toml (Pose2Sim, Anipose), .qca.txt (Qualisys), .xcp (Vicon), .yml (OpenCV),
    EasyMocap's or OpenCap's folder.
    """
    out: Annotated[Path, metavar("FOLDER")]
    """Output folder: body.npz, body.glb, measurements.csv, metrics.json and report.html; of several
    people a folder of these each.
    """
    videos: Annotated[Path | None, unset("FOLDER")] = None
    """The cameras' videos (cam01.mp4 for cam_01; needs habitus[video]): the report shows the body
    over their pictures; and the frame rate, where --fps does not give it.
    """
    body: Annotated[str, metavar("NAME|FILE")] = "default"
    """Body to fit: female, male, neutral, a file, or default: the neutral one."""


@dataclass(frozen=True, kw_only=True)
class Cameras(Strict, CameraOptions, _Files):
    """Fit bodies to 2D keypoints of calibrated cameras.

    habitus cameras trial/pose --calibration Calib.toml --fps 60 --out results

    habitus cameras trial/pose --calibration Calib.toml --fps 60 --height 1.72 --people 2 --out
    results

    habitus cameras keypoints.trc --out results

    habitus cameras frames --source sam3d --fps 30 --height 1.72 --out results

    `docs/cameras.md` explains how to calibrate and to film, what is read, and what to expect.
    """


OPTIONS = Cameras
ABOUT = Cameras.__doc__
NEEDS = ("habitus.jobs.cameras",)


def run(options: Cameras, console: "Console | None" = None) -> int:
    """Do what the options say; 3 under ``strict`` where a fit failed by its verdict. Raises
    HabitusError for bad input.
    """
    from habitus.jobs.cameras import cameras

    console = console or screen(options.quiet)
    fits = cameras(
        options.folder,
        options.calibration,
        options.out,
        options.body,
        videos=options.videos,
        options=options,
        progress=lambda text: say(console, text, "note"),
    )
    for text in dict.fromkeys(text for fit in fits for text in fit.warnings):
        say(console, text, "note")
    for fit in fits:
        name = f"{fit.capture_name}: " if len(fits) > 1 else ""
        say(console, f"{name}{fit.verdict}")
        height = fit.body.measure(fit.betas)["height_m"]
        say(console, f"{name}height {100 * height:.1f} cm, {len(fit.pose)} frames")
    say(console, f"wrote {plain(options.out)}: open report.html")
    failed = any(fit.verdict.level == "failed" for fit in fits)
    return FAILED_FIT if options.strict and failed else 0


def left(options: Cameras) -> str:
    """What a stopped run leaves."""
    return "finished people are complete"
