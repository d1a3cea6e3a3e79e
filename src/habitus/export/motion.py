"""A body in motion that is no fit as a file: AMASS's names in .npz, animated .glb, a folder of .obj meshes."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from habitus.body.motion import BodyMotion
from habitus.body.recentred import recentred_arrays
from habitus.errors import HabitusError
from habitus.export.glb import write_glb
from habitus.export.npz import motion_arrays, save_arrays
from habitus.export.obj import write_obj_sequence
from habitus.io.files import atomic_write


def write_motion(motion: BodyMotion, path: str | os.PathLike[str]) -> None:
    """Write a `BodyMotion` as .npz, atomically; `habitus.io.motions.load_motion` reads it back.

    The names of AMASS and of a fit's body.npz (`habitus.export.npz.write_npz`), without markers; ``made`` says in
    sentences where the motion comes from. A character's file holds its surface, ``character_vertices`` (V, 3; m, at
    rest), and the name of the body that it was made of, ``character_base``. Raises HabitusError where it cannot be
    written.
    """
    arrays = motion_arrays(motion) | dict(recentred_arrays(motion.body))
    arrays["made"] = np.array(motion.made, dtype=np.str_)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, arrays)


_WRITERS: Mapping[str, Callable[[BodyMotion, Path], object]] = {
    ".npz": write_motion,
    ".glb": write_glb,
    "": write_obj_sequence,
}


def export_motion(motion: BodyMotion, path: str | os.PathLike[str]) -> None:
    """Write a motion as one file, by its ending: .npz, .glb; without an ending, a folder with an OBJ a frame.

    Raises HabitusError for other endings.
    """
    target = Path(path)
    check_motion_path(target)
    _WRITERS[target.suffix.lower()](motion, target)


def check_motion_path(path: str | os.PathLike[str]) -> None:
    """Raises HabitusError for an ending that no motion is written to."""
    target = Path(path)
    if target.suffix.lower() not in _WRITERS:
        raise HabitusError(
            f"cannot write a motion to {target.name}: expected .npz (AMASS's names), .glb (animated mesh), or a name "
            "without an ending (a folder with an OBJ mesh a frame)"
        )
