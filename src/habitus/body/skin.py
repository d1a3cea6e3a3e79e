"""Skin of the default bodies: a texture painted from masks of regions, of any tone.

The masks lie in ``assets/skin.npz`` (``habitus_lab.default_body.skin`` makes them): lips, nails,
areolae, ears, palms and soles, brows, rims of lids, eyeballs, creases, and where skin is redder.
Painting is arithmetic on them, without random numbers: the same tone and size give the same
picture. It is a drawing, not a photograph: its tones are chosen, not measured.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from habitus.body.body_arrays import BodyMesh
from habitus.errors import HabitusError

MASKS = Path(str(files("habitus.assets"))) / "skin.npz"
TONES: Mapping[str, float] = MappingProxyType({"light": 0.12, "medium": 0.5, "dark": 0.85})
"""Names of tones between 0, the lightest, and 1, the darkest."""
NONE = "none"
SIZES = (64, 4096)
LEVELS = 63
"""Of a mask."""
BLOTCHES = 0.09
"""How much brightness varies over skin."""
_KNOTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_COLOURS: Mapping[str, tuple[tuple[int, int, int], ...]] = MappingProxyType(
    {
        "skin": ((238, 202, 180), (219, 173, 145), (184, 132, 100), (128, 85, 61), (74, 48, 38)),
        "red": ((228, 158, 142), (206, 132, 110), (165, 100, 78), (108, 65, 49), (58, 34, 28)),
        "crease": ((196, 138, 116), (174, 114, 90), (138, 86, 62), (88, 53, 38), (44, 27, 22)),
        "pale": (
            (238, 200, 182),
            (226, 180, 154),
            (208, 160, 132),
            (178, 130, 106),
            (148, 106, 90),
        ),
        "lips": ((208, 142, 132), (190, 120, 106), (156, 94, 80), (114, 68, 60), (80, 46, 43)),
        "areolae": ((206, 146, 130), (172, 108, 88), (124, 76, 58), (78, 48, 38), (44, 28, 24)),
        "nails": (
            (240, 206, 194),
            (228, 188, 172),
            (210, 164, 144),
            (172, 126, 108),
            (134, 96, 82),
        ),
        "brows": ((112, 80, 58), (78, 54, 40), (48, 34, 28), (32, 24, 22), (22, 17, 16)),
        "rims": ((128, 84, 74), (98, 64, 54), (66, 44, 38), (42, 29, 26), (26, 19, 18)),
        "iris": ((104, 130, 140), (104, 104, 78), (92, 62, 38), (64, 42, 28), (46, 30, 22)),
        "mouth": ((140, 66, 64), (134, 62, 60), (122, 56, 54), (106, 50, 48), (88, 42, 42)),
    }
)
"""sRGB of each region at five tones."""
_LAYERS = (
    ("red", "red", 0.75),
    ("ears", "red", 0.4),
    ("palms", "pale", 0.9),
    ("eyelids", "crease", 0.25),
    ("creases", "crease", 0.6),
    ("areolae", "areolae", 0.9),
    ("lips", "lips", 0.8),
    ("nails", "nails", 0.8),
    ("mouth", "mouth", 1.0),
    ("brows", "brows", 0.85),
    ("rims", "rims", 0.75),
)
"""Masks in the order in which they are painted, their colour and how much they cover."""
_SCLERA, _SCLERA_RED, _PUPIL = (222, 216, 210), (208, 172, 162), (14, 11, 10)
_PUPIL_EDGE, _IRIS_EDGE = 8.0, 22.0
"""Degrees from the gaze at the eyeball's centre."""


@dataclass(frozen=True, eq=False)
class Skin:
    """A texture in sRGB, row 0 on top, and the mesh whose ``uv`` it is for: the body's own, with
    larger eyeballs in the layout.
    """

    image: UInt8[np.ndarray, "N N 3"]
    mesh: BodyMesh


def skin_tone(skin: str | float | None) -> float | None:
    """A tone between 0 (light) and 1 (dark) of a name, a number or its text; None for "none".

    Raises HabitusError for anything else.
    """
    if skin is None or skin == NONE:
        return None
    try:
        tone = TONES[skin] if skin in TONES else float(skin)
    except (TypeError, ValueError):
        tone = np.nan
    if not 0 <= tone <= 1:
        raise HabitusError(
            f"skin is {skin!r}; expected {', '.join(TONES)}, {NONE}, or a number from 0 (light) to "
            "1 (dark)"
        )
    return float(tone)


def skin_mesh(mesh: BodyMesh | None) -> BodyMesh | None:
    """The mesh in the skin's layout; None where its texture coordinates are not the default
    body's.
    """
    if mesh is None or layout_checksum(mesh) != int(_arrays()["layout"]):
        return None
    uv = np.array(mesh.uv)
    uv[_arrays()["uv_rows"]] = _arrays()["uv_places"]
    return replace(mesh, uv=uv)


def skin_of(mesh: BodyMesh | None, skin: str | float | None, size: int = 1024) -> Skin | None:
    """The skin of a default body's mesh; None for "none" and for bodies that have no such layout.

    skin: as `skin_tone` reads it. size: pixels of the texture's sides. Raises HabitusError for
    other values of either.
    """
    tone = skin_tone(skin)
    if tone is None:
        return None
    own = skin_mesh(mesh)
    return None if own is None else Skin(paint_skin(tone, size), own)


