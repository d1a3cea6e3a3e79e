"""Options of jobs: one frozen dataclass a job, each option with its type, default and help in one
place.

tyro makes the command from it, and `takes` makes a function take its fields as keywords. This
module loads neither NumPy nor the numerics, so that help comes at once; the options of learning are
in `habitus.jobs.learn_options`.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from habitus.errors import HabitusError

if TYPE_CHECKING:
    from habitus.body.model import BodyModel
    from habitus.fit.cameras.result import CameraFit
    from habitus.fit.cameras.settings import CameraSettings
    from habitus.fit.labels.settings import LabelSettings
    from habitus.fit.markers.result import MarkerFit
    from habitus.fit.markers.settings import MoshSettings, MoshWeights
    from habitus.fit.points.depth_settings import RgbdSettings
    from habitus.fit.points.settings import ScanSettings
    from habitus.fit.selection.problem import SelectionSettings
    from habitus.io.captures.read import Capture
    from habitus.markers.layouts import MarkerLayout
    from habitus.observe.camera_rig import CameraRig
    from habitus.types import PathLike

    Age = float | str | None
    Body = PathLike | BodyModel
    CameraFile = PathLike | None
    DepthSettings = RgbdSettings | None
    KeypointSettings = CameraSettings | None
    File = PathLike
    Files = PathLike | Capture | Sequence[PathLike | Capture]
    CameraRigFile = PathLike | CameraRig | None
    KnownFit = PathLike | MarkerFit | CameraFit | None
    LabelledFile = PathLike | Capture | None
    Labels = Sequence[str]
    Layout = PathLike | MarkerLayout | Sequence[MarkerLayout]
    LayoutName = int | PathLike
    Numbers = Sequence[int]
    Pool = int | str | Sequence[str]
    LabelSet = LabelSettings | None
    Scans = ScanSettings | None
    Selecting = SelectionSettings | None
    Settings = MoshSettings | None
    SoftTissue = bool | str
    Turns = Sequence[float | None]
    Weights = MoshWeights | None
else:  # what a command line can say
    Age = str | None
    Body = File = Layout = LayoutName = Pool = str
    CameraFile = CameraRigFile = LabelledFile = KnownFit = Path | None
    DepthSettings = KeypointSettings = LabelSet = Scans = Selecting = Settings = Weights = Any
    Files = tuple[Path, ...]
    Labels = tuple[str, ...]
    Numbers = tuple[int, ...]
    SoftTissue = Literal["none", "shape", "dynamics", "both"]
    Turns = tuple[float, ...]

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
"""An option that is given or not."""
PythonOnly = tyro.conf.Suppress
"""Marks an option that the command line does not show."""
R = TypeVar("R")


def silent(stage: str, share: float) -> None:
    """Does nothing (default progress callback)."""


def unset(metavar: str) -> Any:
    """For options without a default worth showing: the help names none."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


def metavar(text: str) -> Any:
    """What stands for the value in the help."""
    return tyro.conf.arg(metavar=text)


@dataclass(frozen=True, kw_only=True)
class BodyOption:
    """The body that a job uses."""

    body: Annotated[Body, metavar("default|FILE")] = "default"
    """The body model: the bundled one, or an SMPL-family file (npz, pkl)."""


def takes(kind: type) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """A decorator: the function's ``options``, a ``kind``, may also be given field by field.

    ``job(x, fps=60)`` is ``job(x, options=Options(fps=60))``; keywords replace fields of
    ``options``. The signature shows every field.
    """
    names = {field.name for field in fields(kind) if field.init}

    def decorated(function: Callable[..., R]) -> Callable[..., R]:
        own = inspect.signature(function)
        clash = names & set(own.parameters)
        assert not clash, f"{function.__name__} and {kind.__name__} both have {clash}"

        @wraps(function)
        def with_keywords(*given: Any, options: Any = None, **keywords: Any) -> R:
            changes = {name: keywords.pop(name) for name in names & keywords.keys()}
            if options is None:
                options = kind(**changes)
            elif not isinstance(options, kind):  # options of the base class: the rest by default
                options = kind(**{f.name: getattr(options, f.name) for f in fields(options)})
                options = replace(options, **changes)
            elif changes:
                options = replace(options, **changes)
            return function(*given, options=options, **keywords)

        with_keywords.__signature__ = _signature(own, kind)  # type: ignore[attr-defined]
        return with_keywords

    return decorated


