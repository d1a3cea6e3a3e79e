"""``habitus retarget --target character.glb``: a motion on any rigged glTF character. Files in,
files out.
"""

from pathlib import Path

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.errors import HabitusError
from habitus.export.character import check_character_path, skin_of, write_character
from habitus.fit.retarget.characters import CharacterMotion, character_of, moved_character
from habitus.fit.retarget.recipe import RETARGET, RetargetSettings, turned
from habitus.io.motions.gltf import ENDINGS, read_gltf, rig_of
from habitus.jobs.motions import motion_of
from habitus.kernels.threads import one_blas_thread
from habitus.rotations import up_rotation
from habitus.types import PathLike


def is_character(target: object) -> bool:
    """Whether a target's name is that of a rigged character's file."""
    return Path(str(target)).suffix.lower() in ENDINGS


def retarget_to_character(
    source: Moving | PathLike,
    character: PathLike,
    *,
    body: BodyModel | PathLike | None = None,
    out: PathLike | None = None,
    settings: RetargetSettings | None = None,
) -> CharacterMotion:
    """A motion on a rigged glTF character, whose mesh, skin and materials stay as they are.

    source: a fit, a motion, or the file of one. character: a .glb, .gltf or .vrm with a skinned
    mesh; its joints are known by names in use or by the tree. body: the model of an npz that names
    none. out: .glb or .vrm, the character's file with one animation more. Raises HabitusError.
    """
    if out is not None:
        check_character_path(out)
    motion = BodyMotion.of(motion_of(source, body))
    path = Path(character)
    file = read_gltf(path)
    try:
        with one_blas_thread():
            built = character_of(rig_of(file), skin_of(file), path.stem)
            upright = turned(motion, up_rotation(motion.up_axis))
            moved = moved_character(upright, built, settings or RETARGET)
    except HabitusError as error:
        raise HabitusError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    if out is not None:
        write_character(file, moved, out, motion.capture_name)
    return moved
