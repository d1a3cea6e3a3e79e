"""Components that do not push the skin through itself: surfaces that meet in random bodies are made
to move together.

Random bodies of a space are drawn, and where they cut themselves (lips, toes, thighs, folds) or
turn triangles over,
springs are laid between the vertices concerned. They pull the *difference* of the vertices' motions
to zero; what this
changes is spread smoothly over the surface around:  min  sum k_ij |D_i - D_j|^2 + |L U|^2 + small |U|^2,  D + U the new
components. Springs grow where bodies still meet, until few do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from .intersections import intersecting_pairs, turned_over
from .shape_space import ShapeSpace

DRAWS = 60  # normal bodies a round: springs for what no person reaches cost true shape
ROUNDS = 14
ENOUGH = 0.0  # share of drawn bodies that may still meet when it stops
# added to a pair's spring for every body in which it meets, times the round; the surface's own is 1
SPRING = 0.15
MEAN_SPRING = 10.0
HOLD = 0.1  # how firmly components stay where nothing meets
ROOM_DRAWS = 16  # normal bodies a round that show where a mean needs room
ROOM_ROUNDS = 6
ROOM_SPRING = 1.0
REACH = 0.10  # metres: vertices further apart on the mean body are not tied


@dataclass
class Meetings:
    """Springs between vertices, as they grow."""

    count: int
    table: dict[tuple[int, int], float]

    def tie(self, pairs: np.ndarray, mirror: np.ndarray, amount: float) -> None:
        """Add to the springs of pairs (K,2), on both sides alike."""
        both = np.concatenate([pairs, mirror[pairs]])
        both = np.unique(np.sort(both, 1), axis=0)
        for a, b in both.tolist():
            if a != b:
                self.table[a, b] = self.table.get((a, b), 0.0) + amount

    def laplacian(self) -> sparse.csr_matrix:
        """(V, V) matrix whose quadratic form is the springs' energy."""
        index = np.array(list(self.table)).reshape(-1, 2)
        value = np.array(list(self.table.values()))
        return _laplacian(index, value, self.count)


def apart(
    space: ShapeSpace,
    skins: tuple[np.ndarray, ...],
    mirror: np.ndarray,
    clean: np.ndarray,
    rng: np.random.Generator,
    known: Meetings | None = None,
) -> tuple[ShapeSpace, Meetings]:
    """The space with its components changed where random bodies' skin meets itself, and the
    springs.

    `skins` (F,3) each are levels of detail over the same vertices, the finest first.

    Where the mean itself does (thick lips), it takes on the gaps of `clean` (V,3), a body that does
    not, first. `known` springs of a space much like this one spare the search for them.
    """
    stiff = _stiffness(skins[0], len(space.mean))
    space = replace(space, mean=_open(space.mean, skins, mirror, clean, stiff))
    if known is not None:
        return _tied(space, stiff, known), known
    meetings = Meetings(len(space.mean), {})
    found = space
    for turn in range(ROUNDS):
        if _meet(found, skins, mirror, rng, meetings, SPRING * (1 + turn)) <= ENOUGH:
            break
        found = _tied(space, stiff, meetings)
    return found, meetings


def with_room(
    mean: np.ndarray,
    clean: np.ndarray,
    shapedirs: np.ndarray,
    skins: tuple[np.ndarray, ...],
    mirror: np.ndarray,
    meetings: Meetings,
) -> np.ndarray:
    """The mean body (V, 3) of an age with the gaps of `clean` (V, 3), the adult's scaled mean,
    wherever bodies drawn about it with shapedirs (V, 3, B) meet themselves or turn triangles over.

    meetings: springs of other ages, to which these are added: where one age needs room, its
    neighbours mostly do.
    """
    stiff = _stiffness(skins[0], len(mean))
    start = _open(mean, skins, mirror, clean, stiff)
    rng = np.random.default_rng(0)
    for turn in range(ROOM_ROUNDS):
        found = start
        if meetings.table:
            found = start + _relax(stiff, meetings, start - clean)
        betas = draws(ROOM_DRAWS, shapedirs.shape[-1], "normal", rng)
        spring = ROOM_SPRING * (1 + turn)
        bad = 0
        for body in found + np.einsum("vcb,nb->nvc", shapedirs, betas):
            met = [_tie(body, found, faces, mirror, meetings, spring) for faces in skins]
            bad += any(met)
        if not bad:
            break
    return found


