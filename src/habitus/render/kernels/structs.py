"""Arrays that kernels take together, as named tuples, which numba compiles to no more than their
fields.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class ScreenFaces(NamedTuple):
    """F faces between V vertices on the screen."""

    screen: Float[np.ndarray, "V 3"]
    """u, v in pixels, and depth."""
    inverse: Float[np.ndarray, " V"]
    """w = 1 / depth, 0 for vertices that are not drawn."""
    faces: Int[np.ndarray, "F 3"]
    facing: Int[np.ndarray, " F"]
    """Sign of each face's area on the screen; 0: not drawn; twice the sign: outside the image."""


class Tiles(NamedTuple):
    """Faces sorted into square tiles of the image: tile t has `listed[starts[t] : starts[t + 1]]`,
    ascending.

    Tiles that were not asked for have none.
    """

    starts: Int[np.ndarray, " T+1"]
    listed: Int[np.ndarray, " L"]
    bounds: Float[np.ndarray, "5 L+8"]
    """Those of `raster.place_faces`, of each listed face, and room behind (`vectors.overlapping`).
    """
    width: int
    height: int
    side: int
    """Pixels along a tile's side, a power of 2."""


class NearFaces(NamedTuple):
    """Workspace for the faces of one tile that may hide an edge, N at most."""

    place: Int[np.ndarray, "2"]
    """The tile, -1 for none, and how many faces there are."""
    faces: Int[np.ndarray, " N"]
    """int32, as in `Tiles`."""
    bounds: Float[np.ndarray, "5 N+8"]
    """As in `Tiles`."""


class EdgeLists(NamedTuple):
    """The faces around each of E edges: `Triangles.faces`, and its arrays with `edge_` before these
    names; int32.

    corners: of each face around an edge the vertices from which and to which the face runs along
    it, and the third.
    """

    faces: Int[np.ndarray, "F 3"]
    start: Int[np.ndarray, " E+1"]
    face: Int[np.ndarray, " K"]
    corners: Int[np.ndarray, "K 3"]
    seam: Bool[np.ndarray, " E"]
    pair: Int[np.ndarray, "E 2"]


class ChosenEdges(NamedTuple):
    """Edges at which an image may jump."""

    face: Int[np.ndarray, " E"]
    """Each edge's inside face."""
    tail: Int[np.ndarray, " E"]
    """The vertex from which that runs along the edge."""
    head: Int[np.ndarray, " E"]
    """The vertex to which it does."""
    two_sided: Bool[np.ndarray, " E"]
    """Whether faces lie on both sides."""
    most: Int[np.ndarray, " E"]
    """How many fragments the edge may have at most."""
    start: Float[np.ndarray, " E"]
    """Where it enters the image: 0 at its beginning, 1 at its end, linear on the screen."""
    stop: Float[np.ndarray, " E"]
    """And where it leaves it."""


class FoundFragments(NamedTuple):
    """S edge fragments, some of them empty (pixel -1); see `EdgeFragments`, whose fields these
    are.
    """

    pixel: Int[np.ndarray, " S"]
    tail: Int[np.ndarray, " S"]
    head: Int[np.ndarray, " S"]
    face: Int[np.ndarray, " S"]
    seam: Bool[np.ndarray, " S"]
    span: Float[np.ndarray, "S 2"]
    """`start` and `end`."""
    outward: Float[np.ndarray, " S"]
    weight: Float[np.ndarray, " S"]
    middle: Float[np.ndarray, "S 2"]
    """The point (u, v) halfway."""


class FragmentSides(NamedTuple):
    """What is on the two sides of S edge fragments: the fields of `EdgeFragments` of the same
    names.
    """

    inner_face: Int[np.ndarray, " S"]
    outer_face: Int[np.ndarray, " S"]
    inner_point: Float[np.ndarray, "S 2"]
    outer_point: Float[np.ndarray, "S 2"]


class FoundAreas(NamedTuple):
    """What shows in pixels: a face (-1: the background), its area there and the area's centroid (u,
    v).
    """

    pixel: Int[np.ndarray, " A"]
    face: Int[np.ndarray, " A"]
    area: Float[np.ndarray, " A"]
    point: Float[np.ndarray, "A 2"]


class AreaRoom(NamedTuple):
    """Workspace for one pixel's N faces, whose polygons have M corners at most and fall into P
    pieces.
    """

    order: Int[np.ndarray, " N"]
    face: Int[np.ndarray, " N"]
    corners: Int[np.ndarray, " N"]
    low: Float[np.ndarray, " N"]
    high: Float[np.ndarray, " N"]
    mean: Float[np.ndarray, " N"]
    lines: Float[np.ndarray, "N 4 3"]
    polygon: Float[np.ndarray, "N M 2"]
    pieces: Float[np.ndarray, "P M 2"]
    sizes: Int[np.ndarray, " P"]
    first: Float[np.ndarray, "M 2"]
    second: Float[np.ndarray, "M 2"]
