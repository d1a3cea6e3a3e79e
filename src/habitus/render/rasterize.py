"""Rasterise triangles on a screen by compiled kernels: the face at each pixel, and the edges at
which images jump.

Memory for images is kept between calls instead of given back to the system and faulted in again
page by page.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from habitus.kernels.threads import run_chunks
from habitus.render.areas import find_areas, parted, with_areas
from habitus.render.kernels import areas as area_kernels
from habitus.render.kernels import edges as edge_kernels
from habitus.render.kernels import raster as raster_kernels
from habitus.render.kernels import tiles as tile_kernels
from habitus.render.kernels.raster import TILE
from habitus.render.kernels.structs import (
    ChosenEdges,
    EdgeLists,
    FoundFragments,
    FragmentSides,
    NearFaces,
    ScreenFaces,
    Tiles,
)
from habitus.render.kernels.vectors import PIXELS
from habitus.render.reference import images as reference
from habitus.render.triangles import EdgeFragments, Triangles, Visibility

LARGEST = 31 << 20
"""Bytes: a little under the 32 MB above which glibc gives every block back."""


@lru_cache(maxsize=1)
def keep_memory() -> None:
    """Let glibc keep freed blocks up to `LARGEST`, and twice that in all, for the rest of the
    process.

    It keeps blocks no larger than the largest that was freed before (`man mallopt`,
    M_MMAP_THRESHOLD), so one is freed; it is never touched and takes no memory. Other libraries of
    C are not changed.
    """
    torch.empty(LARGEST, dtype=torch.uint8)


LEAST_TILE = 2
"""Pixels along the side of the smallest tiles whose faces are listed."""
CHUNK, FACE, FRAGMENTS = 120_000, 8, 1000
"""What is worth a chunk of its own: so many pixels, of which a face counts for eight, or so many
edge fragments.
"""


def rasterize(
    screen: Float[Tensor, "V 3"],
    triangles: Triangles,
    width: int,
    height: int,
    cull: bool,
    edges: bool,
    exact: bool = False,
) -> Visibility:
    """The nearest face at each pixel and, if `edges`, the visible fragments of the edges at which
    an image may jump.

    exact: with the areas of all faces that show in a pixel, as far as there are several.

    screen: u, v in pixels and depth of each vertex. Faces with a corner that is not finite or not
    in front of the camera are not drawn, nor with `cull` those that show their back. Tensors on
    another device are looked at there.
    """
    if screen.device.type != "cpu" and exact:
        return rasterize(screen.cpu(), triangles.to("cpu"), width, height, cull, edges, exact).to(
            screen.device
        )
    if screen.device.type != "cpu":
        return rasterize_reference(screen, triangles, width, height, cull, edges)
    keep_memory()
    array = screen.to(torch.float64).contiguous().numpy()
    on_screen, bounds = place_faces(array, triangles, width, height, cull)
    ids, inverse = draw(on_screen, bounds, width, height)
    fragments = (
        find_fragments(on_screen, bounds, triangles, ids, inverse if exact else None)
        if edges
        else None
    )
    return Visibility(torch.from_numpy(ids), fragments, torch.from_numpy(inverse), exact)


def rasterize_reference(
    screen: Float[Tensor, "V 3"],
    triangles: Triangles,
    width: int,
    height: int,
    cull: bool,
    edges: bool,
) -> Visibility:
    """Reference of `rasterize` in plain torch, on any device."""
    ids = reference.visible(screen, triangles, width, height, cull)
    return Visibility(
        ids, reference.edge_fragments(screen, triangles, ids, cull) if edges else None
    )


def intersections(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool
) -> Bool[Tensor, "H W"]:
    """The pixels in which surfaces that show pass through each other, along a line that is no edge
    of a mesh.
    """
    array = screen.cpu().to(torch.float64).contiguous().numpy()
    on_screen, bounds = place_faces(array, triangles.to("cpu"), width, height, cull)
    tiles = list_all_faces(on_screen.facing, bounds, width, height)
    _, crossing = find_areas(
        on_screen, tiles, *draw(on_screen, bounds, width, height), np.zeros(0, np.int64)
    )
    return torch.from_numpy(crossing).to(screen.device)


def place_faces(
    screen: Float[np.ndarray, "V 3"], triangles: Triangles, width: int, height: int, cull: bool
) -> tuple[ScreenFaces, Float[np.ndarray, "F 5"]]:
    """Faces on the screen, and the bounds of each (`raster.place_faces`)."""
    faces = triangles.edges.faces
    inverse = np.empty(len(screen))
    raster_kernels.invert_depths(screen, inverse)
    on_screen = ScreenFaces(screen, inverse, faces, np.empty(len(faces), np.int8))
    bounds = np.empty((len(faces), 5), np.float32)

    def work(_: int, begin: int, end: int) -> None:
        raster_kernels.place_faces(on_screen, cull, width, height, begin, end, bounds)

    run_chunks(work, len(faces), least=16384)
    return on_screen, bounds


def list_faces(
    facing: Int[np.ndarray, " F"],
    bounds: Float[np.ndarray, "F 5"],
    shape: tuple[int, int, int],
    wanted: Bool[np.ndarray, " T"],
) -> Tiles:
    """Sort faces into the wanted ones of the tiles that they may touch.

    shape: width and height of the image and the tiles' side, pixels.
    """
    width, height, side = shape
    sums = np.zeros((-(-height // side) + 1, -(-width // side) + 1), np.int64)
    wanted.reshape(sums.shape[0] - 1, -1).cumsum(0).cumsum(1, out=sums[1:, 1:])
    found = {}

    def choose(chunk: int, begin: int, end: int) -> None:
        some = np.empty((end - begin, 4), np.int32)
        count, entries = tile_kernels.choose_faces(
            facing, bounds, wanted, sums, shape, begin, end, some
        )
        found[chunk] = some[:count], entries

    run_chunks(choose, len(facing), least=16384)
    chosen = np.concatenate([found[k][0] for k in sorted(found)])
    entries = sum(each for _, each in found.values())
    room = np.empty((5, entries + PIXELS), np.float32)
    tiles = Tiles(np.empty(len(wanted) + 1, np.int64), np.empty(entries, np.int32), room, *shape)
    tile_kernels.list_faces(bounds, chosen, wanted, *np.empty((2, entries), np.int32), tiles)
    return tiles


def list_all_faces(
    facing: Int[np.ndarray, " F"], bounds: Float[np.ndarray, "F 5"], width: int, height: int
) -> Tiles:
    """Sort all faces that are drawn into all tiles that they may touch."""
    return list_faces(
        facing, bounds, (width, height, TILE), np.ones(count_tiles(width, height, TILE), bool)
    )


def count_tiles(width: int, height: int, side: int) -> int:
    """How many tiles of `side` pixels an image has."""
    return -(-width // side) * -(-height // side)


def draw(
    on_screen: ScreenFaces, bounds: Float[np.ndarray, "F 5"], width: int, height: int
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """The nearest face at each pixel centre, -1 where there is none, and 1 / depth there, 0 where
    there is none.
    """
    ids = np.empty((height, width), np.int32)
    inverse = np.empty((height, width))
    columns = (width + TILE - 1) // TILE
    rows = (height + TILE - 1) // TILE

    def work(_: int, begin: int, end: int) -> None:
        raster_kernels.draw_rows(
            on_screen, bounds, begin, end, ids, inverse, np.empty((end - begin, columns))
        )

    share = CHUNK / (width * height + FACE * len(bounds))
    run_chunks(work, rows, least=math.ceil(rows * min(share, 1.0)), pieces=4)
    return ids, inverse


def find_fragments(
    on_screen: ScreenFaces,
    bounds: Float[np.ndarray, "F 5"],
    triangles: Triangles,
    ids: Int[np.ndarray, "H W"],
    inverse: Float[np.ndarray, "H W"] | None = None,
) -> EdgeFragments:
    """The visible fragments of the edges at which an image may jump, sorted by pixel.

    inverse: 1 / depth at pixels' centres, where the areas of all faces are wanted too.
    """
    height, width = ids.shape
    chosen = _choose(on_screen, triangles.edges, width, height)
    if inverse is None:
        tiles = _tiles_around(on_screen, bounds, chosen, width, height)
    else:
        tiles = list_all_faces(on_screen.facing, bounds, width, height)
    fragments = _cut(on_screen, tiles, chosen)
    if inverse is not None:
        return _fragments_of_areas(on_screen, tiles, fragments, ids, inverse)
    group = np.append(np.flatnonzero(np.diff(fragments.pixel, prepend=-1)), len(fragments.pixel))
    sides = _room_for_sides(fragments)

    def work(_: int, begin: int, end: int) -> None:
        edge_kernels.find_sample_points(on_screen, tiles, ids, group, fragments, begin, end, sides)

    run_chunks(work, len(group) - 1, least=FRAGMENTS, pieces=2)
    start, end = np.ascontiguousarray(fragments.span.T)
    numbers = (*fragments[:5], start, end, fragments.outward, fragments.weight, *sides)
    return EdgeFragments(*(torch.from_numpy(values) for values in numbers))


def _fragments_of_areas(
    on_screen: ScreenFaces,
    tiles: Tiles,
    found: FoundFragments,
    ids: np.ndarray,
    inverse: np.ndarray,
) -> EdgeFragments:
    """Fragments of edges, which only move, and of areas, which only weigh (`areas.with_areas`)."""
    areas, _ = find_areas(on_screen, tiles, ids, inverse, found.pixel)
    found = parted(found, on_screen.screen)
    sides = _room_for_sides(found)

    def work(_: int, begin: int, end: int) -> None:
        area_kernels.look_beside(on_screen, tiles, found, begin, end, sides)

    run_chunks(work, len(found.pixel), least=64, pieces=2)
    return EdgeFragments(
        *(torch.from_numpy(values) for values in with_areas(found, sides, areas, ids))
    )


def _room_for_sides(found: FoundFragments) -> FragmentSides:
    face = found.face
    point = found.middle
    return FragmentSides(
        np.empty_like(face), np.empty_like(face), np.empty_like(point), np.empty_like(point)
    )


def _choose(on_screen: ScreenFaces, edges: EdgeLists, width: int, height: int) -> ChosenEdges:
    """The edges that may show a border."""
    found = {}
    kinds = (np.int64, np.int64, np.int64, bool, np.int64, float, float)

    def work(chunk: int, begin: int, end: int) -> None:
        room = ChosenEdges(*(np.empty(end - begin, kind) for kind in kinds))
        count = edge_kernels.choose_edges(on_screen, edges, width, height, begin, end, room)
        found[chunk] = ChosenEdges(*(values[:count] for values in room))

    chunks = run_chunks(work, len(edges.seam), least=16384)
    parts = zip(*(found[k] for k in range(chunks)), strict=True)
    return found[0] if chunks == 1 else ChosenEdges(*(np.concatenate(part) for part in parts))


def _tiles_around(
    on_screen: ScreenFaces, bounds: np.ndarray, chosen: ChosenEdges, width: int, height: int
) -> Tiles:
    """The faces in the tiles around chosen edges. Tiles are about twice as large as faces that fill
    the image once.
    """
    extent = math.sqrt(width * height / max(len(on_screen.faces), 1))
    side = min(TILE, max(LEAST_TILE, 2 ** round(math.log2(3.0 * extent))))
    shape = (width, height, side)
    marked = np.zeros(count_tiles(width, height, side), bool)
    tile_kernels.mark_tiles(on_screen.screen, chosen, *shape, marked)
    return list_faces(on_screen.facing, bounds, shape, marked)


def _cut(on_screen: ScreenFaces, tiles: Tiles, chosen: ChosenEdges) -> FoundFragments:
    """The visible fragments of chosen edges, sorted by pixel."""
    offset = np.concatenate([[0], np.cumsum(chosen.most)])
    total = offset[-1]
    longest = int(np.diff(tiles.starts).max(initial=0))
    found = FoundFragments(
        pixel=np.full(total, -1, np.int64),
        tail=np.empty(total, np.int64),
        head=np.empty(total, np.int64),
        face=np.empty(total, np.int64),
        seam=np.empty(total, bool),
        span=np.empty((total, 2)),
        outward=np.empty(total),
        weight=np.empty(total),
        middle=np.empty((total, 2)),
    )

    def work(_: int, begin: int, end: int) -> None:
        room = np.empty(longest, np.int32), np.empty((5, longest + PIXELS), np.float32)
        near = NearFaces(np.empty(2, np.int64), *room)
        edge_kernels.cut_edges(on_screen, tiles, chosen, offset, begin, end, near, found)

    run_chunks(
        work,
        len(chosen.face),
        least=max(1, FRAGMENTS * len(chosen.face) // max(int(total), 1)),
        pieces=2,
    )
    kept = np.flatnonzero(found.pixel >= 0)
    kept = kept[np.argsort(found.pixel[kept], kind="stable")]
    return FoundFragments(*(values.take(kept, 0) for values in found))