def layout_checksum(mesh: BodyMesh) -> int:
    """A number that tells layouts of textures apart."""
    uv = np.ascontiguousarray(mesh.uv, "<f4")
    return zlib.crc32(np.ascontiguousarray(mesh.quad_uv, "<i4"), zlib.crc32(uv))


def paint_skin(tone: float, size: int = 1024) -> UInt8[np.ndarray, "N N 3"]:
    """The texture of a tone between 0 (light) and 1 (dark): sRGB, row 0 on top.

    size: its height and width in pixels, 64 to 4096. Masks have 1,024 pixels a side, and larger
    textures are smoother, not richer. Raises HabitusError for a tone or size out of range.
    """
    if not 0 <= tone <= 1:
        raise HabitusError(f"tone is {tone}; expected a number from 0 (light) to 1 (dark)")
    if not SIZES[0] <= size <= SIZES[1]:
        raise HabitusError(f"size is {size} pixels; expected {SIZES[0]} to {SIZES[1]}")
    masks = _Masks(size)
    colours = {name: _at_tone(rows, tone) for name, rows in _COLOURS.items()}
    image = np.broadcast_to(colours["skin"], (size, size, 3)).astype(np.float32)
    image *= 1 + np.float32(BLOTCHES) * (masks["blotches"][:, :, None] - np.float32(0.5))
    for mask, colour, cover in _LAYERS:
        _mix(image, colours[colour], cover * masks[mask])
    _paint_eyes(image, masks, colours["iris"])
    image[~masks.painted] = colours["skin"]
    return np.round(image).clip(0, 255).astype(np.uint8)


def vertex_colours(
    image: UInt8[np.ndarray, "N N 3"], mesh: BodyMesh, count: int
) -> UInt8[np.ndarray, "V 3"]:
    """The texture's colours at ``count`` vertices of a mesh, sRGB: means over a vertex' places in
    the layout.
    """
    size = len(image)
    column, row = (mesh.uv * [size, -size] + [0, size]).astype(int).clip(0, size - 1).T
    corners, places = mesh.quads.ravel(), mesh.quad_uv.ravel()
    seen = image[row, column].astype(np.float64)[places]
    number = np.bincount(corners, minlength=count).clip(1)
    sums = [np.bincount(corners, seen[:, channel], count) for channel in range(3)]
    return np.round(np.stack(sums, axis=1) / number[:, None]).astype(np.uint8)


def _at_tone(rows: tuple[tuple[int, int, int], ...], tone: float) -> Float[np.ndarray, "3"]:
    table = np.array(rows, np.float64)
    return np.array([np.interp(tone, _KNOTS, column) for column in table.T])


def _mix(image: np.ndarray, colour: Any, cover: np.ndarray) -> None:
    """Paint a colour over an image, in place."""
    at = np.nonzero(cover)
    image[at] += cover[at][:, None] * (np.asarray(colour, np.float32) - image[at])


def _paint_eyes(image: np.ndarray, masks: "_Masks", iris: np.ndarray) -> None:
    angle, eyes = 90 * masks["gaze"], masks["eyes"]
    soft = 90.0 / len(image) * 8  # degrees that edges take
    _mix(image, _SCLERA, eyes)
    _mix(image, _SCLERA_RED, eyes * ((angle - 35) / 45).clip(0, 1))
    within = ((_IRIS_EDGE - angle) / soft + 0.5).clip(0, 1) * eyes
    ring = ((angle - _PUPIL_EDGE) / (_IRIS_EDGE - _PUPIL_EDGE)).clip(0, 1)
    _mix(image, iris, within)
    _mix(image, 0.4 * iris, within * ring**4)
    _mix(image, _PUPIL, ((_PUPIL_EDGE - angle) / soft + 0.5).clip(0, 1) * eyes)


@cache
def _arrays() -> Mapping[str, np.ndarray]:
    with np.load(MASKS) as stored:
        return MappingProxyType({name: stored[name] for name in stored.files})


class _Masks:
    """Masks between 0 and 1 at a size."""

    def __init__(self, size: int) -> None:
        self.size = size
        painted = np.unpackbits(_arrays()["painted"], axis=1).astype(np.float32)
        self.painted = resized(painted, size) > 0

    def __getitem__(self, name: str) -> Float[np.ndarray, "N N"]:
        return resized(_arrays()[f"mask_{name}"].astype(np.float32) / LEVELS, self.size)


def resized(image: Float[np.ndarray, "n n"], size: int) -> Float[np.ndarray, "N N"]:
    """A square image at another size: means where it shrinks by whole steps, else bilinear."""
    length = len(image)
    if length == size:
        return image
    if length > size and length % size == 0:
        step = length // size
        return image.reshape(size, step, size, step).mean(axis=(1, 3))
    at = ((np.arange(size, dtype=np.float32) + 0.5) * (length / size) - 0.5).clip(0, length - 1)
    low = np.minimum(at.astype(int), length - 2)
    share = at - low
    rows = image[low] * (1 - share)[:, None] + image[low + 1] * share[:, None]
    return rows[:, low] * (1 - share) + rows[:, low + 1] * share
