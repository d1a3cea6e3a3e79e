"""``habitus export``: a body in motion from an npz into the files that other programs read."""

from pathlib import Path

from habitus.body.model import BodyModel
from habitus.body.motion import Moving
from habitus.errors import HabitusError
from habitus.export.motion import Exported, check_motion_path, export_motion
from habitus.io.archives import open_archive
from habitus.io.fits import load_fit
from habitus.io.motions import load_motion
from habitus.types import PathLike


def export_file(
    source: Moving | PathLike,
    to: PathLike,
    *,
    body: BodyModel | PathLike | None = None,
    fps: float | None = None,
    correctives: str = "auto",
    detail: str = "full",
    frame: int | None = None,
) -> Exported:
    """A fit, a motion, or the npz of one, as one file by its ending (`habitus.export.motion.export_motion`).

    body: the model that the betas belong to, where the file names none that comes along. Raises HabitusError.
    """
    check_motion_path(to)
    return export_motion(read_moving(source, body), to, fps=fps, correctives=correctives, detail=detail, frame=frame)


def read_moving(source: Moving | PathLike, body: BodyModel | PathLike | None = None) -> Moving:
    """A body in motion out of an npz, with its markers where it is a fit's; one that is read already as it is."""
    if isinstance(source, Moving):
        return source
    return load_fit(source, body) if _has_markers(Path(source)) else load_motion(source, body)


def _has_markers(path: Path) -> bool:
    try:
        with open_archive(path) as file:
            return "marker_triangles" in file.names
    except (OSError, HabitusError):
        return False  # whoever reads it says what is wrong
