"""``habitus retarget --target character.glb``: a motion on any rigged character of a glTF or FBX
file. Files in, files out.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion, Moving
from habitus.body.rig import Rig
from habitus.errors import HabitusError
from habitus.export.character import OUT, skin_of, write_character
from habitus.export.fbx.character import OUT as FBX_OUT
from habitus.export.fbx.character import skin_of_scene, write_character_fbx
from habitus.fit.retarget.characters import CharacterMotion, Skin, character_of, moved_character
from habitus.fit.retarget.recipe import RETARGET, RetargetSettings, turned
from habitus.io.motions.fbx import read_fbx
from habitus.io.motions.fbx_motion import ENDINGS as FBX
from habitus.io.motions.fbx_motion import rig_of_scene
from habitus.io.motions.gltf import ENDINGS as GLTF
from habitus.io.motions.gltf import read_gltf, rig_of
from habitus.jobs.motions import motion_of
from habitus.kernels.threads import one_blas_thread
from habitus.rotations import up_rotation
from habitus.types import PathLike

ENDINGS = (*GLTF, *FBX)

Write = Callable[[CharacterMotion, PathLike, str], object]


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
    """A motion on a rigged character; mesh, skin and materials are kept.

    source: a fit, a motion, or the file of one. character: a .glb, .gltf, .vrm or .fbx with a
    skinned mesh; its joints are identified by common names or by the tree. body: the model of an
    npz that names none. out: the file to write, with the animation added: .glb or .vrm for glTF,
    .fbx for FBX. Raises HabitusError.
    """
    path = Path(character)
    if out is not None:
        check_character_path(path, out)
    motion = BodyMotion.of(motion_of(source, body))
    try:
        rig, skin, write = _opened(path)
        with one_blas_thread():
            built = character_of(rig, skin, path.stem)
            upright = turned(motion, up_rotation(motion.up_axis))
            moved = moved_character(upright, built, settings or RETARGET)
        if out is not None:
            write(moved, out, motion.capture_name)
    except HabitusError as error:
        raise HabitusError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    return moved


def _opened(path: Path) -> tuple[Rig, Skin, Write]:
    """Skeleton and skin of a character's file, and the function that writes it with a motion."""
    if path.suffix.lower() in FBX:
        scene = read_fbx(path)
        return rig_of_scene(scene), skin_of_scene(scene), partial(write_character_fbx, scene)
    file = read_gltf(path)
    return rig_of(file), skin_of(file), partial(write_character, file)


def check_character_path(character: Path, out: PathLike) -> Path:
    """The path that receives a character. Raises HabitusError for other endings."""
    target = Path(out)
    allowed = (FBX_OUT,) if character.suffix.lower() in FBX else OUT
    if target.suffix.lower() not in allowed:
        raise HabitusError(
            f"{target}: ending {target.suffix!r}; expected {' or '.join(allowed)} for the "
            f"character {character.name}: mesh and materials stay in their own format"
        )
    return target
