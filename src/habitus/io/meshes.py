"""Reads meshes: PLY and OBJ, vertices and triangles in the file's own order."""

import io
import logging
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float, Int

from habitus.errors import HabitusError, shown
from habitus.io.archives import reason
from habitus.io.limits import check_present, open_file

ENDINGS = (".ply", ".obj")
_MAX_HEADER = 1 << 16
_MAX_LINES = 300


def load_trimesh() -> Any:
    """trimesh, whose notes on damaged files are not shown: a logger without a handler prints."""
    import trimesh

    logger = logging.getLogger("trimesh")
    if not logger.handlers:
        logger.addHandler(logging.NullHandler())
    return trimesh


def read_mesh(path: str | Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """The vertices, in the file's unit, and triangles of a PLY or OBJ file, none merged, none
    reordered.

    Polygons are cut into triangles, always alike. Raises HabitusError where the file is no such
    mesh.
    """
    source = Path(path)
    if source.suffix.lower() not in ENDINGS:
        raise HabitusError(
            f"{source}: ending {source.suffix!r}; expected a mesh ({' or '.join(ENDINGS)})"
        )
    trimesh = load_trimesh()
    try:
        with open_file(source) as file:
            if source.suffix.lower() == ".ply":
                check_ply(file, source.stat().st_size)
                content = io.BytesIO(file.read())
            else:
                check_obj(file, source.stat().st_size)
                content = io.StringIO(_geometry(file.read().decode("utf-8-sig", "replace")))
            mesh = trimesh.load(
                content,
                file_type=source.suffix[1:].lower(),
                force="mesh",
                process=False,
                maintain_order=True,
                skip_materials=True,
            )
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(f"{source}: {error.strerror or error}; expected a mesh") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(
            f"{source}: cannot be read ({reason(error)}); expected a mesh; export it again"
        ) from error
    vertices = _numbers(mesh, "vertices")
    faces = _numbers(mesh, "faces")
    if (
        vertices.ndim != 2
        or vertices.shape[1] != 3
        or faces.ndim != 2
        or faces.shape[1] != 3
        or not len(faces)
    ):
        raise HabitusError(
            f"{source}: holds {len(vertices)} points and {len(faces)} faces; expected a mesh of "
            "triangles"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise HabitusError(
            f"{source}: its faces name vertices up to {faces.max()} of {len(vertices)}; export it "
            "again"
        )
    if not np.isfinite(vertices[faces]).all():
        raise HabitusError(f"{source}: vertices of its faces are no numbers; export it again")
    return np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)


def _geometry(obj: str) -> str:
    """An OBJ's vertices and faces alone: for texture coordinates trimesh would ask for Pillow."""
    lines = obj.replace("\r\n", "\n").replace("\\\n", " ").splitlines()
    words = ((line, line.split(maxsplit=1)[:1]) for line in lines)
    kept = (
        re.sub(r"/\S*", "", line) if word == ["f"] else line
        for line, word in words
        if word in (["v"], ["f"])
    )
    return "\n".join(kept) + "\n"


def _numbers(mesh: object, key: str) -> np.ndarray:
    array = np.asarray(getattr(mesh, key, ()))
    return array if array.dtype.kind in "fiu" else np.zeros(0)


def check_obj(file: BinaryIO, size: int) -> None:
    """An OBJ's faces name vertices by their numbers, and each vertex has a line in the file."""
    text = file.read().replace(b"\r\n", b"\n").replace(b"\\\n", b"")
    file.seek(0)
    number = re.search(rb"(?m)^[^\S\n]*f[^\n]*?([0-9]{%d,})" % (len(str(size)) + 1), text)
    if number:
        raise HabitusError(
            f"a face names vertex {shown(number[1].decode())} of a file of {size} bytes; export it "
            "again"
        )


def check_ply(file: BinaryIO, size: int) -> None:
    """A PLY's header counts elements, each of which takes a byte at least, and lists few
    properties.
    """
    header = file.read(_MAX_HEADER).partition(b"end_header")[0]
    file.seek(0)
    if header.count(b"\n") > _MAX_LINES:
        raise HabitusError(f"a header of {header.count(10)} lines; expected at most {_MAX_LINES}")
    for line in header.splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            count = (
                int(words[2])
                if len(words) == 3 and words[2].isdigit() and len(words[2]) < 20
                else -1
            )
            check_present(count, size, "its number of elements")
