"""Reads scans: meshes and point clouds (PLY, OBJ, STL, glb, glTF, OFF, XYZ), in the file's own unit
and axes, with the colours that the file has.
"""

import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError
from habitus.fit.points.scan import Scan
from habitus.io.archives import reason
from habitus.io.gltf_claims import check_gltf
from habitus.io.limits import MAX_IMAGE_BYTES, Allowance, open_file
from habitus.io.meshes import check_obj, check_ply, load_trimesh
from habitus.io.names import numeric_order
from habitus.observe.light import linear_from_srgb

SAMPLED = 400_000
"""Places on a scan at which its pictures are looked up: pictures show more than vertices do."""
MAX_COORDINATE = 1e9
"""In the file's unit: a person in micrometres has two million."""

Coloured = tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]


def part_colours(
    part: object,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    linear: bool,
    samples: int = SAMPLED,
) -> Coloured | None:
    """Places (in the file's unit and axes) and linear colours there, 0 to 1; None where a part has
    none.

    linear: vertices' colours are linear light already, as glTF has them; other files and all
    pictures hold sRGB. samples: how many places of a picture.
    """
    visual = getattr(part, "visual", None)
    picture = _picture(getattr(visual, "material", None))
    uv = getattr(visual, "uv", None)
    if picture is not None and uv is not None and len(uv) == len(vertices) and len(faces):
        return _from_picture(vertices, faces, np.asarray(uv, dtype=float), picture, samples)
    own = getattr(part, "colors", None)  # of a cloud
    if own is None and getattr(visual, "kind", None) == "vertex":
        own = visual.vertex_colors  # pyright: ignore
    if own is None:  # of a mesh that has a material without a picture
        own = (getattr(visual, "vertex_attributes", None) or {}).get("color")
    values = np.asarray([] if own is None else own)
    if values.ndim != 2 or len(values) != len(vertices) or values.shape[1] < 3 or not len(values):
        return None
    values = values[:, :3]
    values = values / 255.0 if values.dtype.kind in "ui" else values.astype(float)
    known = np.isfinite(values).all(axis=1)
    if not known.all():
        vertices, values = vertices[known], values[known]
    return vertices, values if linear else linear_from_srgb(values)


def _picture(material: Any) -> np.ndarray | None:
    """The bytes (H, W, 3) of a material's picture."""
    image = _image(material)
    return None if image is None else np.asarray(image.convert("RGB"))


def _image(material: Any) -> Any:
    return getattr(material, "baseColorTexture", None) or getattr(material, "image", None)


def _from_picture(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: np.ndarray, samples: int
) -> Coloured:
    """Places evenly all over a mesh, and the pixels that lie there; row 0 of the picture is on
    top.
    """
    corners = vertices[faces]
    rng = np.random.default_rng(0)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    if not (area.sum() > 0.0 and np.isfinite(uv).all() and picture.size):
        return vertices[:0], vertices[:0]
    face = rng.choice(len(faces), samples, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), samples)
    at = np.einsum("nk,nkc->nc", share, uv[faces[face]]) % 1.0
    rows = np.minimum(((1.0 - at[:, 1]) * len(picture)).astype(int), len(picture) - 1)
    columns = np.minimum((at[:, 0] * picture.shape[1]).astype(int), picture.shape[1] - 1)
    return np.einsum("nk,nkc->nc", share, corners[face]), linear_from_srgb(
        picture[rows, columns] / 255.0
    )


ENDINGS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off", ".xyz")


def read_scan(path: str | os.PathLike[str]) -> Scan:
    """The points of a scan, its normals where the file has them, its triangles where it is a mesh.

    Raises HabitusError where the file is none of these.
    """
    source = Path(path)
    ending = source.suffix.lower()
    if ending not in ENDINGS:
        raise HabitusError(
            f"{source}: ending {source.suffix!r}; expected a scan ({', '.join(ENDINGS)})"
        )
    try:
        loaded = _loaded(source, ending)
        _check_pictures(loaded, source.stat().st_size)
        return _scan(source, loaded)
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(f"{source}: {error.strerror or error}; expected a scan") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected a scan; export it again"
        ) from error


def _loaded(source: Path, ending: str) -> Any:
    """What trimesh reads, after what the file claims has been held against its size."""
    trimesh = load_trimesh()
    if ending in (".glb", ".gltf"):
        check_gltf(source)
    if ending == ".gltf":  # it names other files
        return trimesh.load(str(source), file_type=ending[1:], process=False)
    with open_file(source) as file:
        if ending == ".ply":
            check_ply(file, source.stat().st_size)
        if ending != ".obj":
            # from memory: trimesh asks for as many bytes as a chunk's header claims
            return trimesh.load(io.BytesIO(file.read()), file_type=ending[1:], process=False)
        check_obj(file, source.stat().st_size)
        text = io.StringIO(file.read().decode("utf-8-sig", "replace"))
    resolver = trimesh.resolvers.FilePathResolver(str(source))
    return trimesh.load(text, file_type="obj", resolver=resolver, process=False)