def _signature(own: inspect.Signature, kind: type) -> inspect.Signature:
    """The function's parameters, with a keyword for each field in the place of ``options``."""
    added = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default if field.default_factory is MISSING else field.default_factory(),
            annotation=getattr(field.type, "__origin__", field.type)
            if hasattr(field.type, "__metadata__")
            else field.type,
        )
        for field in fields(kind)
        if field.init
    ]
    kept = [parameter for name, parameter in own.parameters.items() if name != "options"]
    first = [
        parameter for parameter in kept if parameter.kind is not inspect.Parameter.KEYWORD_ONLY
    ]
    last = [parameter for parameter in kept if parameter.kind is inspect.Parameter.KEYWORD_ONLY]
    return own.replace(parameters=[*first, *added, *last])


SEXES = ("neutral", "female", "male", "auto")
MIN_CONFIDENCE = 0.45
"""A little under one half, which labels two points that are alike."""


def read_age(age: float | str | None) -> float | None:
    """An age in years; None for none, and for "auto". Raises HabitusError for anything else."""
    if age is None or age == "auto":
        return None
    try:
        years = float(age)
    except (TypeError, ValueError):
        years = math.nan
    if not math.isfinite(years):
        raise HabitusError(
            f"age is {age!r}; expected years, such as 8, or auto for what the capture's file says"
        )
    return years


@dataclass(frozen=True)
class SubjectOptions:
    """Whose body is fitted to markers, and by which layout."""

    layout: Annotated[Layout, metavar("auto|discover|NAME|FILE")] = "auto"
    """Where each marker sits: "auto" picks a layout by the labels, "discover" estimates the places
    of unknown labels by fitting and writes layout.toml, else a shipped name or a file.
    """
    sex: Literal["neutral", "female", "male", "auto"] = "neutral"
    """Model of the body; "auto" takes the sex in the capture's file, else the one that a neutral
    fit is sure of.
    """
    age: Annotated[Age, unset("YEARS|auto")] = None
    """Age of the person, 1 to 90; "auto" takes it from the capture's file. An adult by default."""
    joints: Literal["auto", "smpl", "smplh", "smplx"] = "auto"
    """Joints of the body: 24, 52 with fingers, 55 with jaw and eyes; "auto" takes fingers where one
    hand's carry three markers.
    """
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where the file gives none or a wrong one."""
    settings: Annotated[Settings, PythonOnly] = None
    """Settings of the recipe: stages, schedule, robust loss. soft_tissue, causal and seed override
    its own.
    """

    def __post_init__(self) -> None:
        if self.sex not in SEXES:
            raise HabitusError(f"sex is {self.sex!r}; expected one of {', '.join(SEXES)}")
        read_age(self.age)


@dataclass(frozen=True)
class MarkerOptions(SubjectOptions):
    """How captures are fitted, and what is written of each."""

    soft_tissue: SoftTissue = "shape"
    """What the last stage varies over time: directions of shape, the body's dynamic blend shapes,
    or both; "none" stops after the pose stage.
    """
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random choice of frames."""
    npz_style: Literal["habitus", "amass"] = "habitus"
    """Content of body.npz: all results, or the keys that AMASS scripts read (docs/amass.md)."""
    weights: Annotated[Weights, PythonOnly] = None
    """Of the energy's terms; those of ``settings`` by default."""


