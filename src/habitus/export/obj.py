"""One Wavefront .obj file a frame, for tools that know nothing else."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.skin import skin_of
from habitus.body.surface_files import face_lines, obj_lines
from habitus.export.skins import write_material
from habitus.files import atomic_write
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving


def write_obj_sequence(
    fit: "Moving",
    folder: str | os.PathLike[str],
    frames: Iterable[int] | None = None,
    *,
    y_up: bool = False,
    skin: str | float | None = None,
) -> list[Path]:
    """Write the fitted surface of ``frames`` (default: all) as ``<capture>_<frame>.obj`` and return
    the paths.

    Metres; the capture's own world frame, or turned so that +y is up with ``y_up``. The vertex
    order never changes: it is that of the body's full level of detail where it has one, with its
    quads and texture coordinates. ``skin``: as for `habitus.export.glb.write_glb`; ``skin.mtl`` and
    ``skin_skin.png`` lie beside the meshes. Each file is written whole or not at all. Raises
    HabitusError where the folder cannot be written to.
    """
    chosen = range(len(fit.pose)) if frames is None else list(frames)
    turn = up_rotation(fit.up_axis) if y_up else np.eye(3)
    body = fit.finest_body
    found = skin_of(body.mesh, skin)
    uses = "" if found is None else write_material(Path(folder) / "skin.obj", found)
    faces = face_lines(body.faces, body.mesh if found is None else found.mesh)
    written = []
    for frame, vertices in zip(chosen, fitted_vertices(fit, chosen, body=body), strict=True):
        path = Path(folder) / f"{Path(fit.capture_name).name}_{frame:06d}.obj"
        with atomic_write(path) as temporary:
            temporary.write_text(
                f"# {len(vertices)} vertices, metres\n{uses}{obj_lines(vertices @ turn.T)}{faces}",
                "ascii",
            )
        written.append(path)
    return written


def fitted_vertices(
    fit: "Moving",
    frames: Iterable[int],
    vertices: np.ndarray | None = None,
    body: BodyModel | None = None,
) -> Iterator[np.ndarray]:
    """Yield the fitted surface (V, 3), or some vertices, of each frame: metres, capture world, with
    soft tissue.

    ``body`` stands in for the fitted one: its full level of detail.
    """
    for surface in fit.surfaces(np.asarray(list(frames), dtype=np.int64), vertices, body):
        yield from surface.vertices
