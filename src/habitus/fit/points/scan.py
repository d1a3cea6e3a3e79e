"""A scan: points of a person's surface, and how they are prepared for fits: metres, no floor and
islands, outward normals, random order.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from habitus.errors import HabitusError
from habitus.fit.points.settings import SCANS, CleaningSettings
from habitus.mesh.normals import face_normals, vertex_normals


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (N, 3) of a surface, in metres and y up once
    `habitus.fit.points.scan.cleaned` has seen them.

    ``normals`` (N, 3) are unit, outward where ``oriented``, else of either sign. ``faces`` (F, 3)
    where it was a mesh. ``colours`` (M, 3) are linear light, 0 to 1 (files hold sRGB; readers make
    it linear), of the points themselves or of ``colour_places`` (M, 3), in the same unit and axes:
    a picture shows more of a surface than its points. ``to_body`` (4, 4) took the file's own
    numbers to these; ``notes`` say in sentences what was found and done.
    """

    name: str
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"] | None = None
    faces: Int[np.ndarray, "F 3"] | None = None
    oriented: bool = True
    to_body: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()
    colours: Float[np.ndarray, "M 3"] | None = None
    colour_places: Float[np.ndarray, "M 3"] | None = None


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (N, 3) of a scan, in metres and y up, in random order, and their normals (N, 3),
    outward. The length of a normal, at most 1, is its certainty (`plane_normals`). ``signed``: the
    signs of the normals come with the scan, as those of a mesh do, and were not estimated.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    signed: bool = False

    def first(self, count: int) -> "Cloud":
        """Some of them."""
        return Cloud(self.points[:count], self.normals[:count], self.signed)

    @property
    def unit_normals(self) -> Float[np.ndarray, "N 3"]:
        """The normals scaled to length 1."""
        return self.normals / np.maximum(np.linalg.norm(self.normals, axis=1, keepdims=True), 1e-12)