@dataclass(frozen=True)
class MoshOptions(MarkerOptions):
    """Options of `habitus mosh`."""

    label: Literal["given", "auto"] = "given"
    """Marker labels: "given" uses the file's, "auto" ignores them and labels the points (see
    habitus label).
    """
    causal: Flag = False
    """Solve frame by frame without looking ahead, as a live system does (no soft tissue)."""
    subject: Annotated[str | None, unset("NAME")] = None
    """Person to fit, where a capture holds several; by default each is fitted separately."""
    hold_out: Annotated[Labels, unset("L1 L2 …")] = ()
    """Exclude these markers from the fit and report their error at the expected placements."""
    hold_out_every: Annotated[int | None, unset("K")] = None
    """Do so for every marker, one in K at a time (K more fits)."""
    placements_from: Annotated[Files, unset("CAPTURE …")] = ()
    """Other captures of the same person and markers: also report the error of held-out markers at
    the placements estimated from these.
    """
    obj: Flag = False
    """Also write an OBJ mesh for every frame."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.label not in ("given", "auto"):
            raise HabitusError(f"label = {self.label!r}; expected 'given' or 'auto'")


@dataclass(frozen=True, kw_only=True)
class ArchiveOptions(MarkerOptions, BodyOption):
    """Options of `habitus archive`."""

    subjects: Annotated[Path | None, unset("TABLE.csv")] = None
    """Table of subjects with the columns capture (a file or folder below FOLDER) and subject; by
    default, subjects are those of files and folders.
    """
    minimal: Flag = False
    """Write only body.npz and metrics.json of each capture: about a third of the disk space."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(SubjectOptions, BodyOption):
    """Options of `habitus live`."""

    known: Annotated[KnownFit, unset("body.npz")] = None
    """Earlier fit of the person with the same markers: shape and placements are taken from it. With
    --cameras an earlier result of `habitus cameras`.
    """
    cameras: Annotated[CameraRigFile, unset("FILE")] = None
    """Calibration of the cameras in which detectors see the person (--source detections)."""
    subject: Annotated[str | None, unset("NAME")] = None
    """Person to follow, where a stream holds several."""
    fps: Annotated[float | None, unset("HZ")] = None
    """Rate at which a file is played, 0 for as fast as it can be followed; or the rate of a stream
    that gives none or a wrong one.
    """
    seconds: Annotated[float, metavar("S")] = 5.0
    """Length of the frames from which the shape is estimated; the person should move."""
    stop_after: Annotated[float | None, unset("S")] = None
    """End after so many seconds."""


@dataclass(frozen=True, kw_only=True)
class LabelOptions(BodyOption):
    """Options of `habitus label`."""

    layout: Annotated[File, metavar("auto|NAME|FILE")] = "auto"
    """The markers; "auto" takes the shipped layout that fits best. With --like: of its labels."""
    like: Annotated[LabelledFile, unset("LABELLED.c3d")] = None
    """Labelled capture of the same person with the same markers, which gives shape and placements;
    the most reliable option.
    """
    min_confidence: Annotated[float, metavar("0..1")] = MIN_CONFIDENCE
    """Labels less likely than this are omitted."""
    people: Annotated[int, metavar("N")] = 1
    """Number of people in the capture, all with the same markers; their labels begin with person1:,
    person2:, …
    """
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second, where the file gives none or a wrong one."""
    settings: Annotated[LabelSet, PythonOnly] = None
    """Settings of the recipe: tracklets, registration, votes, gates."""


@dataclass(frozen=True, kw_only=True)
class MarkerSelectionOptions(BodyOption):
    """Options of `habitus select-markers`."""

    pool: Annotated[Pool, tyro.conf.arg(name="from", metavar="N|LAYOUT,…")] = "114"
    """Candidates: a number of markers spread over the body, or those of layouts."""
    start: Annotated[LayoutName, metavar("LAYOUT|47|67")] = "47"
    """Set to start from: markers of it are removed, and candidates are added to it."""
    goal: Literal["surface", "shape", "pose"] = "surface"
    """Error to minimise: of the posed surface (eq. 13), of the shape at rest, or of the joints."""
    region: Literal["all", "legs", "arms", "trunk", "head"] = "all"
    """Part of the body on which the error is measured."""
    pairs: Flag = False
    """Add and remove left and right markers together."""
    min_markers: Annotated[int, metavar("N")] = 5
    """Size of the smallest set: removal stops there."""
    keep: Annotated[Numbers, metavar("N …")] = (25, 67)
    """Sizes of the sets that are written as layouts."""
    people: Annotated[int, metavar("N")] = 40
    """Number of posed people on whom sets are evaluated."""
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random people."""
    settings: Annotated[Selecting, PythonOnly] = None
    """Settings of the recipe: noise of markers, freedom of the root."""


