"""BlendSCAPE, the model of triangle deformations that S 5.1 compares with (Hirshberg et al. 2012).

Each triangle t of the template is deformed by ``B_t(pose) S_t(betas) Q_t(pose)``: a deformation
that is linear in the joints' rotations, then the person's, then the rotations of the parts that it
belongs to, blended with its skinning weights. The pieces are stitched together by least squares.
There are no joint locations: how parts hang together follows from the stitching, and the place is
that of the vertices' mean.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int

from habitus.arrays import flatten
from habitus.body.skinning import descends
from habitus.evaluate.surface_fit import Columns, FittedToSurfaces
from habitus.rotations import cross_matrix, left_jacobian, matrix_from_rotvec
from habitus_lab.baselines.triangle_frames import Stitching, stitching


@dataclass(frozen=True, eq=False)
class BlendScape(FittedToSurfaces):
    """A trained BlendSCAPE model; vertices in metres, poses as rotation vectors (rad) relative to
    the parent.

    ``template`` (V, 3) are the undeformed triangles, ``influence`` (V, J) the skinning weights of
    its vertices. ``mean_shape`` and ``shape_directions`` are triangle deformations, a unit of a
    coefficient one standard deviation; ``shape_variances`` are all variances of the training.
    ``pose_regression`` takes vec(R - I) of all joints but the root (body.blendshapes.pose_feature)
    to what is added to the identity.
    """

    name: str
    template: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    parents: tuple[int, ...]
    influence: Float[np.ndarray, "V J"]
    mean_shape: Float[np.ndarray, "F 3 3"]
    shape_directions: Float[np.ndarray, "B F 3 3"]
    pose_regression: Float[np.ndarray, "P F 3 3"]
    shape_variances: Float[np.ndarray, " S"] | None = None
    kind: ClassVar[str] = "BlendSCAPE"

    def __getstate__(self) -> dict[str, Any]:
        return {
            item.name: getattr(self, item.name) for item in fields(self)
        }  # factored matrices do not travel

    @property
    def num_betas(self) -> int:
        """B."""
        return len(self.shape_directions)

    @cached_property
    def stitched(self) -> Stitching:
        """The least-squares stitching of triangles."""
        return stitching(self.template, self.faces)

    @cached_property
    def triangle_weights(self) -> Float[np.ndarray, "F J"]:
        """Skinning weights of triangles: means over their corners."""
        return self.influence[self.faces].mean(1)

    def surface(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"]
    ) -> Float[np.ndarray, "V 3"]:
        """Vertices (m) of the first so many shape coefficients and a pose; their mean is that of
        the template.
        """
        turns, world = part_rotations(pose, self.parents)
        blended = mixed(self.triangle_weights, world)
        return self.stitched.vertices(blended @ self.shape(betas) @ self.pose_deformations(turns))

    def shape(self, betas: Float[np.ndarray, " B"]) -> Float[np.ndarray, "F 3 3"]:
        """S_t: a person's deformations."""
        return self.mean_shape + combined(betas, self.shape_directions[: len(betas)])

    def pose_deformations(self, turns: Float[np.ndarray, "J 3 3"]) -> Float[np.ndarray, "F 3 3"]:
        """Q_t of joints' rotations relative to their parents."""
        found = np.tile(np.eye(3), (len(self.faces), 1, 1))
        for (heard, slopes), turn in zip(self._listeners, turns[1:], strict=True):
            found[heard] += combined((turn - np.eye(3)).ravel(), slopes)
        return found

    @cached_property
    def _listeners(self) -> list[tuple[slice | np.ndarray, np.ndarray]]:
        """For each joint but the root the triangles that hear it, and their part of the regression
        (9, n, 3, 3).
        """
        found = []
        for first in range(0, len(self.pose_regression), 9):
            slopes = self.pose_regression[first : first + 9]
            heard = slopes.any((0, 2, 3))
            found.append(
                (slice(None), slopes) if heard.all() else (np.flatnonzero(heard), slopes[:, heard])
            )
        return found

    def columns(
        self, betas: Float[np.ndarray, " B"], pose: Float[np.ndarray, "J 3"], by_betas: bool
    ) -> Iterator[Columns]:
        """The surface and its exact derivatives, through the stitching, in one block."""
        turns, world = part_rotations(pose, self.parents)
        blended = mixed(self.triangle_weights, world)
        person = self.shape(betas)
        posed = self.pose_deformations(turns)
        sides = [self._by_pose(pose, turns, world, blended @ person, person @ posed)]
        if by_betas and len(betas):
            sides.insert(0, self._by_betas(len(betas), blended, posed))
        right = np.concatenate([self.stitched.gather(blended @ person @ posed), *sides], 1)
        found = self.stitched.solve(right)
        yield (
            slice(None),
            found[:, :3] + self.stitched.mean,
            found[:, 3:].reshape(len(found), -1, 3).swapaxes(1, 2),
        )

    def _by_betas(
        self, count: int, blended: Float[np.ndarray, "F 3 3"], posed: Float[np.ndarray, "F 3 3"]
    ) -> Float[np.ndarray, "V C"]:
        rows = []
        for first in range(0, count, 8):
            changes = blended @ self.shape_directions[first : min(first + 8, count)] @ posed
            rows.append(self.stitched.gather(side_by_side(changes)))
        return np.concatenate(rows, 1)

    def _by_pose(
        self,
        pose: Float[np.ndarray, "J 3"],
        turns: Float[np.ndarray, "J 3 3"],
        world: Float[np.ndarray, "J 3 3"],
        outer: Float[np.ndarray, "F 3 3"],
        inner: Float[np.ndarray, "F 3 3"],
    ) -> Float[np.ndarray, "V C"]:
        """Right-hand sides of the derivatives, [joint, entry of its vector, coordinate].

        A small turn m of joint j in the world turns the rotations of all that hangs on it: d B_t =
        [m]x C_tj, and [m]x can wait until after the triangles are gathered. ``outer`` is B S,
        ``inner`` S Q.
        """
        local = left_jacobian(pose)
        above = np.stack([world[p] if p >= 0 else np.eye(3) for p in self.parents])
        axes = cross_matrix((above @ local).mT)
        slopes = flatten(cross_matrix(local.mT) @ turns[:, None], -2)
        below = descends(self.parents)
        sides = np.empty((len(self.template), len(turns), 3, 3))
        for j in range(len(turns)):
            carried = self.stitched.gather(
                mixed(self.triangle_weights, world * below[j][:, None, None]) @ inner
            )
            sides[:, j] = np.einsum("mcd,vd->vmc", axes[j], carried)
            if j:
                heard, regression = self._listeners[j - 1]
                change = np.zeros((len(outer), 9, 3))
                change[heard] = side_by_side(outer[heard] @ combined(slopes[j], regression))
                sides[:, j] += self.stitched.gather(change).reshape(-1, 3, 3)
        return sides.reshape(len(sides), -1)

    def forward(self, num_betas: int) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """The function (betas, pose) -> vertices with that many coefficients."""
        return lambda betas, pose: self.surface(betas[:num_betas], pose)


