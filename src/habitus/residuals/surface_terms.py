"""Terms of points, depth images, silhouettes and joints: correspondences at each linearisation.

Each makes `habitus.residuals.points` of what it observes: for the state at hand it finds which
point of the surface each observation belongs to, and gives normal equations with that
correspondence held, as iterated closest points do. Its cost is

    1/2 sum_p rho(m_p^2),   m_p^2 = ((n . r)^2 + slide |r|^2) / s^2,   rho = S m^2 / (S + m^2)

with the residual r of point p, its noise s and S = (reach / s)^2: Geman-McClure's loss, of which
points without correspondence cost the most, S. A step is accepted by this cost, correspondences
found anew; its gradient is that of the cost wherever correspondences do not change.

A term takes betas (B,), pose (J, 3) or (T, J, 3) and trans (3,) or (T, 3); ``frame`` says which of
several poses it observes. Cameras and points are in the frame of trans (m).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.arrays import to_numpy
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.mesh.proximity import barycentric_coordinates, closest_points, triangle_normals
from habitus.residuals.points import (
    JointObservations,
    PointObservations,
    PointSolver,
    points_on_surface,
    points_term,
)
from habitus.solve.terms import Quadratic
from habitus.types import Array

if TYPE_CHECKING:
    from habitus.observe.camera import Camera

MIN_COSINE = 0.3
"""Between a point's normal and the surface's; below it the two are of different sides."""


class Matched(NamedTuple):
    """Observations whose correspondences and robust weights are held, and their robust cost."""

    points: PointObservations
    cost: float


@dataclass(frozen=True, eq=False)
class _OfOneFrame:
    """A term of points that are matched to the surface of one frame."""

    body: BodyModel | PointSolver

    @cached_property
    def solver(self) -> PointSolver:
        """The body made ready."""
        return self.body if isinstance(self.body, PointSolver) else PointSolver.of(self.body)

    def matched(self, vertices: Float[np.ndarray, "V 3"]) -> Matched:
        """The observations at a surface (m)."""
        raise NotImplementedError

    def __call__(self, betas: Array, pose: Array, trans: Array) -> Quadratic:
        """Robust cost, and normal equations with the correspondences of this state held."""
        frame = getattr(self, "frame", 0)
        state = (to_numpy(betas, np.float64), _at_frame(pose, 2, frame), _at_frame(trans, 1, frame))
        points, cost = self.matched(np.asarray(self.solver.body(*state).vertices))
        count = len(pose) if pose.ndim == 3 else 1
        frames = [points if k == (frame if count > 1 else 0) else None for k in range(count)]
        term = points_term(self.solver, frames)

        def derivatives():
            return term.residual(betas, pose, trans).derivatives()

        return Quadratic(cost, derivatives)


def _at_frame(value: Array, axes: int, frame: int) -> np.ndarray:
    whole = to_numpy(value, np.float64)
    return whole if whole.ndim == axes else whole[frame]


@dataclass(frozen=True, eq=False)
class Points(_OfOneFrame):
    """Points (P, 3) of the skin, as a scan has them, against the nearest points of the surface
    (T 5.4).

    normals (P, 3): outward; points are then matched to skin of their own side only. noise: sd (m)
    of a point along the normal, what the model cannot explain included. reach: metres at which a
    point counts a quarter. slide: share of the precision along the surface. share: of each point's
    certainty, below 1 where neighbours err alike.
    """

    points: Float[np.ndarray, "P 3"]
    normals: Float[np.ndarray, "P 3"] | None = None
    frame: int = 0
    noise: float = 0.005
    reach: float = 0.05
    slide: float = 0.1
    share: float = 1.0

    def matched(self, vertices: Float[np.ndarray, "V 3"]) -> Matched:
        """The nearest points of the surface."""
        points = np.asarray(self.points, dtype=float)
        faces = self.solver.body.faces
        face, place = closest_points(points, vertices, faces)
        pointing = unit_normals(vertices[faces[face]])
        keep = np.ones(len(points), dtype=bool)
        if self.normals is not None:
            keep = (pointing * self.normals).sum(1) > MIN_COSINE
        pointing = _direction(place - points, pointing)
        share = barycentric_coordinates(place, vertices[faces[face]])
        precision = np.full(len(points), self.share / self.noise**2)
        return robust_planes(
            face,
            share,
            place,
            points,
            pointing,
            precision,
            self.reach,
            self.slide,
            keep,
            self.share,
        )


@dataclass(frozen=True, eq=False)
class Depth(_OfOneFrame):
    """E_D (T eq. 4.5): a depth image (H, W) in metres along the camera's axis, 0 or NaN where
    nothing was measured.

    mask (H, W): the person's pixels, all that were measured without it. matching: "nearest" (the
    nearest visible point of the surface, which forgives a start that is off) or "pixel" (the point
    at the same pixel, unbiased near the solution). noise: sd of depth over its square (1 / m);
    model_sd: metres that the model cannot explain. reach: metres at which a pixel counts a quarter.
    share: of each full-size pixel's certainty, as neighbouring pixels err alike. stride: every
    which pixel in both directions. min_cosine: with it the noise is that along the surface's
    normal, the sd times the cosine between ray and normal, at least this; the gradient takes the
    cosine as given.
    """

    camera: "Camera"
    depth: Float[np.ndarray, "H W"]
    mask: Bool[np.ndarray, "H W"] | None = None
    frame: int = 0
    matching: str = "nearest"
    noise: float = 1.5e-3
    model_sd: float = 0.003
    reach: float = 0.05
    slide: float = 0.1
    share: float = 0.02
    stride: int = 4
    min_cosine: float = 1.0

    def __post_init__(self) -> None:
        if self.matching not in ("nearest", "pixel"):
            raise HabitusError(f"matching is {self.matching!r}; expected nearest or pixel")
        _check_image("depth", self.depth, self.camera)
        if self.mask is not None:
            _check_image("mask", self.mask, self.camera)
        if not len(self._pixels):
            raise HabitusError("the depth image has no pixel of the person; check depth and mask")

    @cached_property
    def _pixels(self) -> Int[np.ndarray, " P"]:
        measured = np.isfinite(self.depth) & (np.nan_to_num(self.depth) > 0.0)
        person = measured if self.mask is None else measured & self.mask
        coarse = np.zeros_like(person)
        coarse[:: self.stride, :: self.stride] = True
        return np.flatnonzero(person & coarse)

    @cached_property
    def targets(self) -> Float[np.ndarray, "P 3"]:
        """The points (m) that the person's pixels show."""
        along = rays(self.camera, self._pixels)
        return to_world(self.camera, along * np.ravel(self.depth)[self._pixels, None])

    def matched(self, vertices: Float[np.ndarray, "V 3"]) -> Matched:
        """The visible points of the surface that the pixels belong to."""
        faces = self.solver.body.faces
        drawn = draw_faces(self.camera, vertices, faces)
        targets = self.targets
        if self.matching == "pixel":
            face, share = drawn.face[self._pixels], drawn.barycentric[self._pixels]
            keep = face >= 0
            face = np.where(keep, face, 0)
            place = points_on_surface(vertices, faces, face, share)
        else:
            seen = np.unique(drawn.face[drawn.face >= 0])
            seen = seen if len(seen) else np.arange(len(faces))
            some, place = closest_points(targets, vertices, faces[seen])
            face = seen[some]
            share = barycentric_coordinates(place, vertices[faces[face]])
            keep = np.ones(len(face), dtype=bool)
        pointing = unit_normals(vertices[faces[face]])
        if self.matching == "nearest":
            pointing = _direction(place - targets, pointing)
        noise = self.noise * np.ravel(self.depth)[self._pixels] ** 2
        spread = np.hypot(noise * self._cosine(targets, vertices[faces[face]]), self.model_sd)
        certain = self.share * self.stride**2
        slide = self.slide if self.matching == "nearest" else 0.0
        return robust_planes(
            face,
            share,
            place,
            targets,
            pointing,
            certain / spread**2,
            self.reach,
            slide,
            keep,
            certain,
        )

    def _cosine(
        self, targets: Float[np.ndarray, "P 3"], corners: Float[np.ndarray, "P 3 3"]
    ) -> Float[np.ndarray, " P"]:
        """Between rays and normals, at least ``min_cosine``."""
        if self.min_cosine >= 1.0:
            return np.ones(len(targets))
        ray = targets - to_world(self.camera, np.zeros((1, 3)))
        along = np.abs((unit_normals(corners) * ray).sum(1)) / np.linalg.norm(ray, axis=1)
        return np.maximum(along, self.min_cosine)


