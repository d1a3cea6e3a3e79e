"""Reads meshes: PLY and OBJ, vertices and triangles in the file's own order."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, require_extra

ENDINGS = (".ply", ".obj")


def read_mesh(path: str | Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """The vertices, in the file's unit, and triangles of a PLY or OBJ file, none merged, none reordered.

    Polygons are cut into triangles, always alike. Raises HabitusError where the file is no such mesh, or trimesh, which
    reads it, is not installed.
    """
    source = Path(path)
    if source.suffix.lower() not in ENDINGS:
        raise HabitusError(f"{source}: ending {source.suffix!r}; expected a mesh ({' or '.join(ENDINGS)})")
    trimesh = require_extra("trimesh", "meshes")
    try:
        with source.open("rb") as file:
            mesh = trimesh.load(
                file,
                file_type=source.suffix[1:].lower(),
                force="mesh",
                process=False,
                maintain_order=True,
                skip_materials=True,
            )
    except OSError as error:
        raise HabitusError(f"{source}: {error.strerror or error}; expected a mesh") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{source}: cannot be read ({_first_line(error)}); expected a mesh; export it again"
        ) from error
    vertices, faces = np.asarray(getattr(mesh, "vertices", ())), np.asarray(getattr(mesh, "faces", ()))
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise HabitusError(
            f"{source}: holds {len(vertices)} points and {len(faces)} faces; expected a mesh of triangles"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise HabitusError(f"{source}: its faces name vertices up to {faces.max()} of {len(vertices)}; export it again")
    return np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