def part_rotations(
    pose: Float[np.ndarray, "J 3"], parents: tuple[int, ...]
) -> tuple[Float[np.ndarray, "J 3 3"], Float[np.ndarray, "J 3 3"]]:
    """Joints' rotations relative to their parents, and in the world, of rotation vectors (rad)."""
    turns = matrix_from_rotvec(np.asarray(pose, float))
    world = turns.copy()
    for j, parent in enumerate(parents[1:], 1):
        world[j] = world[parent] @ turns[j]
    return turns, world


def mixed(
    weights: Float[np.ndarray, "F J"], matrices: Float[np.ndarray, "J 3 3"]
) -> Float[np.ndarray, "F 3 3"]:
    """Weighted sums of joints' matrices."""
    return (weights @ matrices.reshape(-1, 9)).reshape(-1, 3, 3)


def combined(
    factors: Float[np.ndarray, "*batch K"], matrices: Float[np.ndarray, "K F 3 3"]
) -> Float[np.ndarray, "*batch F 3 3"]:
    """Sums of matrices of each triangle."""
    flat = matrices.reshape(len(matrices), 9 * matrices.shape[1])
    return (factors @ flat).reshape(*factors.shape[:-1], *matrices.shape[1:])


def side_by_side(matrices: Float[np.ndarray, "K F 3 3"]) -> Float[np.ndarray, "F C 3"]:
    """The rows of each triangle's K matrices, C = 3 K of them."""
    return matrices.swapaxes(0, 1).reshape(matrices.shape[1], 3 * len(matrices), 3)
