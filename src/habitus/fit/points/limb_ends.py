"""Poses by the ends of the limbs: head, hands and feet of a scan, found on its surface.

An end is a point whose mean distance over the surface (geodesic; Hilaga et al., SIGGRAPH 2001) to
all others is the largest within some reach. Distances between ends hardly depend on the pose: they
tell head, hands and feet from each other, though not left from right. For each likely way to name
the ends, the most similar pose of a bank is moved onto them, bent until they meet, and fitted to
the whole scan while they hold. A limb that lies on the body has no end; one may be missing. The
energy of a state, by which those fitted to the ends alone are ranked:

    1/2 sum_e |x_e - target_e|^2 / end_sd^2 + 1/2 mean_m |x_m - target|^2 / middle_sd^2
    + 1/2 (theta - mean)^T P (theta - mean) + missing

e are ends, m vertices of the middle; ``missing`` counts once where an end was not
found (`LimbEndSettings`).
"""

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from habitus.body.model import BodyModel
from habitus.body.skinning import descends
from habitus.body.state import BodyState
from habitus.fit.points.correspondences import corners_of, points_around
from habitus.fit.points.limb_settings import LimbEndSettings
from habitus.fit.points.scan import Cloud
from habitus.fit.points.scan_fitting import ScanFitter
from habitus.fit.points.scan_stage import ScanStage
from habitus.mesh.normals import vertex_normals
from habitus.parallel.workers import map_on_threads
from habitus.residuals.points import PointObservations
from habitus.rotations import matrix_from_rotvec, procrustes, rotvec_from_matrix
from habitus.solve.terms import Term

END_JOINTS = ("head", "left_wrist", "right_wrist", "left_ankle", "right_ankle")
"""The joints that carry the ends."""
SCALES = (0.7, 1.2)
"""Sizes of people in that of the body, between which ends are compared."""


@dataclass(frozen=True, eq=False)
class Ends:
    """Ends of a surface: which of its points, the furthest first; their distances over the surface
    (m); and the points of its middle, from which all others are nearest.
    """

    points: Int[np.ndarray, " E"]
    distances: Float[np.ndarray, "E E"]
    middle: Int[np.ndarray, " M"]


def find_ends(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    settings: LimbEndSettings,
) -> Ends:
    """The ends of a surface, of which points (m) in random order and their normals are given."""
    graph = _surface_graph(points, normals, settings)
    sources = np.linspace(0, len(points) - 1, settings.sources).astype(int)
    mean = dijkstra(graph, directed=False, indices=sources).mean(0)
    ends: list[int] = []
    beaten = np.zeros(len(points), bool)
    for point in np.argsort(-mean):
        if beaten[point] or len(ends) == settings.most_ends:
            continue
        near = np.isfinite(dijkstra(graph, directed=False, indices=point, limit=settings.reach))
        if mean[near].max() <= mean[point]:
            ends.append(int(point))
            beaten |= near
    distances = dijkstra(graph, directed=False, indices=ends)[:, ends]
    middle = np.argsort(mean)[: max(1, int(settings.middle_share * len(points)))]
    return Ends(np.array(ends, np.int64), distances, middle)


def _surface_graph(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    settings: LimbEndSettings,
) -> csr_array:
    """Lengths (m) between neighbours whose normals are not opposite; pieces are joined where they
    are nearest.
    """
    count = min(settings.neighbours, len(points) - 1)
    length, near = (np.asarray(each)[:, 1:] for each in KDTree(points).query(points, k=count + 1))
    rows = np.repeat(np.arange(len(points)), count)
    columns = near.ravel()
    same_side = (normals[rows] * normals[columns]).sum(1) > settings.min_cosine
    graph = _graph(rows[same_side], columns[same_side], length.ravel()[same_side], len(points))
    pieces, piece = connected_components(graph, directed=False)
    first, *others = np.argsort(-np.bincount(piece, minlength=pieces))
    joined = piece == first
    bridges = []
    for other in others:
        mine, theirs = np.flatnonzero(piece == other), np.flatnonzero(joined)
        gap, nearest = (np.asarray(each) for each in KDTree(points[theirs]).query(points[mine]))
        least = int(gap.argmin())
        bridges.append((mine[least], theirs[nearest[least]], gap[least]))
        joined[mine] = True
    if not bridges:
        return graph
    one, two, gap = (np.array(each) for each in zip(*bridges, strict=True))
    return csr_array(graph.maximum(_graph(one, two, gap, len(points))))


