"""Skin of the default bodies: a texture painted from masks of regions, of any tone.

The masks lie in ``assets/skin.npz`` (``habitus_lab.default_body.skin`` makes them): lips, nails,
areolae, ears, palms and soles, brows, rims of lids, eyeballs, creases, and where skin is redder.
Painting is arithmetic on them, without random numbers: the same tone and size give the same
picture. It is a drawing, not a photograph: its tones are chosen, not measured.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from habitus.body.body_mesh import BodyMesh
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
    """A tone on a mesh in the skin's layout: the body's own ``uv``, with larger eyeballs. ``size``:
    pixels of the texture's sides.
    """

    tone: float
    mesh: BodyMesh
    size: int = 1024

    @cached_property
    def image(self) -> UInt8[np.ndarray, "N N 3"]:
        """The texture for ``mesh.uv``, sRGB, row 0 on top."""
        return paint_skin(self.tone, self.size)

    @cached_property
    def colours(self) -> UInt8[np.ndarray, "V 3"]:
        """Colours of the mesh's vertices, sRGB: means over a vertex' places in the layout."""
        rows = _painted(lambda name: _sampled(_mask(name), self.mesh.uv), self.tone, 0.7)
        corners, places = self.mesh.quads.ravel(), self.mesh.quad_uv.ravel()
        sums = [np.bincount(corners, rows[places, channel]) for channel in range(3)]
        means = np.stack(sums, axis=1) / np.bincount(corners).clip(1)[:, None]
        return np.round(means).clip(0, 255).astype(np.uint8)


def skin_tone(skin: str | float | None) -> float | None:
    """A tone between 0 (light) and 1 (dark) of a name, a number or its text; None for "none".

    Raises HabitusError for anything else.
    """
    if skin is None or skin == NONE:
        return None
    try:
        tone = TONES[skin] if isinstance(skin, str) and skin in TONES else float(skin)
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
    return None if own is None else Skin(tone, own, size)


def layout_checksum(mesh: BodyMesh) -> int:
    """Checksum of a texture layout."""
    uv = np.ascontiguousarray(mesh.uv, "<f4").tobytes()
    return zlib.crc32(np.ascontiguousarray(mesh.quad_uv, "<i4").tobytes(), zlib.crc32(uv))


def paint_skin(tone: float, size: int = 1024) -> UInt8[np.ndarray, "N N 3"]:
    """The texture of a tone between 0 (light) and 1 (dark): sRGB, row 0 on top.

    size: its height and width in pixels, 64 to 4096. Masks have 1,024 pixels a side, and larger
    textures are smoother, not richer. Raises HabitusError for a tone or size out of range.
    """
    if not 0 <= tone <= 1:
        raise HabitusError(f"tone is {tone}; expected a number from 0 (light) to 1 (dark)")
    if size not in range(SIZES[0], SIZES[1] + 1):
        raise HabitusError(f"size is {size} pixels; expected {SIZES[0]} to {SIZES[1]}")
    painted = resized(np.unpackbits(_arrays()["painted"], axis=1).astype(np.float32), size) > 0
    image = _painted(lambda name: resized(_mask(name), size), tone, 90.0 * 8 / size)
    image[~painted] = _at_tone("skin", tone)
    return np.round(image).clip(0, 255).astype(np.uint8)


def _painted(
    masks: Callable[[str], Float[np.ndarray, "*shape"]], tone: float, edge: float
) -> Float[np.ndarray, "*shape 3"]:
    """Colours of a tone where masks have their values; edges of irises take ``edge`` degrees."""
    shade = 1 + np.float32(BLOTCHES) * (masks("blotches") - np.float32(0.5))
    image = shade[..., None] * _at_tone("skin", tone)
    for mask, colour, cover in _LAYERS:
        _mix(image, _at_tone(colour, tone), cover * masks(mask))
    angle, eyes = 90 * masks("gaze"), masks("eyes")
    iris = _at_tone("iris", tone)
    within = ((_IRIS_EDGE - angle) / edge + 0.5).clip(0, 1) * eyes
    ring = ((angle - _PUPIL_EDGE) / (_IRIS_EDGE - _PUPIL_EDGE)).clip(0, 1)
    _mix(image, _SCLERA, eyes)
    _mix(image, _SCLERA_RED, eyes * ((angle - 35) / 45).clip(0, 1))
    _mix(image, iris, within)
    _mix(image, 0.4 * iris, within * ring**4)
    _mix(image, _PUPIL, ((_PUPIL_EDGE - angle) / edge + 0.5).clip(0, 1) * eyes)
    return image


def _at_tone(region: str, tone: float) -> Float[np.ndarray, " 3"]:
    table = np.array(_COLOURS[region], np.float64)
    return np.array([np.interp(tone, _KNOTS, column) for column in table.T], np.float32)


def _mix(image: np.ndarray, colour: Any, cover: np.ndarray) -> None:
    """Paint a colour over an image, in place."""
    at = np.nonzero(cover)
    image[at] += cover[at][:, None] * (np.asarray(colour, np.float32) - image[at])


@cache
def _arrays() -> Mapping[str, np.ndarray]:
    with np.load(MASKS) as stored:
        return MappingProxyType({name: stored[name] for name in stored.files})


def _mask(name: str) -> Float[np.ndarray, "n n"]:
    """A mask between 0 and 1, row 0 on top."""
    return _arrays()[f"mask_{name}"].astype(np.float32) / LEVELS


def _sampled(image: Float[np.ndarray, "n n"], uv: Float[np.ndarray, "U 2"]) -> np.ndarray:
    """A square image's values (U,) at texture coordinates, bilinear."""
    size = len(image)
    places = np.clip(uv[:, ::-1] * [-size, size] + [size, 0] - 0.5, 0, size - 1)
    row, column = np.minimum(places.astype(np.int64), size - 2).T
    down, along = (places - np.stack([row, column], axis=1)).T
    upper = (1 - along) * image[row, column] + along * image[row, column + 1]
    lower = (1 - along) * image[row + 1, column] + along * image[row + 1, column + 1]
    return (1 - down) * upper + down * lower


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
