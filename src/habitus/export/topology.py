"""A body in motion as vertices of another topology: SMPL's, SMPL-X's or MHR's.

The mesh is our surface, sampled at the places that `habitus.mesh.surface_map` names: nobody's shape
space and nobody's licence but that of the mesh's triangles (assets/topologies/LICENSE).
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from habitus.body.surface_files import write_surface
from habitus.errors import HabitusError
from habitus.export.npz import write_arrays
from habitus.mesh.surface_map import SurfaceMap
from habitus.parallel.blocks import mapped
from habitus.rotations import up_rotation

if TYPE_CHECKING:
    from habitus.body.motion import Moving

ENDINGS = (".npz", ".obj", ".ply", "")


class _Surface(NamedTuple):
    vertices: Float[np.ndarray, "N 3"]


def check_topology_path(path: Path) -> None:
    """Raises HabitusError for an ending that no foreign vertices are written to."""
    if path.suffix.lower() not in ENDINGS:
        raise HabitusError(
            f"cannot write a topology to {path.name}: expected .npz (all frames), .obj or .ply "
            "(one), or a name without an ending (a folder with an OBJ a frame)"
        )


def topology_vertices(
    moving: "Moving", places: SurfaceMap, frames: Int[np.ndarray, " T"]
) -> Float[np.ndarray, "T N 3"]:
    """The vertices (m) of some frames, in the motion's own world, soft tissue included."""
    used, inverse = np.unique(places.corners, return_inverse=True)
    corners = inverse.reshape(-1, 3)
    return np.concatenate(
        [
            np.einsum("tnkc,nk->tnc", part.vertices[:, corners], places.barycentric)
            for part in moving.surfaces(frames, used, moving.finest_body)
        ]
    )


def write_topology(
    moving: "Moving", path: Path, places: SurfaceMap, frame: int | None = None
) -> int:
    """Write vertices in another topology, atomically; the number of frames written.

    .npz: ``vertices`` (T, N, 3; m, the motion's world, float32), ``faces`` (F, 3), ``rate_hz``,
    ``up_axis`` and ``topology``; with ``frame`` that one alone. .obj, .ply: one mesh, +y up, of
    ``frame`` or at rest. Without an ending: a folder with an OBJ a frame, +y up. Raises
    HabitusError for other endings, a frame that is none, and where nothing can be written.
    """
    check_topology_path(path)
    if frame is not None and not 0 <= frame < moving.num_frames:
        raise HabitusError(f"frame is {frame}; expected 0 to {moving.num_frames - 1}")
    ending = path.suffix.lower()
    rows = np.arange(moving.num_frames) if frame is None else np.array([frame])
    if ending == ".npz":
        return _archive(moving, path, places, rows)
    turn = up_rotation(moving.up_axis).T
    if ending and frame is None:
        rest = places.vertices(moving.finest_body.rest_vertices(moving.betas))
        write_surface(_Surface(rest), path, places.faces)
        return 1
    for row in rows:
        at = path if ending else path / f"{Path(moving.capture_name).name}_{row:06d}.obj"
        vertices = topology_vertices(moving, places, np.array([row]))[0] @ turn
        write_surface(_Surface(vertices), at, places.faces)
    return len(rows)


def _archive(moving: "Moving", path: Path, places: SurfaceMap, rows: np.ndarray) -> int:
    vertices = mapped(lambda some: topology_vertices(moving, places, some).astype(np.float32), rows)
    arrays = {
        "vertices": vertices,
        "faces": places.faces.astype(np.int32),
        "rate_hz": np.array(float(moving.rate_hz)),
        "up_axis": np.array(str(moving.up_axis)),
        "topology": np.array(places.name),
        "capture": np.array(str(moving.capture_name)),
    }
    write_arrays(path, arrays)
    return len(rows)