@dataclass(frozen=True, eq=False)
class Silhouette(_OfOneFrame):
    """The person's pixels, mask (H, W), against those that the surface covers.

    A covered pixel outside the mask draws its point of the surface to the ray of the nearest pixel
    of the mask; a pixel of the mask that is not covered draws the point of the nearest covered
    pixel to its own ray. known (H, W): pixels of which it is known whether they are the person's;
    all without it. noise: sd of the outline in pixels; reach: pixels at which one counts a quarter.
    share, stride: as in `Depth`.
    """

    camera: "Camera"
    mask: Bool[np.ndarray, "H W"]
    known: Bool[np.ndarray, "H W"] | None = None
    frame: int = 0
    noise: float = 2.0
    reach: float = 40.0
    share: float = 0.02
    stride: int = 4

    def __post_init__(self) -> None:
        _check_image("mask", self.mask, self.camera)
        if not self.mask.any():
            raise HabitusError("the mask has no pixel of the person")

    @cached_property
    def _nearest_own(self) -> Int[np.ndarray, "2 H W"]:
        return _nearest_of(self.mask)

    def matched(self, vertices: Float[np.ndarray, "V 3"]) -> Matched:
        """Points of the surface and the rays they should lie on."""
        body = self.solver.body
        drawn = draw_faces(self.camera, vertices, body.faces)
        covered = (drawn.face >= 0).reshape(self.mask.shape)
        if not covered.any():
            raise HabitusError("the camera does not see the body; check the start and the camera")
        coarse = np.zeros_like(covered)
        coarse[:: self.stride, :: self.stride] = True
        outside = covered & ~self.mask & coarse & (True if self.known is None else self.known)
        missing = self.mask & ~covered & coarse
        of_point = [np.flatnonzero(outside), _flat(_nearest_of(covered), missing)]
        of_ray = [_flat(self._nearest_own, outside), np.flatnonzero(missing)]
        pixel = np.concatenate(of_point)
        along = rays(self.camera, np.concatenate(of_ray))
        share = drawn.barycentric[pixel]
        place = points_on_surface(vertices, body.faces, drawn.face[pixel], share)
        eye = to_world(self.camera, np.zeros((1, 3)))[0]
        ray = to_world(self.camera, along) - eye
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        target = eye + ray * ((place - eye) * ray).sum(1, keepdims=True)
        across = np.cross(ray, np.eye(3)[np.abs(ray).argmin(1)])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        focal = float(np.mean(to_numpy(self.camera.focal_length, np.float64)))
        metres = np.linalg.norm(place - eye, axis=1) / focal
        certain = self.share * self.stride**2
        squared = ((place - target) ** 2).sum(1) / (self.noise * metres) ** 2
        weight, cost = geman_mcclure(squared, (self.reach / self.noise) ** 2)
        root = np.sqrt(certain * weight) / (self.noise * metres)
        directions = root[:, None, None] * np.stack([across, np.cross(ray, across)], 1)
        points = PointObservations(drawn.face[pixel], share, target, directions)
        return Matched(points, 0.5 * certain * float(cost.sum()))