@dataclass(frozen=True, kw_only=True)
class PoseSelectionOptions(BodyOption):
    """Options of `habitus select-poses`."""

    layout: Annotated[LayoutName, metavar("NAME|FILE")] = "mosh-47"
    """Markers that the person wears."""
    count: Annotated[int, metavar("N")] = 12
    """Number of poses."""
    candidates: Annotated[int, metavar("N")] = 200
    """Poses to choose from: plain ones, and others drawn from the pose prior."""
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random candidates."""
    settings: Annotated[Selecting, PythonOnly] = None
    """Settings of the recipe: how far skin slips, freedom of the root."""


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """Options of `habitus register`."""

    age: Annotated[float | None, unset("YEARS")] = None
    """Age of the person, 1 to 90; an adult by default."""
    sex: Annotated[Literal["female", "male"] | None, unset("female|male")] = None
    """Sex that registrations.npz records for `habitus train`; the fit does not use it."""
    unit: Literal["auto", "m", "cm", "mm", "in", "ft"] = "auto"
    """Unit of the scans; "auto" takes m, cm or mm by the size of a person."""
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Axis of the scans that points up; "auto" estimates it."""
    separate: Flag = False
    """Every scan is another person."""
    sequence: Flag = False
    """The scans are in time order: each starts from the result before."""
    coregister: Flag = False
    """Every folder is one person in some poses: a body is trained on the registrations of two
    people or more and registers all of them again (needs PyTorch).
    """
    clothes: Literal["none", "tight", "loose"] = "none"
    """What the person wears: tight clothes (1 mm on trunk and thighs, 3 mm of hair) are subtracted
    from the skin; under loose ones the skin is estimated.
    """
    texture: Flag = False
    """Use the colours of two or more scans of the person to refine their correspondences."""
    seed: Annotated[int, metavar("N")] = 0
    """Seed of the random choice of points."""
    settings: Annotated[Scans, PythonOnly] = None
    """Settings of the recipe."""


@dataclass(frozen=True, kw_only=True)
class DepthOptions:
    """Options of a fit to depth views."""

    turns: Annotated[Turns, unset("DEGREES …")] = ()
    """Turn of the person in each view, to their left; estimated by default."""
    age: Annotated[float | None, unset("YEARS")] = None
    """Age of the person, 1 to 90; an adult by default."""
    settings: Annotated[DepthSettings, PythonOnly] = None
    """Settings of the recipe; clothes_mm and hair_mm override its own."""


