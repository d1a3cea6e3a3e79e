"""Results as the public functions return them: fits and motions with ``save`` and ``export``.

The numerics return data that know no files. Here each kind gets the methods that write it, with the
page of its recipe (`habitus.report`) in a result folder (`habitus.results`).
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from habitus.body.motion import BodyMotion, Moving
from habitus.errors import HabitusError, shown
from habitus.files import replaceable
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus.io.names import file_name, one_file
from habitus.report.fit.page import report_page
from habitus.results.save import save_markers
from habitus.types import PathLike

if TYPE_CHECKING:
    from habitus.body.anatomical_angles import AngleTable
    from habitus.export.motion import Exported
    from habitus.io.people import BodyLike


class Exportable(Moving):
    """A motion with a method that writes it."""

    def export(self, path: PathLike, **options: Any) -> "Exported":
        """Write the motion as the format that the path's ending names.

        Formats: .fbx, .glb, .usd, .usdz, .bvh, .trc, .mot, .npz, .obj, .ply; without an ending a
        folder with an OBJ mesh per frame. options: fps, correctives, detail, frame
        (`habitus.export.motion.export_motion`). Raises HabitusError for other endings, and where
        the path cannot be written.
        """
        from habitus.export.motion import export_motion

        return export_motion(self, path, **options)

    def angles(self, convention: str = "isb") -> "AngleTable":
        """Joint angles (degrees) by "isb", "pig" (Plug-in Gait) or "opensim"
        (`habitus.jobs.anatomy.angles`, docs/for-laboratories.md). Raises HabitusError.
        """
        from habitus.jobs.anatomy import angles

        return angles(self, convention)


class MarkerResult(Exportable, MarkerFit):
    """A marker fit that can write itself."""

    @classmethod
    def of(cls, fit: MarkerFit) -> Self:
        """The same fit, with the methods."""
        return with_methods(cls, fit)

    def save(self, folder: PathLike, npz_style: str = "habitus") -> None:
        """Write body.npz, body.glb, metrics.json and report.html, as ``habitus mosh`` does.

        npz_style: "habitus", which ``habitus.load_fit(folder)`` reads back, or "amass"
        (docs/amass.md). Raises HabitusError where the folder cannot be written.
        """
        save_fit(self, folder, npz_style=npz_style)


class Motion(Exportable, BodyMotion):
    """A motion that can write itself."""

    @classmethod
    def of(cls, moving: Any) -> Self:
        """The motion of a fit without its markers, or of a `BodyMotion`, with the method."""
        return with_methods(cls, BodyMotion.of(moving))


def with_methods(kind: type[Any], data: object) -> Any:
    """An instance of ``kind``, a subclass without fields of its own, that shares the data's fields
    and what was computed of them.
    """
    if isinstance(data, kind):
        return data
    out = object.__new__(kind)
    out.__dict__.update(vars(data))
    return out


def load_fit(path: str | os.PathLike[str], body: "BodyLike" = None) -> MarkerResult:
    """The marker fit in a body.npz, or in a result folder, that ``habitus mosh`` or ``fit.save``
    wrote.

    body: the model that was fitted, loaded or a file; needed where it is none of the shipped
    bodies, as a fit's file holds no body. Not in the file: held-out errors, costs and timings,
    which metrics.json beside it has. Observed and predicted markers are kept in float32. Raises
    HabitusError, with the file named, where it holds no such fit or the body is another.
    """
    from habitus.io.people import read_fit

    return MarkerResult.of(read_fit(path, body))


def load_motion(path: str | os.PathLike[str], body: "BodyLike" = None) -> Motion:
    """The motion in an npz of ``habitus mosh``, ``exaggerate`` or ``retarget``, or of AMASS.

    AMASS: ``poses`` (T, 3J; rad), ``trans`` (T, 3; m), ``betas``, ``mocap_framerate`` (Hz), z up.
    body: the model that the betas belong to, loaded or a file; needed where the file names none of
    the shipped bodies. Raises HabitusError, with the file named, where it holds no motion, or where
    the betas belong to another body.
    """
    from habitus.io.people import read_motion

    return Motion.of(read_motion(path, body))


def save_fit(
    fit: MarkerFit,
    folder: PathLike,
    obj: bool = False,
    npz_style: str = "habitus",
    minimal: bool = False,
) -> MarkerFit:
    """Write a marker fit's folder with its report; see `habitus.results.save.save_markers`."""
    page = None if minimal else _marker_page
    return save_markers(fit, folder, page, obj=obj, npz_style=npz_style, minimal=minimal)


def _marker_page(fit: MarkerFit, numbers: Mapping[str, Any], files: Sequence[str]) -> str:
    return report_page(fit, dict(numbers), files)


def capture_folders(out: Path, captures: Sequence[Capture], several: bool) -> dict[int, Path]:
    """The folder of each capture's results, by its id: of its name, and with several people that of
    its person.

    Raises HabitusError for names that no folder can have, for captures that would share one, and
    for a place that is taken by something else.
    """
    names = {}
    for capture in captures:
        name = file_name(capture.name, f"the capture {shown(capture.name)!r}")
        names[id(capture)] = (
            file_name(f"{name}_{capture.subject or 'unnamed'}") if several else name
        )
    twice = one_file(list(names.values()), out)
    if twice:
        raise HabitusError(
            f"several captures are called {', '.join(twice)}, so their results would overwrite "
            "each other; "
            "expected names that differ; rename one, or fit them in separate runs"
        )
    return {key: replaceable(out / name) for key, name in names.items()}
