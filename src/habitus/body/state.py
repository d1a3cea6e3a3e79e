"""Inputs and outputs of the body model."""

from dataclasses import dataclass

from jaxtyping import Float, Int

from habitus.body.body_mesh import BodyMesh
from habitus.types import Array, PathLike


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
