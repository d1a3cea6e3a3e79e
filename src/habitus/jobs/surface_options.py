"""Options of the jobs that fit surfaces: `habitus register` and `habitus rgbd`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from habitus.jobs.options import Flag, PythonOnly, metavar, unset

if TYPE_CHECKING:
    from habitus.fit.points.settings import RgbdSettings, ScanSettings
    from habitus.types import PathLike

    CameraFile = PathLike | None
    DepthSettings = RgbdSettings | None
    Scans = ScanSettings | None
    Numbers = Sequence[int]
    Turns = Sequence[float | None]
else:  # what a command line can say
    CameraFile = Path | None
    DepthSettings = Scans = Any
    Numbers = tuple[int, ...]
    Turns = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class RegisterOptions:
    """Options of `habitus register`."""

    age: Annotated[float | None, unset("YEARS")] = None
    """Age of the person, 5 to 80; an adult by default."""
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
    """Age of the person, 5 to 80; an adult by default."""
    settings: Annotated[DepthSettings, PythonOnly] = None
    """Settings of the recipe; clothes_mm and hair_mm override its own."""


@dataclass(frozen=True, kw_only=True)
class RgbdOptions(DepthOptions):
    """Options of `habitus rgbd`."""

    views: Annotated[Numbers, unset("NUMBERS")] = ()
    """Views to use, counted from 0; by default all, up to 12."""
    depth_unit: Annotated[float | None, unset("METRES")] = None
    """Metres of one step of depth, where no file gives it: 0.001, or 0.0002 for TUM's."""
    cameras: Annotated[CameraFile, unset("FILE")] = None
    """Intrinsics (json, yaml) stored elsewhere."""
    clothes_mm: Annotated[float | None, unset("MM")] = None
    """Thickness of tight clothes on trunk and thighs, which is subtracted from the skin: 1 by
    default, 0 without clothes.
    """
    hair_mm: Annotated[float | None, unset("MM")] = None
    """Thickness of hair and cap, which is subtracted from the head: 3 by default."""