@dataclass(frozen=True, eq=False)
class Joints:
    """The body's joints against observed places (K, 3) or, for T poses, (T, K, 3) in metres; NaN is
    a missing one.

    joints: names or numbers of the K joints, all of the body's without them. noise: sd (m).
    offsets (K, 3): of points rigid on the joints, in their frames (m).
    """

    body: BodyModel | PointSolver
    observed: Float[np.ndarray, "*T K 3"]
    joints: Sequence[str] | Sequence[int] | None = None
    noise: float = 0.02
    offsets: Float[np.ndarray, "K 3"] | None = None

    @cached_property
    def solver(self) -> PointSolver:
        """The body made ready."""
        return self.body if isinstance(self.body, PointSolver) else PointSolver.of(self.body)

    @cached_property
    def _numbers(self) -> Int[np.ndarray, " K"]:
        names = self.solver.body.joint_names
        given = range(len(names)) if self.joints is None else self.joints
        unknown = [each for each in given if isinstance(each, str) and each not in names]
        if unknown:
            raise HabitusError(f"the body has no joint {unknown[0]!r}; it has {', '.join(names)}")
        return np.array([names.index(j) if isinstance(j, str) else int(j) for j in given])

    def __call__(self, betas: Array, pose: Array, trans: Array) -> Quadratic:
        """Cost and normal equations."""
        observed = np.asarray(self.observed, dtype=float)
        frames = observed.reshape(-1, *observed.shape[-2:])
        if frames.shape[1] != len(self._numbers):
            raise HabitusError(
                f"{frames.shape[1]} observed joints for {len(self._numbers)} names; expected as "
                "many"
            )
        offsets = np.zeros((len(self._numbers), 3)) if self.offsets is None else self.offsets
        term = points_term(self.solver, [self._of_frame(frame, offsets) for frame in frames])
        return term.residual(betas, pose, trans)

    def _of_frame(self, frame: np.ndarray, offsets: np.ndarray) -> JointObservations:
        seen = np.isfinite(frame).all(1)
        directions = np.tile(np.eye(3) / self.noise, (int(seen.sum()), 1, 1))
        return JointObservations(self._numbers[seen], offsets[seen], frame[seen], directions)