UNITS: Mapping[str, float] = MappingProxyType(
    {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
)


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A scan prepared for fits: in its own axes, the cloud of its points in metres, the factor from
    its unit to metres, and the direction of the floor's normal, if there is a floor.

    ``kept`` are the rows of ``scan.points`` that are of the person; ``islands`` is the share of the
    points without the floor that lie in pieces apart from the person and were left out.
    """

    scan: Scan
    cloud: Cloud
    kept: Bool[np.ndarray, " N"]
    scale: float
    floor_up: Float[np.ndarray, " 3"] | None
    notes: tuple[str, ...]
    islands: float = 0.0


def cleaned(
    scan: Scan, unit: str = "auto", seed: int = 0, settings: CleaningSettings = SCANS.cleaning
) -> Cleaned:
    """The scan prepared for fits: metres, without floor and islands, with outward normals.

    Raises HabitusError for too few points, numbers that are not finite, and sizes that no person
    has in any unit.
    """
    if unit != "auto" and unit not in UNITS:
        raise HabitusError(f"unit is {unit!r}; expected auto, {', '.join(UNITS)}")
    finite = np.asarray(np.isfinite(scan.points).all(1))
    if finite.sum() < settings.min_points:
        raise HabitusError(
            f"{scan.name}: {int(finite.sum())} points; expected the scan of a person, "
            f"{settings.min_points} at least"
        )
    rng = np.random.default_rng(seed)
    notes = []
    kept = finite.copy()
    some = np.flatnonzero(finite)
    some = some[rng.permutation(len(some))[:20_000]]
    floor = find_floor(scan.points[some], rng, settings)
    if floor is not None:
        normal, height, band = floor
        kept &= scan.points @ normal > height + band
        if kept.sum() < settings.min_points:
            raise HabitusError(
                f"{scan.name}: a plane and nothing else; expected the scan of a person"
            )
        notes.append(
            f"a floor with {(finite & ~kept).sum() / finite.sum():.0%} of the points was left out"
        )
    islands = _islands(scan.points, kept, rng, settings)
    island_share = float(islands.sum() / max(kept.sum(), 1))
    if islands.any():
        notes.append(f"islands with {island_share:.1%} of the points were left out")
        kept &= ~islands
    scale, unit_notes = _scale(scan, kept, unit, settings)
    cloud = _cloud(scan, kept, scale, rng, settings)
    return Cleaned(
        scan,
        cloud,
        kept,
        scale,
        None if floor is None else floor[0],
        (*scan.notes, *unit_notes, *notes),
        island_share,
    )


def _scale(
    scan: Scan, kept: np.ndarray, unit: str, settings: CleaningSettings
) -> tuple[float, list[str]]:
    """The factor from the scan's unit to metres, and a note on it."""
    least, most = settings.min_extent, settings.max_extent
    points = scan.points[kept]
    points = points[:: max(1, len(points) // 20_000)]
    axes = np.linalg.eigh(np.cov(points.T))[1]
    low, high = np.percentile(points @ axes, (0.2, 99.8), axis=0)
    extent = float((high - low).max())
    if unit != "auto":
        size = extent * UNITS[unit]
        if not least <= size <= most:
            raise HabitusError(
                f"{scan.name}: {size:.3g} m large in {unit}; expected a person, {least} to {most} m"
            )
        return UNITS[unit], []
    for name in ("m", "cm", "mm"):
        if least <= extent * UNITS[name] <= most:
            notes = (
                []
                if name == "m"
                else [f"its numbers are read as {name}: {extent * UNITS[name]:.2f} m large"]
            )
            return UNITS[name], notes
    raise HabitusError(
        f"{scan.name}: {extent:.4g} large; expected a person of {least} to {most} m in m, cm or "
        "mm; "
        "say the unit, and cut away what is not the person"
    )


def _cloud(
    scan: Scan,
    kept: np.ndarray,
    scale: float,
    rng: np.random.Generator,
    settings: CleaningSettings,
) -> Cloud:
    points, normals = _surface_points(scan, kept, settings.max_points, rng)
    points = scale * points
    if normals is None or (np.linalg.norm(normals, axis=1) < 0.5).mean() > 0.02:
        normals, near = plane_normals(points, settings)
        return Cloud(points, outward(points, normals, near, settings=settings))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    good = length[:, 0] > 0.5
    points = points[good]
    normals = normals[good] / length[good]
    near = neighbours_of(points, settings.normal_neighbours)
    normals = outward(points, normals, near, carry=False, settings=settings)
    return Cloud(points, normals, scan.oriented)


def _surface_points(
    scan: Scan, kept: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"] | None]:
    """Some points that are kept, and their normals where the scan has them: of a mesh drawn evenly
    from its faces, whose vertices may be few, or dense at hands and face.
    """
    normals = scan.normals
    if scan.faces is not None and len(scan.faces):
        faces = scan.faces[kept[scan.faces].all(1)]
        area = np.linalg.norm(face_normals(scan.points, faces), axis=1)
        if area.sum() > 0.0:
            if normals is None:
                normals = vertex_normals(np.where(kept[:, None], scan.points, 0.0), faces)
            face = faces[rng.choice(len(faces), count, p=area / area.sum())]
            share = rng.dirichlet((1.0, 1.0, 1.0), count)
            points, normals = (
                np.einsum("pk,pkc->pc", share, each[face]) for each in (scan.points, normals)
            )
            return points, normals
    rows = np.flatnonzero(kept)
    rows = rows[rng.permutation(len(rows))[:count]]
    return scan.points[rows], None if normals is None else normals[rows]


def find_floor(
    points: Float[np.ndarray, "N 3"],
    rng: np.random.Generator,
    settings: CleaningSettings = SCANS.cleaning,
) -> tuple[Float[np.ndarray, " 3"], float, float] | None:
    """Normal (towards the person), position along it and thickness of a plane that bounds the scan;
    None without one.
    """
    extent = float(np.ptp(points, axis=0).max())
    band = settings.floor_thickness * extent
    best = 0
    floor = None
    for _ in range(settings.floor_tries):
        a, b, c = points[rng.integers(0, len(points), 3)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < (0.05 * extent) ** 2:
            continue
        normal = normal / length
        along = points @ normal
        inside = np.abs(along - a @ normal) < 0.5 * band
        if inside.sum() > max(best, settings.floor_share * len(points)):
            above = (along > a @ normal + band).mean()
            below = (along < a @ normal - band).mean()
            if min(above, below) < 0.01 < max(above, below) and _wide(points[inside], extent):
                sign = 1.0 if above > below else -1.0
                best = int(inside.sum())
                floor = (sign * normal, float(sign * (a @ normal)), band)
    return floor


def _wide(points: np.ndarray, extent: float) -> bool:
    """Whether a piece of plane is as large as a floor: a chest, pressed flat, is not."""
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    return bool(spread[1] > 0.1 * extent)


def _islands(
    points: np.ndarray, kept: np.ndarray, rng: np.random.Generator, settings: CleaningSettings
) -> Bool[np.ndarray, " N"]:
    """Points of islands: pieces that are far from the largest, or hardly more than dust."""
    rows = np.flatnonzero(kept)
    few = rows[rng.permutation(len(rows))[:8000]]
    some = points[few]
    size = float((np.percentile(some, 99, axis=0) - np.percentile(some, 1, axis=0)).max())
    tree = KDTree(some)
    spacing = float(np.percentile(tree.query(some, k=2)[0][:, 1], 90))
    pairs = tree.query_pairs(max(settings.island_link * size, 2.5 * spacing), output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(some),) * 2)
    piece = connected_components(graph, directed=False)[1]
    count = np.bincount(piece)
    main = KDTree(some[piece == count.argmax()])
    distances = main.query(some)[0]
    gone = np.zeros(len(count), dtype=bool)
    for k in range(len(count)):
        near = distances[piece == k].min() < settings.island_reach * size
        gone[k] = not near or count[k] < settings.island_share * len(some)
    gone[count.argmax()] = False
    off = np.zeros(len(points), dtype=bool)
    if gone.any():
        off[rows] = gone[piece][tree.query(points[rows])[1]]
    return off


def turned(cleaned: Cleaned, turn: Float[np.ndarray, "3 3"]) -> tuple[Scan, Cloud]:
    """The scan with ``turn`` (3, 3) made upright, in metres: what of it is of the person, and what
    is fitted.
    """
    motion = np.eye(4)
    motion[:3, :3] = cleaned.scale * turn
    scan = cleaned.scan
    kept = cleaned.kept
    points = cleaned.scale * scan.points[kept] @ turn.T
    whole = replace(
        scan,
        points=points,
        normals=None,
        faces=None,
        to_body=motion @ scan.to_body,
        notes=cleaned.notes,
    )
    return whole, replace(
        cleaned.cloud, points=cleaned.cloud.points @ turn.T, normals=cleaned.cloud.normals @ turn.T
    )


CHUNK = 20_000  # points at once: bounds memory, changes no result


def neighbours_of(points: Float[np.ndarray, "N 3"], count: int) -> Int[np.ndarray, "N K"]:
    """Each point's nearest ones, itself first; ``count`` of them, if there are so many."""
    near = KDTree(points).query(points, k=min(count, len(points)))[1]
    return np.asarray(near).reshape(len(points), -1)


def plane_normals(
    points: Float[np.ndarray, "N 3"], settings: CleaningSettings = SCANS.cleaning
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "N K"]]:
    """The normal (of either sign) of the plane through each point's neighbours, and these.

    points: (N, 3), metres. Neighbours are weighted by a Gaussian of their distance (sd
    `normal_radius`, larger where points are sparse). The length of a normal is its certainty,
    1 - l0 / l1, with l0 <= l1 the two smallest eigenvalues of the weighted covariance: 1 for points
    in a plane, 0 for points along a line or all around, as at the fingers of a sparse scan. On
    simulated people the mean absolute cosine between estimated and true normals is about
    1 - 0.6 l0 / l1 for ratios up to 0.6.
    """
    distance, near = KDTree(points).query(points, k=min(settings.normal_neighbours, len(points)))
    distance, near = (np.asarray(each).reshape(len(points), -1) for each in (distance, near))
    nearest = distance[:, min(settings.normal_nearest, distance.shape[1] - 1), None]
    weight = np.exp(-0.5 * (distance / np.maximum(settings.normal_radius, nearest)) ** 2)
    weight /= weight.sum(1, keepdims=True)
    normals = np.empty_like(points)
    for begin in range(0, len(points), CHUNK):
        part = slice(begin, begin + CHUNK)
        some, share = points[near[part]], weight[part, None]
        some = some - share @ some
        values, vectors = np.linalg.eigh((some.transpose(0, 2, 1) * share) @ some)
        flat = 1.0 - values[:, :1] / np.maximum(values[:, 1:2], 1e-18)
        normals[part] = np.clip(flat, 0.0, 1.0) * vectors[..., 0]
    return normals, near


def outward(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    near: Int[np.ndarray, "N K"],
    carry: bool = True,
    settings: CleaningSettings = SCANS.cleaning,
) -> Float[np.ndarray, "N 3"]:
    """The same normals with one sign a sheet, carried from neighbour to neighbour, then outward on
    the whole.

    Hoppe et al. 1992: along the tree on which neighbours' normals change least. Every connected
    part is turned so that it is round outside: limbs and trunk are. Without ``carry`` the signs are
    trusted to agree, and only the whole is turned.
    """
    if not carry:
        return normals * (1.0 if _roundness(points, normals, settings) >= 0.0 else -1.0)
    count = len(points)
    others = near[:, 1 : settings.sign_neighbours + 1]
    rows = np.repeat(np.arange(count), others.shape[1])
    bend = 1.0 - np.abs((normals[rows] * normals[others.ravel()]).sum(1)) + 1e-3
    tree = minimum_spanning_tree(
        coo_array((bend, (rows, others.ravel())), shape=(count, count)).tocsr()
    )
    tree = tree + tree.T
    sign = np.zeros(count)
    left = np.ones(count, dtype=bool)
    while left.any():
        first = int(np.flatnonzero(left)[0])
        order, before = breadth_first_order(tree, first, directed=False)
        _carry(order, before, normals, sign)
        left[order] = False
        if _roundness(points[order], normals[order] * sign[order, None], settings) < 0.0:
            sign[order] *= -1.0
    return normals * sign[:, None]


def agreed(
    normals: Float[np.ndarray, "N 3"],
    others: Float[np.ndarray, "N 3"],
    near: Int[np.ndarray, "N K"] | None = None,
) -> Float[np.ndarray, "N 3"]:
    """The normals, reversed where they point against ``others`` (zero where unknown: kept).

    near: neighbours of each point, itself included, where signs are consistent within a surface
    patch; a point is then reversed by the mean over its neighbours. For estimated signs leave it
    out: in a sparse scan the neighbours of a point on the sole may lie on the instep.
    """
    against = (normals * others).sum(1) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    if near is not None:
        along = np.einsum("nc,nkc->nk", normals, normals[near])
        against = (np.sign(along) * against[near]).mean(1)
    return np.where(against < -0.1, -1.0, 1.0)[:, None] * normals


def _roundness(points: np.ndarray, normals: np.ndarray, settings: CleaningSettings) -> float:
    """How far points stand out, along their normals, from the middles of what is around them."""
    some = slice(None, None, max(1, len(points) // settings.outside_points))
    few = points[some]
    around = few[neighbours_of(few, settings.outside_neighbours)].mean(1)
    return float(((few - around) * normals[some]).sum())


def _carry(order: np.ndarray, before: np.ndarray, normals: np.ndarray, sign: np.ndarray) -> None:
    """Signs along a tree, from its root on."""
    sign[order[0]] = 1.0
    agree = np.ones(len(order))
    agree[1:] = np.sign((normals[order[1:]] * normals[before[order[1:]]]).sum(1))
    agree[agree == 0.0] = 1.0
    for place, parent, same in zip(
        order[1:].tolist(), before[order[1:]].tolist(), agree[1:].tolist(), strict=True
    ):
        sign[place] = sign[parent] * same
