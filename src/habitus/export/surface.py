"""One posed surface as a mesh file: PLY, OBJ or glb, by the file's ending."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import to_numpy
from habitus.body.mesh import BodyMesh
from habitus.errors import HabitusError
from habitus.export.glb import mesh_document
from habitus.export.obj import face_lines, obj_lines
from habitus.files import atomic_write


def write_surface(
    surface: Any, path: str | os.PathLike[str], faces: Int[np.ndarray, "F 3"] | None = None
) -> None:
    """Write a `BodySurface` as one mesh, atomically: .ply (binary), .obj or .glb by the path's
    ending; metres.

    surface: what a body gives, without batch axes and with all its vertices; that of ``body.full``
    brings quads (.obj) and texture coordinates (.obj, .glb) along. faces: the triangles, where the
    surface does not carry its own (``body.faces``). Raises HabitusError for another ending, for
    several surfaces at once, and where the file cannot be written.
    """
    target = Path(path)
    content = _CONTENT.get(target.suffix.lower())
    if content is None:
        raise HabitusError(
            f"cannot write a surface to {target.name}: expected a name in {', '.join(_CONTENT)}"
        )
    vertices = to_numpy(surface.vertices).astype(np.float64)
    triangles = getattr(surface, "faces", None) if faces is None else faces
    if triangles is None:
        raise HabitusError(
            "the surface carries no faces; give them, write_surface(surface, path, "
            "faces=body.faces)"
        )
    triangles = to_numpy(triangles).astype(np.int64)
    if vertices.ndim != 2:
        raise HabitusError(
            f"vertices have shape {vertices.shape}; expected (V, 3), one surface: take one of the "
            "batch"
        )
    if triangles.max(initial=-1) >= len(vertices):
        raise HabitusError(
            f"{len(vertices)} vertices, and faces of more; evaluate the body at all its vertices"
        )
    mesh = getattr(surface, "mesh", None) if faces is None else None
    with atomic_write(target) as temporary:
        temporary.write_bytes(content(vertices, triangles, mesh))


def _ply(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + vertices.astype("<f4").tobytes() + rows.tobytes()


def _obj(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    return f"# {len(vertices)} vertices, metres\n{obj_lines(vertices)}{face_lines(faces, mesh)}".encode(  # noqa: E501
        "ascii"
    )


def _glb(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    return b"".join(mesh_document(vertices, faces, mesh).save_to_bytes())


_Content = Callable[[np.ndarray, np.ndarray, BodyMesh | None], bytes]
_CONTENT: Mapping[str, _Content] = {
    ".ply": _ply,
    ".obj": _obj,
    ".glb": _glb,
}
