"""Inputs and outputs of the body model, and what its mesh has besides triangles: the quads they
were cut from, a texture's coordinates, hidden pockets.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.types import Array, PathLike


@dataclass(frozen=True, eq=False)
class BodyMesh:
    """Quads (Q, 4) of vertex numbers, counter-clockwise from outside; ``quad_uv`` of rows of
    ``uv``, from below left.

    ``hidden`` quads line pockets that nobody sees: the inside of the mouth, the sockets of the
    eyes.
    """

    quads: Int[np.ndarray, "Q 4"]
    uv: Float[np.ndarray, "N 2"]
    quad_uv: Int[np.ndarray, "Q 4"]
    hidden: Bool[np.ndarray, " Q"]

    def triangle_uv(self, faces: Int[np.ndarray, "T 3"]) -> Int[np.ndarray, "T 3"] | None:
        """Rows of ``uv`` for each corner of triangles that are the quads cut in two, in any order;
        None for others.
        """
        if len(faces) != 2 * len(self.quads):
            return None
        size = int(max(self.quads.max(initial=0), faces.max(initial=0))) + 1
        thirds = numbered(
            np.concatenate([np.delete(self.quads, corner, axis=1) for corner in range(4)]), size
        )
        order = np.argsort(thirds, kind="stable")
        wanted = numbered(faces, size)
        place = np.minimum(np.searchsorted(thirds[order], wanted), len(thirds) - 1)
        if not np.array_equal(thirds[order][place], wanted):
            return None
        quad = order[place] % len(self.quads)
        if (np.bincount(quad, minlength=len(self.quads)) != 2).any():
            return None
        corner = (self.quads[quad][:, None, :] == faces[:, :, None]).argmax(-1)
        return np.take_along_axis(self.quad_uv[quad], corner, 1)


def numbered(triangles: Int[np.ndarray, "T 3"], size: int) -> Int[np.ndarray, " T"]:
    """One number for each set of three of ``size`` vertices, whichever comes first."""
    a, b, c = np.sort(triangles, axis=1).T.astype(np.int64)
    return (a * size + b) * size + c


@dataclass(frozen=True)
class BodyState:
    """The unknowns of a body: shape, pose, place, and (optional) soft tissue, as offsets of the
    shape coefficients.

    Where a fit let dynamics move, their coefficients follow behind: S is then B + D.
    """

    betas: Float[Array, "*#batch B"]
    pose: Float[Array, "*#batch J 3"]
    trans: Float[Array, "*#batch 3"]
    soft_tissue: Float[Array, "*#batch S"] | None = None

    def __getitem__(self, index: int | slice) -> "BodyState":
        """The states of some frames: indexes the first axis of everything that has a batch; a
        shared shape stays.
        """
        betas = self.betas if self.betas.ndim == 1 else self.betas[index]
        soft = self.soft_tissue if self.soft_tissue is None else self.soft_tissue[index]
        return BodyState(betas, self.pose[index], self.trans[index], soft)


@dataclass(frozen=True)
class BodySurface:
    """A posed body in metres: vertices (all, or the asked ones in the asked order) and joints.

    ``faces`` are the body's, all of them; ``betas`` the shape of the person, without soft tissue;
    ``mesh`` the quads and texture coordinates, where the body has them and all vertices were asked
    for.
    """

    vertices: Float[Array, "*batch N 3"]
    joints: Float[Array, "*batch J 3"]
    faces: Int[Array, "T 3"]
    betas: Float[Array, "*shapes B"]
    mesh: BodyMesh | None = None

    def export(self, path: PathLike) -> None:
        """Write the surface as a mesh file, by its ending: .ply, .obj or .glb."""
        from habitus.body.surface_files import write_surface  # loads glTF, which few need

        write_surface(self, path)
