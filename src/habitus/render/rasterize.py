"""Rasterise triangles on a screen by compiled kernels: the face at each pixel, and the edges at which images jump."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.kernels.threads import count_chunks, run_chunks
from habitus.render.edge_fragments import EdgeFragments
from habitus.render.kernels import edges as edge_kernels
from habitus.render.kernels import raster as raster_kernels
from habitus.render.kernels.raster import TILE
from habitus.render.memory import keep_memory
from habitus.render.reference import images as reference
from habitus.render.triangles import Triangles
from habitus.render.visibility import Visibility


def rasterize(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool, edges: bool
) -> Visibility:
    """The nearest face at each pixel and, if `edges`, the visible fragments of the edges at which an image may jump.

    screen: u, v in pixels and depth of each vertex. Faces with a corner that is not finite or not in front of the
    camera are not drawn, nor with `cull` those that show their back. Tensors on another device are looked at there.
    """
    if screen.device.type != "cpu":
        return rasterize_reference(screen, triangles, width, height, cull, edges)
    keep_memory()
    tiled = tile_faces(screen.to(torch.float64).contiguous().numpy(), triangles, width, height, cull)
    ids, inverse = draw(tiled, triangles, width, height)
    fragments = cut(tiled, triangles, ids) if edges else None
    return Visibility(torch.from_numpy(ids), fragments, torch.from_numpy(inverse))


def rasterize_reference(
    screen: Float[Tensor, "V 3"], triangles: Triangles, width: int, height: int, cull: bool, edges: bool
) -> Visibility:
    """Reference of `rasterize` in plain torch, on any device."""
    ids = reference.visible(screen, triangles, width, height, cull)
    return Visibility(ids, reference.edge_fragments(screen, triangles, ids, cull) if edges else None)


@dataclass(frozen=True, eq=False)
class Tiled:
    """Faces sorted into square tiles of the screen: those of tile t are `listed[starts[t] : starts[t + 1]]`, ascending.

    inverse: 1 / depth of each vertex, 0 for those that are not drawn. facing: sign of each face's area on the screen, 0
    where it is not drawn and twice that where it lies outside the image. boxes: the first and last column and row of
    tiles of each face. bounds: of each listed face, u and v from and to, and the largest inverse depth.
    """

    screen: Float[np.ndarray, "V 3"]
    inverse: Float[np.ndarray, " V"]
    facing: Int[np.ndarray, " F"]
    boxes: Int[np.ndarray, "F 4"]
    starts: Int[np.ndarray, " N"]
    listed: Int[np.ndarray, " L"]
    bounds: Float[np.ndarray, "L 5"]


def tile_faces(screen: Float[np.ndarray, "V 3"], triangles: Triangles, width: int, height: int, cull: bool) -> Tiled:
    """Sort faces into the tiles that they may touch."""
    faces, tiles = triangles.faces.numpy(), ((width + TILE - 1) // TILE) * ((height + TILE - 1) // TILE)
    inverse = np.empty(len(screen))
    raster_kernels.invert_depths(screen, inverse)
    facing, boxes = np.zeros(len(faces), np.int8), np.empty((len(faces), 4), np.int32)
    counts = np.zeros((count_chunks(len(faces)), tiles), np.int64)

    def count(chunk: int, begin: int, end: int) -> None:
        raster_kernels.bin_faces(screen, inverse, faces, cull, width, height, begin, end, facing, boxes, counts[chunk])

    run_chunks(count, len(faces))
    starts = np.concatenate([[0], np.cumsum(counts.sum(0))])
    cursors = starts[:-1] + np.cumsum(counts, 0) - counts
    listed, bounds = np.empty(starts[-1], np.int32), np.empty((starts[-1], 5), np.float32)
    columns = (width + TILE - 1) // TILE

    def fill(chunk: int, begin: int, end: int) -> None:
        raster_kernels.list_faces(
            screen, inverse, faces, facing, boxes, columns, begin, end, cursors[chunk], listed, bounds
        )

    run_chunks(fill, len(faces))
    return Tiled(screen, inverse, facing, boxes, starts, listed, bounds)


def draw(tiled: Tiled, triangles: Triangles, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """The nearest face at each pixel centre, -1 where there is none, and 1 / depth there, 0 where there is none."""
    ids, inverse, faces = np.empty((height, width), np.int32), np.empty((height, width)), triangles.faces.numpy()
    seen, columns = (tiled.screen, tiled.inverse, faces, tiled.facing, tiled.boxes), (width + TILE - 1) // TILE

    def work(_: int, begin: int, end: int) -> None:
        raster_kernels.draw_rows(*seen, begin, end, ids, inverse, np.empty((end - begin, columns)))

    run_chunks(work, (height + TILE - 1) // TILE, least=4, pieces=4)
    return ids, inverse


def cut(tiled: Tiled, triangles: Triangles, ids: Int[np.ndarray, "H W"]) -> EdgeFragments:
    """The visible fragments, a pixel each, of edges at which an image may jump."""
    height, width = ids.shape
    faces, edge_face, edge_corner = (x.numpy() for x in (triangles.faces, triangles.edge_face, triangles.edge_corner))
    seen = tiled.screen, tiled.inverse, faces, tiled.facing
    stack = tiled.starts, tiled.listed, tiled.bounds, width, height
    inside, two, offset = _choose(triangles, seen, width, height)
    total = offset[-1]
    pixel = np.full(total, -1, np.int64)
    tail, head, face, seam = (np.empty(total, kind) for kind in (np.int64, np.int64, np.int64, bool))
    span, point, outward, weight = np.empty((total, 2)), np.empty((total, 2)), np.empty(total), np.empty(total)

    most = int(np.diff(tiled.starts).max(initial=0))

    def cut_some(_: int, begin: int, end: int) -> None:
        near = np.empty(most + 3, np.int64)
        edge_kernels.cut_edges(
            *seen, edge_face, edge_corner, inside, two, offset, *stack, begin, end,
            near, pixel, tail, head, face, seam, span, outward, weight, point,
        )  # fmt: skip

    run_chunks(cut_some, len(inside), least=64, pieces=2)
    kept = np.flatnonzero(pixel >= 0)
    kept = kept[np.argsort(pixel[kept], kind="stable")]
    pixel, tail, head, face, seam, span, point, outward, weight = (
        x.take(kept, 0) for x in (pixel, tail, head, face, seam, span, point, outward, weight)
    )
    group = np.append(np.flatnonzero(np.diff(pixel, prepend=-1)), len(pixel))
    ins, outs, inner, outer = np.empty_like(face), np.empty_like(face), np.empty_like(point), np.empty_like(point)

    def place_some(_: int, begin: int, end: int) -> None:
        edge_kernels.find_sample_points(
            *seen[:3],
            *stack,
            ids,
            begin,
            end,
            group,
            pixel,
            tail,
            head,
            span,
            outward,
            weight,
            point,
            ins,
            outs,
            inner,
            outer,
        )

    run_chunks(place_some, len(group) - 1, least=64, pieces=2)
    fields = (pixel, tail, head, face, seam, span[:, 0], span[:, 1], outward, weight, ins, outs, inner, outer)
    return EdgeFragments(*(torch.from_numpy(np.ascontiguousarray(values)) for values in fields))


def _choose(triangles: Triangles, seen: tuple, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Edges that may show a border: their place in the lists, whether they are seams, and where their fragments go."""
    edges = (triangles.edge_start, triangles.edge_face, triangles.edge_corner, triangles.edge_seam)
    arrays = [edge.numpy() for edge in edges]
    count = len(triangles.edge_start) - 1
    inside, two, room = np.empty(count, np.int64), np.zeros(count, bool), np.empty(count, np.int64)

    def work(_: int, begin: int, end: int) -> None:
        edge_kernels.choose_edges(*seen, *arrays, width, height, begin, end, inside, two, room)

    run_chunks(work, count)
    chosen = np.flatnonzero(inside >= 0)
    return inside[chosen], two[chosen], np.concatenate([[0], np.cumsum(room[chosen])])
