"""What a registration looks like against its template, in a few numbers: size, edges, build, how
its parts are turned.

They are what `habitus.learn.checks` judges a set of registrations by; one registration is in memory
at a time.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.mesh.template import Template

_LONG = 5.0
_SHORT = 0.02
_FLAT = 1e-3
_LEAST = 4  # vertices of a part that tell how it is turned


@dataclass(frozen=True)
class Measures:
    """One registration against its template.

    ``bad`` counts its vertices that are infinite, ``holes`` those that are not there (NaN, or of
    weight 0); the rest is of the others, and only there where nothing is bad and enough is left.
    ``extent`` and ``edge`` are ratios to the template's: of the median distance from the middle,
    and the median over edges. Of the edges, relative to that ``edge``: ``strain`` is their mean
    change, ``long`` and ``short`` the shares over 5 and under 0.02 times the template's; ``flying``
    counts those that cross a third of the body. ``build`` (3J,) is the mean logarithm of edge
    lengths by part and direction, NaN where there are none: it hardly knows the pose. ``turns`` (J,
    3, 3) are the parts' rotations against their parents', ``mirrored`` the share of parts that fit
    better as their mirror image, ``upright`` (3, 3) the rotation of the whole.
    """

    bad: int
    holes: int = 0
    extent: float = 0.0
    edge: float = 0.0
    strain: float = 0.0
    long: float = 0.0
    short: float = 0.0
    flying: int = 0
    build: Float[np.ndarray, " L"] | None = None
    turns: Float[np.ndarray, "J 3 3"] | None = None
    mirrored: float = 0.0
    upright: Float[np.ndarray, "3 3"] | None = None


@dataclass(frozen=True, eq=False)
class Ruler:
    """A template made ready for measuring many registrations against it."""

    template: Template

    @cached_property
    def edges(self) -> Int[np.ndarray, "2 E"]:
        """Each edge once."""
        faces = self.template.faces
        both = np.sort(
            np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1
        )
        return np.ascontiguousarray(np.unique(both, axis=0).T)

    @cached_property
    def lengths(self) -> Float[np.ndarray, " E"]:
        """The template's edges (m)."""
        return _lengths(self.template.vertices, self.edges)

    @cached_property
    def extent(self) -> float:
        """The median distance (m) of the template's vertices from their middle."""
        return _extent(self.template.vertices)

    @cached_property
    def usual(self) -> Int[np.ndarray, " n"]:
        """The edges that are not so short that noise makes of them what it likes."""
        return np.flatnonzero(self.lengths > 0.2 * np.median(self.lengths))

    @cached_property
    def _bins(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " L"]]:
        """The usual edges inside parts, the part and direction of each, and how many are alike."""
        part = self.template.part
        ends = self.edges[:, self.usual]
        inside = np.flatnonzero(part[ends[0]] == part[ends[1]])
        along = np.abs(
            self.template.vertices[ends[0, inside]] - self.template.vertices[ends[1, inside]]
        )
        bins = 3 * part[ends[0, inside]] + along.argmax(axis=1)
        count = np.bincount(bins, minlength=3 * self.template.num_joints).astype(np.float64)
        return inside, bins, np.where(count > 0, count, np.nan)

    @cached_property
    def _parts(self) -> tuple[Int[np.ndarray, " V"], Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
        """The vertices by part, where each part begins, and which parts there are."""
        order = np.argsort(self.template.part, kind="stable")
        joints, starts = np.unique(self.template.part[order], return_index=True)
        return order, starts, joints

    @cached_property
    def _centred(self) -> Float[np.ndarray, "V 3"]:
        order, _, _ = self._parts
        return self.template.vertices[order] - self._middles(self.template.vertices[order])

    @cached_property
    def rigid(self) -> tuple[bool, ...]:
        """Whether each joint has a part whose turns can be told: at least a surface, not a line or
        a point.
        """
        spread = np.linalg.svd(self._scatter(self._centred), compute_uv=False)
        determined = np.zeros(self.template.num_joints, dtype=bool)
        determined[self._parts[2]] = spread[:, 1] > _FLAT * spread[:, 0]
        return tuple(determined.tolist())

    @cached_property
    def _above(self) -> Int[np.ndarray, " J"]:
        """For each joint the next one above it whose turns can be told; itself where there is
        none.
        """
        above = np.arange(self.template.num_joints)
        for joint, parent in enumerate(self.template.parents[1:], 1):
            above[joint] = parent if self.rigid[parent] else above[parent]
        return np.where([self.rigid[joint] for joint in above], above, np.arange(len(above)))

    def _middles(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 3"]:
        """For each of the vertices by part the middle of its part."""
        _, starts, _ = self._parts
        count = np.diff(np.append(starts, len(vertices)))
        return np.repeat(np.add.reduceat(vertices, starts, axis=0) / count[:, None], count, axis=0)

    def _scatter(self, vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "P 3 3"]:
        """For each part the sum over its vertices of their places times the template's, these from
        the middle.
        """
        _, starts, _ = self._parts
        return np.add.reduceat(vertices[:, :, None] * self._centred[:, None, :], starts, axis=0)

    def measure(
        self, vertices: Float[np.ndarray, "V 3"], seen: Bool[np.ndarray, " V"] | None = None
    ) -> Measures:
        """The measures of one registration (m); where it has holes, of the vertices that are
        ``seen``.
        """
        seen = np.ones(len(vertices), dtype=bool) if seen is None else seen
        bad = int((~np.isfinite(vertices)).any(axis=1).sum())
        holes = int((~seen).sum())
        whole = np.all(seen[self.edges], axis=0)
        usual = self.usual[whole[self.usual]]
        if bad or 2 * holes > len(vertices) or not len(usual):
            return Measures(bad, holes)
        lengths = np.where(whole, _lengths(vertices, self.edges), 0.0)
        extent = _extent(vertices[seen]) / (
            self.extent if not holes else _extent(self.template.vertices[seen])
        )
        usual, own, kept = lengths[usual], self.lengths[usual], whole[self.usual]
        ratio = usual / own
        edge = float(np.median(ratio))
        scale = edge if edge > 1e-6 else 1.0
        flying = (lengths > _LONG * scale * self.lengths) & (lengths > 0.66 * scale * self.extent)
        turns, mirrored, upright = self._turns(vertices, seen)
        return Measures(
            bad,
            holes,
            extent,
            edge,
            strain=float(np.abs(usual - scale * own).sum() / (scale * own).sum()),
            long=float((ratio > _LONG * scale).mean()),
            short=float((ratio < _SHORT * scale).mean()),
            flying=int(flying.sum()),
            build=self._build(ratio, kept).astype(np.float32),
            turns=turns.astype(np.float32),
            mirrored=mirrored,
            upright=upright,
        )

    def _build(
        self, ratio: Float[np.ndarray, " n"], kept: Bool[np.ndarray, " E"]
    ) -> Float[np.ndarray, " L"]:
        """Mean logarithms by part and direction of the usual edges that are ``kept``, whose ratios
        are given.
        """
        inside, bins, count = self._bins
        place = np.cumsum(kept) - 1
        here = kept[inside]
        left = (
            count
            if here.all()
            else np.bincount(bins[here], minlength=len(count)).astype(np.float64)
        )
        logs = np.log(ratio[place[inside[here]]].clip(0.05, 20))
        return np.bincount(bins[here], logs, len(count)) / np.where(left > 0, left, np.nan)

    def _turns(
        self, vertices: Float[np.ndarray, "V 3"], seen: Bool[np.ndarray, " V"]
    ) -> tuple[Float[np.ndarray, "J 3 3"], float, Float[np.ndarray, "3 3"]]:
        """Rotations of the parts against their parents' by Procrustes (NaN for parts of which too
        little is seen), the share of parts that are mirrored, and the rotation of the whole.
        """
        order, starts, joints = self._parts
        here = seen[order]
        count = np.add.reduceat(seen[order].astype(float), starts)
        away = np.where(here[:, None], vertices[order], 0.0)
        middle = np.add.reduceat(away, starts, axis=0) / np.maximum(count, 1)[:, None]
        away = np.where(
            here[:, None],
            away - np.repeat(middle, np.diff(np.append(starts, len(order))), axis=0),
            0.0,
        )
        u, _, vt = np.linalg.svd(self._scatter(away))
        sign = np.linalg.det(u @ vt)
        u[:, :, 2] *= sign[:, None]
        world = np.tile(np.eye(3), (self.template.num_joints, 1, 1))
        world[joints] = np.where(
            (count >= min(_LEAST, len(order)))[:, None, None] | here.all(), u @ vt, np.nan
        )
        determined = np.array([self.rigid[joint] for joint in joints])
        mirrored = float((sign[determined] < 0).mean()) if determined.any() else 0.0
        return (
            world[self._above].transpose(0, 2, 1) @ world,
            mirrored,
            _rotation(vertices, self.template.vertices, seen),
        )


def _lengths(
    vertices: Float[np.ndarray, "V 3"], edges: Int[np.ndarray, "2 E"]
) -> Float[np.ndarray, " E"]:
    along = np.take(vertices, edges[0], axis=0, mode="clip") - np.take(
        vertices, edges[1], axis=0, mode="clip"
    )
    return np.sqrt(np.einsum("ei,ei->e", along, along))


def _rotation(
    vertices: Float[np.ndarray, "V 3"],
    others: Float[np.ndarray, "V 3"],
    seen: Bool[np.ndarray, " V"],
) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes ``others`` nearest to ``vertices``."""
    here, there = (points[seen] - points[seen].mean(0) for points in (vertices, others))
    u, _, vt = np.linalg.svd(here.T @ there)
    return (u * [1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _extent(vertices: Float[np.ndarray, "V 3"]) -> float:
    away = vertices - np.median(vertices, axis=0)
    return float(np.sqrt(np.median(np.einsum("vi,vi->v", away, away))))
