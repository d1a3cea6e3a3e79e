"""Reads scans: meshes and point clouds (PLY, OBJ, STL, glb, glTF, OFF, XYZ), in the file's own unit
and axes, with the colours that the file has.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, require_extra
from habitus.fit.points.scan import Scan
from habitus.io.archives import reason
from habitus.io.meshes import check_obj, check_ply
from habitus.observe.srgb import linear_from_srgb

SAMPLED = 400_000
"""Places on a mesh at which its picture is looked up: pictures show more than vertices do."""

Coloured = tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]


def part_colours(
    part: object, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], linear: bool
) -> Coloured | None:
    """Places (in the file's unit and axes) and linear colours there, 0 to 1; None where a part has
    none.

    linear: vertices' colours are linear light already, as glTF has them; other files and all
    pictures hold sRGB.
    """
    visual = getattr(part, "visual", None)
    picture = _picture(getattr(visual, "material", None))
    uv = getattr(visual, "uv", None)
    if picture is not None and uv is not None and len(uv) == len(vertices) and len(faces):
        return _from_picture(vertices, faces, np.asarray(uv, dtype=float), picture)
    own = getattr(part, "colors", None)  # of a cloud
    if own is None and getattr(visual, "kind", None) == "vertex":
        own = visual.vertex_colors  # pyright: ignore
    if own is None:  # of a mesh that has a material without a picture
        own = (getattr(visual, "vertex_attributes", None) or {}).get("color")
    if own is None or len(own) != len(vertices) or not len(vertices):
        return None
    values = np.asarray(own)[:, :3]
    values = values / 255.0 if values.dtype.kind in "ui" else values.astype(float)
    return vertices, values if linear else linear_from_srgb(values)


def _picture(material: Any) -> np.ndarray | None:
    """The bytes (H, W, 3) of a material's picture."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    return None if image is None else np.asarray(image.convert("RGB"))


def _from_picture(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, picture: np.ndarray
) -> Coloured:
    """Places evenly all over a mesh, and the pixels that lie there; row 0 of the picture is on
    top.
    """
    corners = vertices[faces]
    rng = np.random.default_rng(0)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    if not area.sum() > 0.0:
        return vertices[:0], vertices[:0]
    face = rng.choice(len(faces), SAMPLED, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), SAMPLED)
    at = np.einsum("nk,nkc->nc", share, uv[faces[face]]) % 1.0
    rows = np.minimum(((1.0 - at[:, 1]) * len(picture)).astype(int), len(picture) - 1)
    columns = np.minimum((at[:, 0] * picture.shape[1]).astype(int), picture.shape[1] - 1)
    return np.einsum("nk,nkc->nc", share, corners[face]), linear_from_srgb(
        picture[rows, columns] / 255.0
    )


ENDINGS = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off", ".xyz")
_CHECKS = {".ply": check_ply, ".obj": check_obj}


def read_scan(path: str | os.PathLike[str]) -> Scan:
    """The points of a scan, its normals where the file has them, its triangles where it is a mesh.

    Raises HabitusError where the file is none of these, or trimesh, which reads it, is not
    installed.
    """
    source = Path(path)
    ending = source.suffix.lower()
    if ending not in ENDINGS:
        raise HabitusError(
            f"{source}: ending {source.suffix!r}; expected a scan ({', '.join(ENDINGS)})"
        )
    trimesh = require_extra("trimesh", "scans", "scans")
    try:
        with source.open("rb") as file:
            check = _CHECKS.get(ending)
            if check is not None:
                check(file, source.stat().st_size)
            what = str(source) if ending in (".gltf", ".obj") else file  # these name other files
            loaded = trimesh.load(what, file_type=ending[1:], process=False)
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(f"{source}: {error.strerror or error}; expected a scan") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected a scan; export it again"
        ) from error
    return _scan(source, loaded)


def scans_in(paths: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The files named, and those in the folders named, in the order of the numbers in their names.

    Raises HabitusError for a folder without scans.
    """
    found = []
    for path in map(Path, paths):
        if not path.is_dir():
            found.append(path)
            continue
        inside = sorted(
            (one for one in path.iterdir() if one.suffix.lower() in ENDINGS), key=_numbered
        )
        if not inside:
            raise HabitusError(f"{path}: no scans in it; expected files in {', '.join(ENDINGS)}")
        found += inside
    return found


def _numbered(path: Path) -> list[tuple[bool, int, str]]:
    """Names with numbers in the order of these: scan2 before scan10."""
    return [
        (bool(word.isdigit()), int(word) if word.isdigit() else 0, word)
        for word in re.split(r"(\d+)", path.name)
    ]


def _scan(source: Path, loaded: object) -> Scan:
    """What trimesh has read: a mesh, a cloud, or a scene of such."""
    parts = loaded.dump() if hasattr(loaded, "dump") and hasattr(loaded, "geometry") else [loaded]  # pyright: ignore
    points = []
    faces = []
    normals = []
    colours = []
    count = 0
    for part in parts:
        vertices = np.asarray(getattr(part, "vertices", np.zeros((0, 3))), dtype=float).reshape(
            -1, 3
        )
        triangles = np.asarray(getattr(part, "faces", np.zeros((0, 3))), dtype=np.int64).reshape(
            -1, 3
        )
        points.append(vertices)
        faces.append(triangles + count)
        normals.append(_own_normals(part, len(vertices)))
        first = getattr(loaded, "geometry", {}).get(
            (getattr(part, "metadata", None) or {}).get("name"), part
        )
        colours.append(
            part_colours(first, vertices, triangles, source.suffix.lower() in (".glb", ".gltf"))
        )
        count += len(vertices)
    if not count:
        raise HabitusError(f"{source}: holds no points; expected a scan")
    triangles = np.concatenate(faces)
    told = None if any(one is None for one in normals) else np.concatenate(normals)  # pyright: ignore
    scan = Scan(source.stem, np.concatenate(points), told, triangles if len(triangles) else None)
    known = [one for one in colours if one is not None]
    if not known:
        return scan
    places, seen = (np.concatenate(each) for each in zip(*known, strict=True))
    return replace(scan, colours=seen, colour_places=places)


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