def geman_mcclure(
    squared: Float[np.ndarray, " P"], scale_squared: Float[np.ndarray, " P"] | float
) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Weight rho' and loss rho of squared residuals (`habitus.solve.terms.GemanMcClure`)."""
    ratio = scale_squared / (scale_squared + squared)
    return ratio**2, ratio * squared


def robust_planes(
    face: Int[np.ndarray, " P"],
    barycentric: Float[np.ndarray, "P 3"],
    place: Float[np.ndarray, "P 3"],
    target: Float[np.ndarray, "P 3"],
    normal: Float[np.ndarray, "P 3"],
    precision: Float[np.ndarray, " P"],
    reach: float,
    slide: float,
    keep: Bool[np.ndarray, " P"],
    certain: float,
) -> Matched:
    """Points of the surface, at ``place``, drawn to the planes through their targets, robustly.

    precision: 1 / s^2 times ``certain``, the share of its certainty that each point counts. keep:
    the points that have a correspondence; the others cost as much as any can.
    """
    off = place - target
    squared = ((off * normal).sum(1) ** 2 + slide * (off**2).sum(1)) * precision / certain
    scale = reach**2 * precision / certain
    weight, loss = geman_mcclure(squared, scale)
    cost = 0.5 * certain * float(np.where(keep, loss, scale).sum())
    some = (face[keep], barycentric[keep], target[keep], normal[keep])
    return Matched(PointObservations.to_planes(*some, (precision * weight)[keep], slide), cost)


def _direction(
    off: Float[np.ndarray, "P 3"], normal: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "P 3"]:
    """Unit direction of the distance to the surface: to the nearest point, which may be on an edge;
    the normal where that is the point itself. So the gradient is that of the distance exactly.
    """
    length = np.linalg.norm(off, axis=1, keepdims=True)
    return np.where(length > 1e-9, off / np.maximum(length, 1e-9), normal)


def unit_normals(corners: Float[np.ndarray, "P 3 3"]) -> Float[np.ndarray, "P 3"]:
    """Unit normals of triangles with these corners, zero where one has no area."""
    normals = triangle_normals(corners)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


class DrawnFaces(NamedTuple):
    """What a camera sees of a surface at the centre of each pixel: face (-1: none), and weights of
    its corners.
    """

    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]


def draw_faces(
    camera: "Camera", vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> DrawnFaces:
    """The visible faces of a surface, hidden and averted ones left out."""
    import torch

    from habitus.render.draw import draw
    from habitus.render.triangles import Triangles

    triangles = Triangles.of(faces, num_vertices=len(vertices))
    frame = draw(
        camera.to(torch.float64),
        torch.from_numpy(np.ascontiguousarray(vertices)),
        triangles,
        boundary="none",
        cull=True,
    )
    ids = frame.face_ids.numpy().ravel().astype(np.int64)
    return DrawnFaces(ids, frame.barycentrics.numpy().reshape(-1, 3).astype(float))


def rays(camera: "Camera", pixels: Int[np.ndarray, " P"]) -> Float[np.ndarray, "P 3"]:
    """Directions of pixels, by number, in the camera's frame, z = 1."""
    import torch

    row, column = np.divmod(pixels, camera.width)
    centres = torch.from_numpy(np.stack([column + 0.5, row + 0.5], -1).astype(float))
    return camera.to(torch.float64).rays(centres).numpy()


def to_world(camera: "Camera", points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Points of the camera's frame in the world (m)."""
    import torch

    return camera.to(torch.float64).to_world(torch.from_numpy(points)).numpy()


def _nearest_of(mask: Bool[np.ndarray, "H W"]) -> Int[np.ndarray, "2 H W"]:
    """Row and column of the nearest pixel of a mask, for every pixel."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~mask, return_distances=False, return_indices=True))


def _flat(nearest: Int[np.ndarray, "2 H W"], mask: Bool[np.ndarray, "H W"]) -> np.ndarray:
    row, column = nearest[:, mask]
    return row * mask.shape[1] + column


def _check_image(name: str, image: np.ndarray, camera: "Camera") -> None:
    size = (camera.height, camera.width)
    if np.shape(image) != size:
        raise HabitusError(f"{name} has shape {np.shape(image)}; the camera's images have {size}")
