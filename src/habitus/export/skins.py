"""The skin of a default body in files: `habitus.body.skin` as a picture, and still meshes with
it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from habitus.body.skin import Skin, skin_of
from habitus.body.state import BodySurface
from habitus.body.surface_files import face_lines, obj_lines, ply, write_textured
from habitus.export.animation import Animation
from habitus.export.png import png
from habitus.files import atomic_write, write_text

ROUGHNESS = 0.6


@dataclass(frozen=True, eq=False)
class Painted:
    """An animation, and the PNG of its texture where it has a skin."""

    animation: Animation
    picture: bytes | None = None


def painted(animation: Animation, skin: str | float | None) -> Painted:
    """An animation in a skin, whose layout of texture coordinates its body takes.

    skin: as `habitus.body.skin.skin_tone` reads it; bodies without that layout stay plain.
    """
    found = skin_of(animation.body.mesh, skin)
    if found is None:
        return Painted(animation)
    body = replace(animation.body, mesh=found.mesh)
    return Painted(replace(animation, body=body), png(found.image))


def picture_beside(path: Path) -> Path:
    """Where the texture of a file lies that cannot hold it."""
    return path.with_name(f"{path.stem}_skin.png")


def write_picture(path: Path, picture: bytes) -> None:
    """Write a PNG, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(picture)


def material_text(picture: str) -> str:
    """An OBJ file's library of one material, ``skin``, with a texture beside it."""
    return f"newmtl skin\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture}\n"


def write_material(path: Path, skin: Skin) -> str:
    """Write the material library and the texture of OBJ files, named after ``path``; the lines that
    use them come back.
    """
    library, picture = path.with_name(f"{path.stem}.mtl"), picture_beside(path)
    write_picture(picture, png(skin.image))
    write_text(library, material_text(picture.name))
    return f"mtllib {library.name}\nusemtl skin\n"


def write_painted_surface(surface: BodySurface, path: Path, skin: Skin) -> None:
    """Write one surface (m, +y up) in its skin, atomically: .glb with the texture, .obj with
    material and texture beside it, .ply with colours of vertices.
    """
    vertices = np.asarray(surface.vertices, np.float64)
    faces = np.asarray(surface.faces, np.int64)
    _SURFACES[path.suffix.lower()](vertices, faces, path, skin)


def _glb(vertices: np.ndarray, faces: np.ndarray, path: Path, skin: Skin) -> None:
    plain = np.ones_like(vertices)
    write_textured(vertices, faces, path, plain, skin.mesh, png(skin.image), ROUGHNESS)


def _obj(vertices: np.ndarray, faces: np.ndarray, path: Path, skin: Skin) -> None:
    uses = write_material(path, skin)
    text = f"# {len(vertices)} vertices, metres\n{uses}{obj_lines(vertices)}"
    write_text(path, text + face_lines(faces, skin.mesh))


def _ply(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], path: Path, skin: Skin
) -> None:
    colours = skin.colours
    with atomic_write(path) as temporary:
        temporary.write_bytes(ply(vertices, faces, colours))


_SURFACES: dict[str, Callable[[np.ndarray, np.ndarray, Path, Skin], None]] = {
    ".glb": _glb,
    ".obj": _obj,
    ".ply": _ply,
}