def _graph(rows: np.ndarray, columns: np.ndarray, length: np.ndarray, size: int) -> csr_array:
    """Undirected; points in one place are still neighbours."""
    graph = csr_array((np.maximum(length, 1e-9), (rows, columns)), shape=(size, size))
    return csr_array(graph.maximum(graph.T))


class _Try(NamedTuple):
    """A state bent to some ends of a scan, and its energy."""

    energy: float
    state: BodyState
    goal: PointObservations


@dataclass(frozen=True, eq=False)
class EndSearch:
    """A body prepared for the search by ends.

    ``distances`` are those of its own ends, in the order of `END_JOINTS`; ``face`` and ``corner``
    the vertices of the ends, then some of the middle; ``places`` the ends and the mean of the
    middle (m) in each of the ``poses``.
    """

    fitter: ScanFitter
    distances: Float[np.ndarray, "5 5"]
    face: Int[np.ndarray, " C"]
    corner: Int[np.ndarray, " C"]
    poses: Float[np.ndarray, "P J 3"]
    places: Float[np.ndarray, "P 6 3"]

    @staticmethod
    def of(fitter: ScanFitter, poses: Float[np.ndarray, "P J 3"]) -> "EndSearch | None":
        """To be made once a body; None where its first ends are not one of each of `END_JOINTS`."""
        body, settings = fitter.body, fitter.settings.ends
        rest = body.rest_vertices(np.zeros(body.num_betas))
        shown = np.random.default_rng(0).permutation(fitter.topology.whole)
        ends = find_ends(rest[shown], vertex_normals(rest, body.faces)[shown], settings)
        owner = _owners(body)[shown[ends.points]][: len(END_JOINTS)]
        if sorted(owner) != [*range(len(END_JOINTS))]:
            return None
        order = np.argsort(owner)
        middle = shown[ends.middle[:: settings.middle_step]]
        vertices = np.concatenate([shown[ends.points[order]], middle])
        unique, place = np.unique(vertices, return_inverse=True)
        prepared = body.prepare(np.zeros(body.num_betas), unique)
        posed = np.asarray(prepared(poses, np.zeros(3)).vertices)[:, place]
        count = len(END_JOINTS)
        places = np.concatenate([posed[:, :count], posed[:, count:].mean(1, keepdims=True)], 1)
        distances = ends.distances[np.ix_(order, order)]
        face, corner = corners_of(body.faces, vertices)
        return EndSearch(fitter, distances, face, corner, poses, places)

    @property
    def settings(self) -> LimbEndSettings:
        """Of the search."""
        return self.fitter.settings.ends

    def starts(self, cloud: Cloud) -> list[BodyState]:
        """States whose ends lie as the scan's do, the most probable first."""
        few = cloud.first(self.settings.points)
        ends = find_ends(few.points, few.unit_normals, self.settings)
        middle = few.points[ends.middle].mean(0)

        def tried(naming: tuple[list[int], list[int]]) -> _Try:
            which, labels = naming
            target = np.concatenate([few.points[ends.points[which]], middle[None]])
            goal = self._goal(target, labels)
            state = self._bent(self._moved(target, labels), goal)
            missing = self.settings.missing * (len(END_JOINTS) - len(labels))
            return _Try(self._energy(state, goal) + missing, state, goal)

        tries = sorted(map_on_threads(tried, self._namings(ends)), key=lambda one: one.energy)
        kept = tries[: self.settings.kept]
        return map_on_threads(lambda one: self._bent(one.state, one.goal, cloud), kept)

    def _namings(self, ends: Ends) -> list[tuple[list[int], list[int]]]:
        """Which ends of a scan may be which of `END_JOINTS`, by their distances over the surface;
        the likeliest.
        """
        scored = []
        for count in (len(END_JOINTS), len(END_JOINTS) - 1):
            which = np.array(list(permutations(range(len(ends.points)), count)), np.int64)
            if not len(which):
                continue
            one, two = np.triu_indices(count, 1)
            measured = ends.distances[which[:, one], which[:, two]]
            for labels in combinations(range(len(END_JOINTS)), count):
                known = self.distances[np.ix_(labels, labels)][one, two]
                scale = np.clip(measured @ known / (known @ known), *SCALES)
                off = np.abs(measured / scale[:, None] - known).mean(1)
                off += self.settings.missing_distance * (len(END_JOINTS) - count)
                best = np.argsort(off)[: self.settings.namings]
                scored += [(off[k], which[k].tolist(), list(labels)) for k in best]
        scored.sort(key=lambda each: each[0])
        return [each[1:] for each in scored[: self.settings.namings]]

    def _moved(self, target: Float[np.ndarray, "E 3"], labels: list[int]) -> BodyState:
        """The pose of the bank whose ends and middle are nearest to their targets, moved there."""
        off, turn, shift = aligned(self.places[:, [*labels, len(END_JOINTS)]], target)
        best = int(off.argmin())
        body = self.fitter.body
        pose = self.poses[best].copy()
        pose[0] = rotvec_from_matrix(turn[best] @ matrix_from_rotvec(pose[0]))
        root = body.rest_joints(np.zeros(body.num_betas))[0]
        trans = turn[best] @ root + shift[best] - root
        return BodyState(np.zeros(body.num_betas), pose[None], trans[None])

    def _goal(self, target: Float[np.ndarray, "E 3"], labels: list[int]) -> PointObservations:
        """Ends drawn to their targets, and all of the middle to the last of these."""
        settings = self.settings
        used = np.r_[labels, len(END_JOINTS) : len(self.face)]
        middle = len(used) - len(labels)
        counts = [len(labels), middle]
        spread = np.repeat([settings.end_sd, np.sqrt(middle) * settings.middle_sd], counts)
        places = np.concatenate([target[:-1], np.repeat(target[-1:], middle, 0)])
        shares = np.eye(3)[self.corner[used]]
        return PointObservations.to_points(self.face[used], shares, places, spread**-2.0)

    def _bent(
        self, state: BodyState, goal: PointObservations, cloud: Cloud | None = None
    ) -> BodyState:
        """A state bent until its ends are at their targets, as far as the priors allow; fitted to
        the whole cloud meanwhile, if there is one.
        """
        fitter = self.fitter

        def terms_at(values: dict[str, Any], stage: ScanStage, step: int) -> dict[str, Term]:
            now = BodyState(**values)
            terms = {"ends": points_around(fitter.solver, now, [goal]), **fitter.priors(stage)}
            if cloud is not None:
                points = fitter.points(now, 0, cloud, stage)
                terms["points"] = points_around(fitter.solver, now, [points])
            return terms

        stages = self.settings.stages if cloud is None else self.settings.cloud_stages
        return fitter.minimized(terms_at, state, stages).state

    def _energy(self, state: BodyState, goal: PointObservations) -> float:
        """Of a state: how far its ends are off, and how rare its pose is."""
        corners = self.fitter.vertices(state)[self.fitter.body.faces[goal.face]]
        off = (goal.barycentric[..., None] * corners).sum(1) - goal.target
        missed = (goal.directions @ off[..., None])[..., 0]
        prior = self.fitter.prior
        deviation = prior.whitening @ (state.pose[0, 1:].ravel() - prior.mean)
        return float(0.5 * (np.square(missed).sum() + deviation @ deviation))


def _owners(body: BodyModel) -> Int[np.ndarray, " V"]:
    """Which of `END_JOINTS` carries each vertex, -1 for none."""
    below = descends(body.parents) > 0
    owner = np.full(body.num_vertices, -1)
    for k, name in enumerate(END_JOINTS):
        if name in body.joint_names:
            carried = np.flatnonzero(below[body.joint_names.index(name)])
            owner[np.isin(body.strongest_joint, carried)] = k
    return owner


def aligned(
    places: Float[np.ndarray, "P E 3"], target: Float[np.ndarray, "E 3"]
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, "P 3 3"], Float[np.ndarray, "P 3"]]:
    """Root mean square distance (m) of places from targets under the best rotation, translation and
    scale (within `SCALES`), for each of P; the rotation, and the translation without the scale.
    """
    turn, shift = procrustes(places, np.broadcast_to(target, places.shape))
    off = (places - places.mean(1, keepdims=True)) @ turn.mT
    wanted = target - target.mean(0)
    scale = np.clip((off * wanted).sum((1, 2)) / np.square(off).sum((1, 2)), *SCALES)
    left = scale[:, None, None] * off - wanted
    return np.sqrt(np.square(left).sum(2).mean(1)), turn, shift