@dataclass(frozen=True, kw_only=True)
class RgbdOptions(DepthOptions):
    """Options of `habitus rgbd`."""

    views: Annotated[Numbers, unset("NUMBERS")] = ()
    """Views to use, counted from 0; by default all, up to 12."""
    people: Literal["one", "all"] = "one"
    """Fit the person nearest to the middle of the image, or everybody in one view, each in a folder
    of their own.
    """
    depth_unit: Annotated[float | None, unset("METRES")] = None
    """Metres of one step of depth, where no file gives it: 0.001, or 0.0002 for TUM's."""
    cameras: Annotated[CameraFile, unset("FILE")] = None
    """Intrinsics (json, yaml) stored elsewhere."""
    clothes_mm: Annotated[float | None, unset("MM")] = None
    """Thickness of tight clothes on trunk and thighs, which is subtracted from the skin: 1 by
    default, 0 without clothes.
    """
    hair_mm: Annotated[float | None, unset("MM")] = None
    """Thickness of hair and cap, which is subtracted from the head; where it is not given, hair of
    7 mm or more is measured, and 3 mm are subtracted from other heads.
    """


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Options of `habitus cameras`."""

    source: Literal["keypoints", "sam3d"] = "keypoints"
    """What the folder holds: detections of calibrated cameras, or SAM 3D Body's output for each
    frame of one video (.npz).
    """
    fps: Annotated[float | None, unset("HZ")] = None
    """Frames a second of the detections, which their files do not say."""
    height: Annotated[float | None, unset("METRES")] = None
    """Height of the person, where it is known; estimated by default."""
    floor: Annotated[float | None, unset("METRES")] = None
    """Of one camera: height of the floor along the upward axis of the calibration's world, often 0:
    feet that stand on it tell the distance.
    """
    people: Annotated[str, metavar("N|auto")] = "1"
    """Number of people to fit, those who are seen most first; "auto": all."""
    convention: Annotated[str | None, unset("NAME")] = None
    """Order of the keypoints: coco17, openpose25, body25b, halpe26, wholebody23, blazepose33 or
    mhr70; by default names in the files, else the person's proportions.
    """
    names: Annotated[Path | None, unset("FILE")] = None
    """Keypoints by the files' own names (DeepLabCut), a .toml of lines such as knee_L =
    "left_knee".
    """
    keep_cameras: Flag = False
    """Take the calibration as it is; by default each camera is corrected a little, and how much is
    reported.
    """
    up: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Axis of the calibration's world that points up; "auto": from hips to shoulders."""
    age: Annotated[float | None, unset("YEARS")] = None
    """Age of the person, 1 to 90; an adult by default."""
    settings: Annotated[KeypointSettings, PythonOnly] = None
    """Settings of the recipe."""


@dataclass(frozen=True, kw_only=True)
class GaitOptions:
    """Options of `habitus gait`."""

    convention: Literal["isb", "pig", "opensim"] = "isb"
    """Of the joint angles: ISB's, Plug-in Gait's, or the coordinates of OpenSim's models."""
    mass: Annotated[float | None, unset("KG")] = None
    """Of the person; by default what the capture records, else what the plates weigh, else what
    the body's volume says.
    """
    plates: Literal["auto", "none"] = "auto"
    """Force plates of the capture: used where there are some, or not at all."""
    events: Literal["auto", "motion"] = "auto"
    """Foot strikes and offs: the file's and the plates' where there are some, or by the motion
    alone."""
    c3d: Flag = False
    """Also write gait.c3d: a copy of the capture with angles, moments and powers as model outputs.
    """
    opensim: Flag = False
    """Also write opensim/: markers, ground forces and set-ups that OpenSim 4 runs with a scaled
    model of yours.
    """
    opensim_model: Annotated[Path | None, unset("OSIM")] = None
    """A generic model of yours: opensim/ then also holds it scaled to the person, with the markers
    on it, inverse kinematics, inverse dynamics and a check (needs habitus[opensim]).
    """
    opensim_markers: Annotated[Path | None, unset("XML")] = None
    """The marker set of a generic model that has none, such as gait2392."""
    band: Annotated[Path | None, unset("CSV|FOLDER")] = None
    """A laboratory's own reference, drawn behind the curves: a .csv with the columns percent, and
    for each curve NAME_mean and NAME_sd, such as knee_flexion_mean; or a folder with at least
    three results of habitus gait.
    """
