"""Reads scans: meshes and clouds of points (PLY, OBJ, STL, glb, glTF, OFF, XYZ), in the file's own
unit and axes.
"""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus.errors import HabitusError, require_extra
from habitus.fit.points.scan import Scan
from habitus.io.archives import reason
from habitus.io.meshes import check_obj, check_ply
from habitus.io.scan_colours import part_colours

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
