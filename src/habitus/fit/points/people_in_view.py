"""All people in one depth view: connected components above the floor and off the walls; components
of several people who touch are split at their heads (M. Munaro and E. Menegatti, "Fast RGB-D people
tracking for service robots", Autonomous Robots 37:227-242, 2014).
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter1d
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from habitus.errors import HabitusError
from habitus.fit.points.depth_settings import SEGMENTATION, SegmentationSettings
from habitus.fit.points.prepared_views import (
    FOUND_BY,
    find_floor,
    level_frame,
    standing_pieces,
    whole_piece,
    without_flying,
)
from habitus.observe.camera import DepthView, RgbdCapture

BIN = 0.04
"""Metres: of heads across the view, and of heights under them."""
HEADS_APART = 0.2
"""Metres between the tops of the heads of two people who touch, at least."""
NECK = 0.08
"""Metres by which a head stands out of what is between it and the next one."""
SEED = 0.08
"""Metres to each side of a head, where head and trunk are its own."""
STEP = 30.0
"""How much more than a way across a step in depth counts,"""
QUANTUM = 0.006
"""where it is larger than this times squared depth (1 / m): that of the first Kinect's is .003."""
COLUMN = 0.15
"""Metres to each side of a head, within which its body is below it,"""
COVERED = 0.8
"""and the share of the heights down to `LOW` of the head's at which it is: under raised hands there
is nothing."""
LOW = 0.5


def split_people(
    capture: RgbdCapture, settings: SegmentationSettings = SEGMENTATION
) -> list[RgbdCapture]:
    """A capture for every person in its one view, from left to right, each with a mask.

    Raises HabitusError for several views: who is who in them is not known.
    """
    if len(capture.views) != 1:
        raise HabitusError(
            f"{capture.name}: {len(capture.views)} views; expected one, as people are not followed "
            "from view to view; choose one (--views 0)"
        )
    (view,) = capture.views
    return [
        replace(capture, name=f"{capture.name}-{k}", views=(replace(view, mask=mask),))
        for k, mask in enumerate(people_in(view, settings), 1)
    ]


def people_in(
    view: DepthView, settings: SegmentationSettings = SEGMENTATION
) -> list[Bool[np.ndarray, "H W"]]:
    """Masks of all people in a view, from left to right.

    Raises HabitusError where nobody is found.
    """
    points = view.points()
    floor = find_floor(points, view.depth > 0, settings)
    above, pieces = standing_pieces(view.depth, points, floor, settings)
    turn = level_frame(np.array([0.0, -1.0, 0.0]) if floor is None else floor.normal)
    points = points @ turn.T - (0.0 if floor is None else np.array([0.0, floor.height, 0.0]))
    owner = np.full(view.depth.shape, -1)
    count = 0
    bodies = [piece for piece in pieces if _is_body(points[piece], floor is not None, settings)]
    for piece in bodies:
        whole = whole_piece(piece, above, view.depth, settings)
        free = whole & (owner < 0) & ~np.any([each for each in bodies if each is not piece], axis=0)
        parts = _parted(points, free)
        owner[free] = count + parts
        count += int(parts.max(initial=0)) + 1
    masks = [without_flying(owner == k, view.depth) for k in range(count)]
    masks = [mask for mask in masks if mask.sum() >= settings.min_pixels]
    if not masks:
        raise HabitusError(
            f"{view.name or 'the view'}: nobody was found by {FOUND_BY['planes']}; expected people "
            "seen from the head to the thighs or further"
        )
    return sorted(masks, key=lambda mask: float(np.nonzero(mask)[1].mean()))


def _is_body(
    points: Float[np.ndarray, "N 3"], on_floor: bool, settings: SegmentationSettings
) -> bool:
    """Whether a piece is as tall as a person, no plane, and begins near the floor."""
    low, high = np.percentile(points[:, 1], (1, 99))
    thick = np.sqrt(max(0.0, float(np.linalg.eigvalsh(np.cov(points.T))[0])))
    near_floor = not on_floor or low < settings.max_lowest
    return high - low > settings.min_height and thick > settings.min_thickness and near_floor


def _parted(points: Float[np.ndarray, "H W 3"], piece: Bool[np.ndarray, "H W"]) -> np.ndarray:
    """Of each point of a piece (x across, y up) the number of its person: whose head and trunk is
    the closest along the surface, where steps in depth count more.
    """
    own = points[piece]
    across = own[:, 0]
    first = across.min()
    column = ((across - first) / BIN).astype(int)
    tops = np.full(column.max() + 3, -np.inf)
    np.maximum.at(tops, column + 1, own[:, 1])
    tops = np.where(np.isfinite(tops), tops, own[:, 1].min())
    heads = first + BIN * (_peaks(tops) - 0.5)
    heads = np.array([head for head in heads if _has_body(own, head)])
    if len(heads) < 2:
        return np.zeros(len(own), int)
    graph = _neighbours(points, piece)
    middle = own[:, 1].min() + LOW * np.ptp(own[:, 1])
    distances = [
        dijkstra(
            graph,
            directed=False,
            indices=np.flatnonzero((np.abs(across - head) < SEED) & (own[:, 1] > middle)),
            min_only=True,
        )
        for head in heads
    ]
    return np.argmin(distances, axis=0)


def _peaks(tops: Float[np.ndarray, " N"]) -> Int[np.ndarray, " P"]:
    """Bins that are the highest within `HEADS_APART`, and `NECK` above what lies between."""
    wide = 2 * int(HEADS_APART / BIN) + 1
    highest = np.flatnonzero(tops == maximum_filter1d(tops, wide, mode="nearest"))
    kept: list[int] = []
    for peak in sorted(highest.tolist(), key=lambda k: -tops[k]):
        between = [tops[min(peak, other) : max(peak, other)].min() for other in kept]
        if all(valley < tops[peak] - NECK for valley in between):
            kept.append(peak)
    return np.sort(np.array(kept, int))


def _neighbours(points: Float[np.ndarray, "H W 3"], piece: Bool[np.ndarray, "H W"]) -> csr_array:
    """Neighbouring pixels of a piece and how far apart they are (m), steps enlarged."""
    number = np.full(piece.shape, -1)
    number[piece] = np.arange(piece.sum())
    rows, columns, lengths = [], [], []
    for here, there in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        both = piece[here] & piece[there]
        difference = points[here][both] - points[there][both]
        noise = QUANTUM * points[here][both][:, 2] ** 2
        step = np.maximum(np.abs(difference[:, 2]) - noise, 0.0)
        distance = np.linalg.norm(difference[:, :2], axis=-1)
        rows.append(number[here][both])
        columns.append(number[there][both])
        lengths.append(distance + STEP * step)
    pairs = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(lengths), pairs), shape=(int(piece.sum()),) * 2)


def _has_body(points: Float[np.ndarray, "N 3"], head: float) -> bool:
    """Whether there is a body all the way below a head."""
    heights = points[np.abs(points[:, 0] - head) < COLUMN, 1]
    top, bottom = heights.max(), points[:, 1].min()
    low = bottom + LOW * (top - bottom)
    edges = np.arange(low, top, BIN)
    return float((np.histogram(heights, edges)[0] > 0).mean()) >= COVERED
