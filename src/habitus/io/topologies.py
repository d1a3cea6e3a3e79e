"""Other bodies' topologies: the maps that habitus brings along, and files of their vertices.

A map (assets/topologies/NAME.npz) says where each vertex of SMPL's mesh (6,890), SMPL-X's
(10,475) or MHR's (18,439) lies on the full detail of the bundled bodies. Licences:
assets/topologies/LICENSE.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.io.archives import open_archive, reason
from habitus.io.meshes import ENDINGS as MESHES
from habitus.io.meshes import read_mesh
from habitus.mesh.surface_map import SurfaceMap
from habitus.types import PathLike

TOPOLOGIES = ("smpl", "smplx", "mhr")
FOLDER = Path(__file__).resolve().parents[1] / "assets" / "topologies"
_LARGEST = {"m": 5.0, "cm": 500.0, "mm": np.inf}
"""Extents (of any person, in any pose) up to which numbers are taken for each unit."""
_PEOPLE = (0.2, 5.0)
"""Metres from end to end of a person in any pose."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}


@dataclass(frozen=True, eq=False)
class ForeignVertices:
    """Vertices (T, N, 3) of one person in T frames, in metres; frames a second and the axis that
    points up, where the file says so.
    """

    name: str
    vertices: Float[np.ndarray, "T N 3"]
    rate_hz: float | None = None
    up_axis: str | None = None


def map_arrays(made: SurfaceMap) -> dict[str, np.ndarray]:
    """The named arrays of a map's file: triangles, two of three barycentric coordinates in 65,535
    steps, and the mesh's own faces as differences, which pack well.
    """
    rounded = np.floor(made.barycentric[:, 1:] * 65535.0)  # so that the third is not negative
    return {
        "face": made.face.astype(np.uint16),
        "barycentric": rounded.astype(np.uint16),
        "matched": np.packbits(made.matched),
        "faces": np.diff(made.faces.ravel(), prepend=0).astype(np.int16),
        "vertices": np.array([made.num_vertices, made.surface_vertices]),
    }


@cache
def _arrays(name: str) -> dict[str, np.ndarray]:
    with np.load(FOLDER / f"{name}.npz", allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def load_topology(name: str, body: BodyModel) -> SurfaceMap:
    """The map "smpl", "smplx" or "mhr" on a body of the full detail (``BodyModel.full``).

    Raises HabitusError for another name, or where the body has not the bundled bodies' topology.
    """
    if name not in TOPOLOGIES:
        raise HabitusError(f"topology is {name!r}; expected one of {', '.join(TOPOLOGIES)}")
    arrays = _arrays(name)
    count, surface = (int(number) for number in arrays["vertices"])
    face = arrays["face"].astype(np.int64)
    if body.num_vertices != surface or face.max() >= body.num_faces:
        raise HabitusError(
            f"{body.name} has {body.num_vertices} vertices at its full detail; topologies are "
            f"mapped on the bundled bodies' {surface}: neutral, female or male"
        )
    share = arrays["barycentric"].astype(np.float64) / 65535.0
    share = np.concatenate([1.0 - share.sum(1, keepdims=True), share], 1)
    matched = np.unpackbits(arrays["matched"], count=count).astype(bool)
    faces = np.cumsum(arrays["faces"].astype(np.int64)).reshape(-1, 3)
    return SurfaceMap(name, face, body.faces[face], share, matched, faces, surface)


def topology_of(vertices: int) -> str:
    """The name of the topology with so many vertices. Raises HabitusError where there is none."""
    counts = {int(_arrays(name)["vertices"][0]): name for name in TOPOLOGIES}
    if vertices not in counts:
        listed = ", ".join(f"{count} ({name})" for count, name in counts.items())
        raise HabitusError(f"{vertices} vertices; expected {listed}")
    return counts[vertices]


def read_vertices(path: PathLike, count: int, unit: str = "auto") -> ForeignVertices:
    """The vertices of a mesh (.obj, .ply) or an npz with ``vertices`` (T, N, 3) or (N, 3), in the
    mesh's own order. unit: "m", "cm", "mm", "in", "ft", or "auto", by the size of a person.

    Raises HabitusError, with the file named, for another number of vertices or none at all.
    """
    source = Path(path)
    rate = up = None
    if source.suffix.lower() in MESHES:
        found = read_mesh(source)[0][None]
    elif source.suffix.lower() == ".npz":
        found, rate, up = _archived(source)
    else:
        raise HabitusError(f"{source}: expected vertices in a mesh (.obj, .ply) or an .npz")
    if found.ndim != 3 or found.shape[1:] != (count, 3) or not len(found):
        raise HabitusError(
            f"{source}: vertices of shape {found.shape}; expected {count} of each frame: choose "
            "the topology that the file has"
        )
    if not np.isfinite(found).all():
        raise HabitusError(f"{source}: vertices that are no finite numbers; export it again")
    largest = float(np.ptp(found, axis=1).max())
    if unit == "auto":
        unit = next(name for name, most in _LARGEST.items() if largest <= most)
    if not _PEOPLE[0] <= largest * UNITS[unit] <= _PEOPLE[1]:
        raise HabitusError(
            f"{source}: {largest:.3g} {unit} across; expected a person's {_PEOPLE[0]} to "
            f"{_PEOPLE[1]} metres: give the unit"
        )
    return ForeignVertices(source.stem, found * UNITS[unit], rate, up)


def _archived(source: Path) -> tuple[np.ndarray, float | None, str | None]:
    try:
        with open_archive(source) as archive:
            vertices = np.asarray(archive.read("vertices"))
            rate = archive.read("rate_hz") if "rate_hz" in archive else None
            up = archive.read("up_axis") if "up_axis" in archive else None
    except (OSError, KeyError, HabitusError) as error:
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected an npz with vertices (T, N, 3)"
        ) from error
    if vertices.dtype.kind not in "fiu" or vertices.ndim not in (2, 3) or not vertices.size:
        raise HabitusError(
            f"{source}: vertices are {vertices.dtype} of shape {vertices.shape}; expected numbers "
            "(T, N, 3)"
        )
    hertz = float(rate) if rate is not None and rate.shape == () and rate.dtype.kind in "fiu" else 0
    sound = 0.0 < hertz < 1e5
    words = str(up) if up is not None and up.shape == () else None
    vertices = vertices.astype(np.float64).reshape(-1, *vertices.shape[-2:])
    return vertices, (hertz if sound else None), words