def _tied(space: ShapeSpace, stiff: sparse.csc_matrix, meetings: Meetings) -> ShapeSpace:
    flat = space.shapedirs.reshape(len(space.mean), -1)
    change = _relax(stiff, meetings, flat).reshape(space.shapedirs.shape)
    return replace(space, shapedirs=space.shapedirs + change)


def _open(
    mean: np.ndarray,
    skins: tuple[np.ndarray, ...],
    mirror: np.ndarray,
    clean: np.ndarray,
    stiff: sparse.csc_matrix,
) -> np.ndarray:
    meetings = Meetings(len(mean), {})
    found = mean
    for _ in range(ROUNDS):
        pairs = [faces[intersecting_pairs(found, faces)] for faces in skins]  # (K, 2, 3) each
        if not any(len(each) for each in pairs):
            break
        for each in pairs:
            meetings.tie(nearest(clean, each[:, 0], each[:, 1]), mirror, MEAN_SPRING)
        found = mean + _relax(stiff, meetings, mean - clean)
    return found


def _relax(stiff: sparse.csc_matrix, meetings: Meetings, motion: np.ndarray) -> np.ndarray:
    """What to add to a motion (V,K) so that tied vertices move alike."""
    springs = meetings.laplacian()
    return splu((stiff + springs).tocsc()).solve(-(springs @ motion))


def _stiffness(faces: np.ndarray, count: int) -> sparse.csc_matrix:
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    smooth = _laplacian(edges, np.ones(len(edges)), count)
    return (smooth @ smooth + HOLD * sparse.identity(count)).tocsc()


def draws(count: int, components: int, kind: str, rng: np.random.Generator) -> np.ndarray:
    """Betas (N,B): "normal", or "uniform" within 3 standard deviations."""
    size = (count, components)
    return rng.normal(size=size) if kind == "normal" else rng.uniform(-3, 3, size)


def _meet(
    space: ShapeSpace,
    skins: tuple[np.ndarray, ...],
    mirror: np.ndarray,
    rng: np.random.Generator,
    meetings: Meetings,
    spring: float,
) -> float:
    """Tie what meets in random bodies; returns the share of bodies in which something does."""
    components = space.shapedirs.shape[-1]
    betas = draws(DRAWS, components, "normal", rng)
    bad = 0
    for body in space.bodies(betas):
        met = [_tie(body, space.mean, faces, mirror, meetings, spring) for faces in skins]
        bad += any(met)
    return bad / len(betas)


def _tie(
    body: np.ndarray,
    mean: np.ndarray,
    faces: np.ndarray,
    mirror: np.ndarray,
    meetings: Meetings,
    spring: float,
) -> bool:
    """Whether a body's skin cuts itself or is turned over somewhere; ties what does."""
    pairs = faces[intersecting_pairs(body, faces)]
    over = faces[turned_over(body, faces, mean)]
    if len(pairs):
        meetings.tie(nearest(mean, pairs[:, 0], pairs[:, 1]), mirror, spring)
    if len(over):
        meetings.tie(
            np.concatenate([over[:, [0, 1]], over[:, [1, 2]], over[:, [2, 0]]]), mirror, spring
        )
    return bool(len(pairs) or len(over))


def nearest(mean: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """For every corner of triangles `first` (K,3) the nearest corner of its partner in `second`,
    and the reverse.
    """
    gap = np.linalg.norm(mean[first][:, :, None] - mean[second][:, None], axis=3)  # (K, 3, 3)
    rows = np.arange(len(first))[:, None]
    there = np.stack([first, second[rows, gap.argmin(2)]], 2).reshape(-1, 2)
    back = np.stack([second, first[rows, gap.argmin(1)]], 2).reshape(-1, 2)
    pairs = np.concatenate([there, back])
    return pairs[np.linalg.norm(mean[pairs[:, 0]] - mean[pairs[:, 1]], axis=1) < REACH]


def _laplacian(edges: np.ndarray, stiffness: np.ndarray, count: int) -> sparse.csr_matrix:
    a, b = edges.T
    off = sparse.coo_matrix((-stiffness, (a, b)), (count, count))
    off = (off + off.T).tocsr()
    return off - sparse.diags(np.asarray(off.sum(1)).ravel())
