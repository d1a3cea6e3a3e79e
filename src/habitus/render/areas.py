"""What shows in pixels that several faces share: areas and centroids, as fragments beside those of
edges.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.kernels.threads import run_chunks
from habitus.render.kernels import areas as area_kernels
from habitus.render.kernels.areas import CORNERS, PIECES
from habitus.render.kernels.structs import (
    AreaRoom,
    FoundAreas,
    FoundFragments,
    FragmentSides,
    ScreenFaces,
    Tiles,
)

ROWS = 4096
"""Rows that are made room for at a time."""
PARTS = 4
"""Places on each edge fragment at which an image's jump is taken."""


def find_areas(
    on_screen: ScreenFaces,
    tiles: Tiles,
    ids: Int[np.ndarray, "H W"],
    inverse: Float[np.ndarray, "H W"],
    fragments: Int[np.ndarray, " S"],
) -> tuple[FoundAreas, Bool[np.ndarray, "H W"]]:
    """The areas of the faces in each pixel that shows several, pixels ascending; where surfaces
    cross each other.

    inverse: 1 / depth at pixels' centres. fragments: the pixels of edge fragments. Areas of a pixel
    add up to 1, the background's (face -1) among them.
    """
    crossed = np.zeros(ids.shape, bool)
    crossed.reshape(-1)[fragments] = True
    chosen = np.empty(ids.shape, bool)
    crossing = np.zeros(ids.size, bool)
    run_chunks(
        lambda _, begin, end: area_kernels.choose_pixels(ids, crossed, begin, end, chosen),
        len(ids),
        least=16,
        pieces=4,
    )
    pixels = np.flatnonzero(chosen)
    parts: dict[int, list[FoundAreas]] = {}

    def work(chunk: int, begin: int, end: int) -> None:
        parts[chunk] = _areas_of((on_screen, tiles, ids, inverse, pixels), begin, end, crossing)

    run_chunks(work, len(pixels), least=256, pieces=4)
    merged = [part for chunk in sorted(parts) for part in parts[chunk]]
    return FoundAreas(
        *(np.concatenate(field) for field in zip(*merged, strict=True))
    ), crossing.reshape(ids.shape)


def _areas_of(
    where: tuple, begin: int, end: int, crossing: Bool[np.ndarray, " N"]
) -> list[FoundAreas]:
    """The areas of pixels begin..end, in pieces."""
    longest = int(np.diff(where[1].starts).max(initial=0))
    room = _room(longest)
    parts = []
    while True:
        size = max(ROWS, longest + 1)
        areas = FoundAreas(
            np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size), np.empty((size, 2))
        )
        begin, count = area_kernels.find_areas(*where, begin, end, room, areas, crossing)
        parts.append(FoundAreas(*(field[:count] for field in areas)))
        if begin >= end:
            return parts


def _room(count: int) -> AreaRoom:
    return AreaRoom(
        np.empty(count, np.int64),
        np.empty(count, np.int64),
        np.empty(count, np.int64),
        np.empty(count),
        np.empty(count),
        np.empty(count),
        np.empty((count, 4, 3)),
        np.empty((count, CORNERS, 2)),
        np.empty((PIECES, CORNERS, 2)),
        np.empty(PIECES, np.int64),
        np.empty((CORNERS, 2)),
        np.empty((CORNERS, 2)),
    )


def parted(fragments: FoundFragments, screen: Float[np.ndarray, "V 3"]) -> FoundFragments:
    """Fragments in `PARTS` each: what lies beside an edge may change within a pixel."""
    numbers = FoundFragments(*(np.repeat(field, PARTS, 0) for field in fragments))
    low, high = numbers.span.T
    part = np.tile(np.arange(PARTS), len(fragments.pixel)) / PARTS
    low, high = low + part * (high - low), low + (part + 1.0 / PARTS) * (high - low)
    middle = 0.5 * (low + high)[:, None]
    place = (1.0 - middle) * screen[numbers.tail, :2] + middle * screen[numbers.head, :2]
    return numbers._replace(span=np.stack([low, high], 1), middle=place)


def with_areas(
    fragments: FoundFragments, sides: FragmentSides, areas: FoundAreas, ids: Int[np.ndarray, "H W"]
) -> tuple[np.ndarray, ...]:
    """The fields of `EdgeFragments`: edges that only move, their weights 0, and areas that only
    weigh.

    An area's weight is held, as its border's motion is the edges': it has no extent on an edge
    (start = end = 0). Its inside is the pixel's centre, so that the sum of `render/README.md`
    leaves the areas' mean and nothing else.
    """
    row, column = np.divmod(areas.pixel, ids.shape[1])
    nowhere = np.zeros(len(areas.pixel), np.int64)
    none = np.zeros(len(areas.pixel))
    centre = np.stack([column, row], 1) + 0.5
    start, end = fragments.span.T
    edge = (*fragments[:5], start, end, fragments.outward, np.zeros_like(fragments.weight), *sides)
    at_centre = ids.reshape(-1)[areas.pixel].astype(np.int64)
    area = (
        areas.pixel,
        nowhere,
        nowhere,
        nowhere,
        np.ones(len(none), bool),
        none,
        none,
        none,
        areas.area,
    )
    sampled = (at_centre, areas.face, centre, areas.point)
    joined = [np.concatenate(pair) for pair in zip(edge, (*area, *sampled), strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return tuple(field[order] for field in joined)