def _check_pictures(loaded: Any, stored: int) -> None:
    """Raise HabitusError, before a picture is decoded, where all would fill more than they may.

    Pictures of an OBJ lie in files of their own; each may be as large as ten scans.
    """
    allowance = Allowance(stored, MAX_IMAGE_BYTES)
    parts = loaded.geometry.values() if hasattr(loaded, "geometry") else [loaded]
    images = {
        id(image): image
        for part in parts
        if (image := _image(getattr(getattr(part, "visual", None), "material", None))) is not None
    }
    for image in images.values():
        allowance.take_bytes(4 * image.width * image.height, "its pictures, unpacked,")


def scans_in(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The files named, and those in the folders named, in the order of the numbers in their names.

    Raises HabitusError for a folder without scans.
    """
    scans = []
    for path in map(Path, paths):
        if not path.is_dir():
            scans.append(path)
            continue
        inside = sorted(
            (one for one in path.iterdir() if one.suffix.lower() in ENDINGS),
            key=lambda one: numeric_order(one.name),
        )
        if not inside:
            raise HabitusError(f"{path}: no scans in it; expected files in {', '.join(ENDINGS)}")
        scans += inside
    return scans


def _scan(source: Path, loaded: Any) -> Scan:
    """What trimesh has read: a mesh, a cloud, or a scene of such."""
    linear = source.suffix.lower() in (".glb", ".gltf")
    placed = list(_parts(loaded))
    samples = max(1000, SAMPLED // max(1, len(placed)))
    points = []
    faces = []
    normals = []
    colours = []
    count = 0
    for part, vertices, triangles in placed:
        points.append(vertices)
        faces.append(triangles + count)
        normals.append(_own_normals(part, len(vertices)))
        colours.append(part_colours(part, vertices, triangles, linear, samples))
        count += len(vertices)
    if not count:
        raise HabitusError("holds no points; expected a scan")
    triangles = np.concatenate(faces)
    own_normals = None if any(one is None for one in normals) else np.concatenate(normals)  # pyright: ignore
    points = np.concatenate(points)
    known = np.all(np.abs(points) <= MAX_COORDINATE, axis=1)
    if own_normals is not None:
        known &= np.all(np.isfinite(own_normals), axis=1)
    if not known.any() or not known[triangles].all():
        raise HabitusError("vertices that are no numbers, or huge ones; export it again")
    if not known.all():  # depth cameras' programs write NaN for pixels without depth
        points = points[known]
        own_normals = None if own_normals is None else own_normals[known]
        triangles = (np.cumsum(known) - 1)[triangles]
    scan = Scan(source.stem, points, own_normals, triangles if len(triangles) else None)
    coloured = [one for one in colours if one is not None]
    if not coloured:
        return scan
    places, seen = (np.concatenate(each) for each in zip(*coloured, strict=True))
    finite = np.isfinite(places).all(axis=1)
    return replace(scan, colours=seen[finite], colour_places=places[finite])


def _parts(loaded: Any) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
    """Each part of a scene with its vertices (V, 3), at its place, and its triangles (F, 3).

    Raises HabitusError for vertices that have not three coordinates, and for triangles of vertices
    that are not there.
    """
    from trimesh.transformations import flips_winding, transform_points

    if not hasattr(loaded, "graph"):
        yield loaded, *_arrays(loaded)
        return
    for node in loaded.graph.nodes_geometry:
        matrix, name = loaded.graph[node]
        vertices, triangles = _arrays(loaded.geometry[name])
        if not np.allclose(matrix, np.eye(4), rtol=0.0, atol=1e-8):
            vertices = transform_points(vertices, matrix=matrix)
            turned = not np.allclose(matrix[:3, :3], np.eye(3), rtol=0.0, atol=1e-6)
            triangles = triangles[:, ::-1] if turned and flips_winding(matrix) else triangles
        yield loaded.geometry[name], vertices, triangles


def _arrays(part: Any) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    vertices = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), dtype=float)
    triangles = np.asarray(getattr(part, "faces", np.zeros((0, 3))), dtype=np.int64)
    vertices, triangles = (
        one if one.size else np.zeros((0, 3), one.dtype) for one in (vertices, triangles)
    )
    if vertices.ndim != 2 or vertices.shape[1] != 3 or triangles.shape[1:] != (3,):
        raise HabitusError(
            f"has points of shape {vertices.shape} and faces of {triangles.shape}; expected three "
            "coordinates and three corners"
        )
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise HabitusError(
            f"its faces name vertices {triangles.min()} to {triangles.max()} of {len(vertices)}; "
            "export it again"
        )
    return vertices, triangles


def _own_normals(part: object, count: int) -> np.ndarray | None:
    """Normals that a cloud's file holds; those of meshes are computed."""
    metadata = getattr(part, "metadata", None) or {}
    raw = (
        metadata.get("_ply_raw", metadata.get("ply_raw", {})) if isinstance(metadata, dict) else {}
    )
    data = raw.get("vertex", {}).get("data") if isinstance(raw, dict) else None
    names = getattr(getattr(data, "dtype", None), "names", None) or ()
    if not {"nx", "ny", "nz"} <= set(names) or len(data) != count:  # pyright: ignore
        return None
    return np.stack([np.asarray(data[axis], dtype=float) for axis in ("nx", "ny", "nz")], 1)  # pyright: ignore
