"""What is made of a body in motion: soft tissue exaggerated, other bodies in the same motion. Files
in, files out.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.body.soft_tissue import exaggerated
from habitus.export.motion import check_motion_path, export_motion
from habitus.fit.retarget.recipe import Retargeting, retargeted
from habitus.io.people import read_motion
from habitus.jobs.results import Motion
from habitus.jobs.targets import find_target
from habitus.types import PathLike


def exaggerate(
    source: Moving | PathLike,
    factor: float,
    *,
    body: BodyModel | PathLike | None = None,
    out: PathLike | None = None,
) -> Motion:
    """The motion with its soft tissue ``factor`` times as far from its own mean (M 9.1): 1.5 or 2,
    or 0 for none.

    source: a fit, a motion, or the npz of one. body: the model that its betas belong to, where the
    file names none that comes along. out: a file that receives it, by its ending .npz, .glb, or a
    folder with an OBJ a frame. Raises HabitusError for a factor below 0, a motion without soft
    tissue, and other endings.
    """
    _check(out)
    return Motion.of(_written(exaggerated(motion_of(source, body), factor), out))


def retarget(
    source: Moving | PathLike,
    to: BodyModel | Sequence[float] | np.ndarray | PathLike,
    *,
    body: BodyModel | PathLike | None = None,
    out: PathLike | None = None,
) -> Retargeting:
    """The motion on another body (M 9.2): soft tissue carried over, feet where they stood, no
    deeper in the ground.

    source: a fit, a motion, or the npz of one. to: betas of another shape of its body; a person's
    npz (a fit's body.npz, what ``habitus body`` wrote); a body model, by name or file, for its mean
    person; or a character's mesh at rest (obj, ply; metres, y up, T-pose) with the body's vertices
    and faces, of either level of detail. body: as for `exaggerate`. out: as there. Raises
    HabitusError for a mesh of another topology, a character that is not at rest, and other endings.
    """
    _check(out)
    motion = motion_of(source, body)
    target, betas, name = find_target(motion, to)
    found = retargeted(motion, target, betas, name)
    _written(found.motion, out)
    return replace(found, motion=Motion.of(found.motion))


def motion_of(source: Moving | PathLike, body: BodyModel | PathLike | None) -> BodyMotion:
    """A fit or a motion, or the npz of one, as a motion. Raises HabitusError."""
    return BodyMotion.of(source) if isinstance(source, Moving) else read_motion(source, body)


def _check(out: PathLike | None) -> None:
    """A file that cannot be written is refused before the work."""
    if out is not None:
        check_motion_path(out)


def _written(motion: BodyMotion, out: PathLike | None) -> BodyMotion:
    if out is not None:
        export_motion(motion, Path(out))
    return motion
