"""A scan as it comes made ready: metres, without floor and islands, with outward normals, in random
order.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from habitus.errors import HabitusError
from habitus.fit.registration.model_stage import Cloud
from habitus.fit.registration.normals import outward, plane_normals
from habitus.fit.registration.scan import Scan
from habitus.mesh.normals import vertex_normals

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
LEAST, MOST = 0.5, 2.7
"""Metres: extents that a person may have."""
FEWEST = 1000
KEPT = 40_000
"""Points that are fitted."""
FLOOR_SHARE, FLOOR_BAND, FLOOR_TRIES = 0.08, 0.006, 200
"""Of the points at least so many lie in a floor, which is so thick (of the scan's extent)."""
ISLAND_LINK, ISLAND_NEAR, ISLAND_SHARE = 0.03, 0.06, 0.004
"""Of the extent: points so near are of one piece, and pieces so near the largest are of the person,
if they have at least that share of its points.
"""


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A scan in metres, in its own axes, what of it is fitted, and whither the floor's normal
    points, if there is one.

    ``kept`` are the rows of ``scan.points`` that are of the person.
    """

    scan: Scan
    cloud: Cloud
    kept: Bool[np.ndarray, " N"]
    scale: float
    floor_up: Float[np.ndarray, " 3"] | None
    notes: tuple[str, ...]


def cleaned(scan: Scan, unit: str = "auto", seed: int = 0) -> Cleaned:
    """The scan made ready to be fitted.

    Raises HabitusError for too few points, numbers that are not finite, and sizes that no person
    has in any unit.
    """
    if unit != "auto" and unit not in UNITS:
        raise HabitusError(f"unit is {unit!r}; expected auto, {', '.join(UNITS)}")
    finite = np.isfinite(scan.points).all(1)
    if finite.sum() < FEWEST:
        raise HabitusError(
            f"{scan.name}: {int(finite.sum())} points; expected the scan of a person, {FEWEST} at "
            "least"
        )
    rng = np.random.default_rng(seed)
    notes = []
    kept = finite.copy()
    some = np.flatnonzero(finite)
    some = some[rng.permutation(len(some))[:20_000]]
    floor = find_floor(scan.points[some], rng)
    if floor is not None:
        normal, height, band = floor
        kept &= scan.points @ normal > height + band
        if kept.sum() < FEWEST:
            raise HabitusError(
                f"{scan.name}: a plane and nothing else; expected the scan of a person"
            )
        notes.append(
            f"a floor with {(finite & ~kept).sum() / finite.sum():.0%} of the points was left out"
        )
    islands = _off(scan.points, kept, rng)
    if islands.any():
        notes.append(
            f"islands with {islands.sum() / max(kept.sum(), 1):.1%} of the points were left out"
        )
        kept &= ~islands
    scale, said = _scale(scan, kept, unit)
    cloud = _cloud(scan, kept, scale, rng)
    return Cleaned(
        scan, cloud, kept, scale, None if floor is None else floor[0], (*scan.notes, *said, *notes)
    )


def _scale(scan: Scan, kept: np.ndarray, unit: str) -> tuple[float, list[str]]:
    """Metres of one of the scan's units, and what is said of it."""
    points = scan.points[kept]
    points = points[:: max(1, len(points) // 20_000)]
    axes = np.linalg.eigh(np.cov(points.T))[1]
    low, high = np.percentile(points @ axes, (0.2, 99.8), axis=0)
    extent = float((high - low).max())
    if unit != "auto":
        size = extent * UNITS[unit]
        if not LEAST <= size <= MOST:
            raise HabitusError(
                f"{scan.name}: {size:.3g} m large in {unit}; expected a person, {LEAST} to {MOST} m"
            )
        return UNITS[unit], []
    for name in ("m", "cm", "mm"):
        if LEAST <= extent * UNITS[name] <= MOST:
            said = (
                []
                if name == "m"
                else [f"its numbers are read as {name}: {extent * UNITS[name]:.2f} m large"]
            )
            return UNITS[name], said
    raise HabitusError(
        f"{scan.name}: {extent:.4g} large; expected a person of {LEAST} to {MOST} m in m, cm or "
        "mm; "
        "say the unit, and cut away what is not the person"
    )


def _cloud(scan: Scan, kept: np.ndarray, scale: float, rng: np.random.Generator) -> Cloud:
    rows = np.flatnonzero(kept)
    rows = rows[rng.permutation(len(rows))[:KEPT]]
    points = scale * scan.points[rows]
    normals = None if scan.normals is None else scan.normals[rows]
    if normals is None and scan.faces is not None:
        normals = vertex_normals(scan.points, scan.faces)[rows]
    if normals is None or (np.linalg.norm(normals, axis=1) < 0.5).mean() > 0.02:
        normals, near = plane_normals(points)
        return Cloud(points, outward(points, normals, near))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    good = length[:, 0] > 0.5
    points = points[good]
    normals = normals[good] / length[good]
    near = cKDTree(points).query(points, k=min(16, len(points)))[1]
    return Cloud(points, outward(points, normals, near, carry=False))


def find_floor(
    points: Float[np.ndarray, "N 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, " 3"], float, float] | None:
    """Normal (towards the person), place along it and thickness of a plane that bounds the scan;
    None without one.
    """
    extent = float(np.ptp(points, axis=0).max())
    band = FLOOR_BAND * extent
    best = 0
    found = None
    for _ in range(FLOOR_TRIES):
        a, b, c = points[rng.integers(0, len(points), 3)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < (0.05 * extent) ** 2:
            continue
        normal = normal / length
        along = points @ normal
        inside = np.abs(along - a @ normal) < 0.5 * band
        if inside.sum() > max(best, FLOOR_SHARE * len(points)):
            above = (along > a @ normal + band).mean()
            below = (along < a @ normal - band).mean()
            if min(above, below) < 0.01 < max(above, below) and _wide(points[inside], extent):
                sign = 1.0 if above > below else -1.0
                best = int(inside.sum())
                found = (sign * normal, float(sign * (a @ normal)), band)
    return found


def _wide(points: np.ndarray, extent: float) -> bool:
    """Whether a piece of plane is as large as a floor: a chest, pressed flat, is not."""
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    return bool(spread[1] > 0.1 * extent)


def _off(points: np.ndarray, kept: np.ndarray, rng: np.random.Generator) -> Bool[np.ndarray, " N"]:
    """Points of islands: pieces that are far from the largest, or hardly more than dust."""
    rows = np.flatnonzero(kept)
    few = rows[rng.permutation(len(rows))[:8000]]
    some = points[few]
    size = float((np.percentile(some, 99, axis=0) - np.percentile(some, 1, axis=0)).max())
    tree = cKDTree(some)
    spacing = float(np.percentile(tree.query(some, k=2)[0][:, 1], 90))
    pairs = tree.query_pairs(max(ISLAND_LINK * size, 2.5 * spacing), output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(some),) * 2)
    piece = connected_components(graph, directed=False)[1]
    count = np.bincount(piece)
    main = cKDTree(some[piece == count.argmax()])
    apart = main.query(some)[0]
    gone = np.zeros(len(count), dtype=bool)
    for k in range(len(count)):
        near = apart[piece == k].min() < ISLAND_NEAR * size
        gone[k] = not near or count[k] < ISLAND_SHARE * len(some)
    gone[count.argmax()] = False
    off = np.zeros(len(points), dtype=bool)
    if gone.any():
        off[rows] = gone[piece][tree.query(points[rows])[1]]
    return off


def turned(one: Cleaned, turn: Float[np.ndarray, "3 3"]) -> tuple[Scan, Cloud]:
    """The scan with ``turn`` (3, 3) made upright, in metres: what of it is of the person, and what
    is fitted.
    """
    motion = np.eye(4)
    motion[:3, :3] = one.scale * turn
    scan = one.scan
    kept = one.kept
    points = one.scale * scan.points[kept] @ turn.T
    whole = replace(
        scan,
        points=points,
        normals=None,
        faces=None,
        to_body=motion @ scan.to_body,
        notes=one.notes,
    )
    return whole, Cloud(one.cloud.points @ turn.T, one.cloud.normals @ turn.T)
