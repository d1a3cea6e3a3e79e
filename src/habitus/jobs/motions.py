"""What is made of a body in motion: soft tissue exaggerated, or other bodies in the same motion,
given by betas, a person, the mean person of a body, or a character's mesh. Files in, files out.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.body.recentred import FROM, is_of, recentred
from habitus.body.soft_tissue import exaggerated
from habitus.errors import HabitusError, shown
from habitus.export.motion import check_motion_path, export_motion
from habitus.fit.retarget.recipe import RETARGET, Retargeting, RetargetSettings, retargeted
from habitus.io.marker_fit_arrays import MAX_BETA
from habitus.io.meshes import ENDINGS as MESHES
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import SHIPPED
from habitus.io.people import read_motion, read_shape
from habitus.jobs.results import Motion
from habitus.types import PathLike

Target = tuple[BodyModel, Float[np.ndarray, " B"], str]
"""The body that moves, its betas, and what to call it."""


def find_target(
    motion: BodyMotion, to: BodyModel | Sequence[float] | np.ndarray | PathLike
) -> Target:
    """The target that ``to`` means for a motion's body. Raises HabitusError where it means none.

    Another shape of the motion's own body space is a set of betas; of any other person or character
    of its topology the surface at rest becomes the template (`recentred`), so that soft tissue has
    the motion's own directions.
    """
    if isinstance(to, BodyModel):
        return _person(motion, to, np.zeros(to.num_betas), to.name)
    if not isinstance(to, str | os.PathLike):
        return _betas(motion, np.asarray(to, np.float64))
    text = os.fspath(to)
    if Path(text).suffix.lower() in MESHES:
        return _character(motion, Path(text))
    if text in SHIPPED or Path(text).suffix.lower() in (".npz", ".pkl"):
        return _of_file(motion, text)
    try:
        return _betas(motion, np.array([float(word) for word in text.split(",")]))
    except ValueError:
        raise HabitusError(
            f"{shown(text)}: no body to retarget to; expected a person or body (.npz), a "
            "character's mesh (.obj, .ply), "
            "neutral, female or male, or betas with commas between, such as 1.5,-0.5"
        ) from None


def _betas(motion: BodyMotion, given: np.ndarray) -> Target:
    count = motion.body.num_betas
    if given.ndim != 1 or len(given) > count or not (np.abs(given) <= MAX_BETA).all():
        raise HabitusError(
            f"betas of shape {given.shape}; expected up to {count} numbers of the fit's space, "
            f"within {MAX_BETA:g} standard deviations"
        )
    text = ", ".join(f"{value:g}" for value in given[:4]) + (", …" if len(given) > 4 else "")
    name = motion.body_name or motion.body.name
    return motion.body, np.pad(given, (0, count - len(given))), f"{name} with betas {text}"


def _of_file(motion: BodyMotion, text: str) -> Target:
    """A person's npz, or a body's mean person."""
    known = {motion.body_name: motion.body}
    person = read_shape(text, known=known)
    return _person(motion, person.body, person.betas, person.name)


def _person(motion: BodyMotion, model: BodyModel, betas: np.ndarray, name: str) -> Target:
    own = motion.body
    same = FROM not in own.extras and SHIPPED.get(model.name, model.name) == SHIPPED.get(
        own.name, own.name
    )
    if same and (model.age, model.num_betas) == (own.age, own.num_betas):
        return own, np.pad(betas, (0, own.num_betas - len(betas))), name
    level = model.full or model
    return _recentred(motion, level.rest_vertices(betas), name)


def _character(motion: BodyMotion, source: Path) -> Target:
    vertices, faces = read_mesh(source)
    levels = [level for level in (motion.body, motion.body.full) if level is not None]
    if not any(is_of(level, vertices, faces) for level in levels):
        known = " or ".join(
            f"{level.num_vertices} vertices and {level.num_faces} triangles" for level in levels
        )
        raise HabitusError(
            f"{source}: a mesh of {len(vertices)} vertices and {len(faces)} triangles; a "
            "character has the body's own "
            f"({known}, in their order): register the body to it first, in a tool that keeps "
            "vertex order"
        )
    return _recentred(motion, vertices, source.stem)


def _recentred(motion: BodyMotion, vertices: np.ndarray, name: str) -> Target:
    body = recentred(motion.body, vertices, name)
    return body, np.zeros(body.num_betas), name


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
    settings: RetargetSettings | None = None,
) -> Retargeting:
    """The motion on another body (M 9.2): soft tissue carried over, feet where they stood, no
    deeper in the ground.

    source: a fit, a motion, or the npz of one. to: betas of another shape of its body; a person's
    npz (a fit's body.npz, what ``habitus body`` wrote); a body model, by name or file, for its mean
    person; or a character's mesh at rest (obj, ply; metres, y up, T-pose) with the body's vertices
    and faces, of either level of detail. body: as for `exaggerate`. out: as there.
    settings: of the recipe, contacts included. Raises
    HabitusError for a mesh of another topology, a character that is not at rest, and other endings.
    """
    _check(out)
    motion = motion_of(source, body)
    target, betas, name = find_target(motion, to)
    result = retargeted(motion, target, betas, name, settings or RETARGET)
    _written(result.motion, out)
    return replace(result, motion=Motion.of(result.motion))


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
