"""A surface outside the class of SMPL models: dual quaternion skinning, and flesh that bulges with
joint angles.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from habitus.body.model import BodyModel
from habitus.body.state import BodySurface
from habitus.errors import HabitusError
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.muscles import MUSCLES, Muscle
from habitus_lab.population.planted_body import patch_mask

FEWEST = 3  # half as many vertices as a person's girth at a muscle is measured at, at least
GIRTH_POWER = (
    1.5  # a bulge grows with this power of the person's girth at the muscle, over the template's
)


@dataclass(frozen=True, eq=False)
class FleshySurface:
    """People whose surface is no SMPL model's, a deterministic function of shape and pose; called
    as a BodyModel is.

    M muscles raise patches of the skin: by a smooth step of a joint's angle, which is no linear
    function of R - I, times a power of the person's girth there, which ties the bulge to the shape.
    """

    body: BodyModel
    joint: Int[Tensor, " M"]
    axis: Float[Tensor, "M 3"]
    span: Float[Tensor, "M 2"]  # rad: where the bulge begins and where it is full
    bulges: Float[Tensor, "M W"]  # m: rows of 3 V numbers, x of all vertices, then y, then z
    bone: Float[Tensor, "M 2 J"]  # weights of joints that give the ends of the muscle's bone
    felt: Int[Tensor, "M K"]  # vertices that girth is measured at
    girth: Float[Tensor, " M"]  # m: the template's

    def __call__(
        self,
        betas: Float[Tensor, "*#batch B"],
        pose: Float[Tensor, "*#batch J 3"],
        trans: Float[Tensor, "*#batch 3"] | None = None,
    ) -> BodySurface:
        """Vertices and joints (m) of people with these shape coefficients in these poses (rad),
        moved by ``trans``.
        """
        prepared = self.body.prepare(betas)
        size = (self.girths(betas) / self.girth) ** GIRTH_POWER
        raised = prepared.shaped + (self.effort(pose) * size) @ self.bulges
        return prepared.moved(raised, pose, trans)

    def effort(self, pose: Float[Tensor, "*batch J 3"]) -> Float[Tensor, "*batch M"]:
        """Activation of each bulge, 0 to 1."""
        angle = (pose[..., self.joint, :] * self.axis).sum(-1)
        share = ((angle - self.span[:, 0]) / (self.span[:, 1] - self.span[:, 0])).clamp(0, 1)
        return share * share * (3 - 2 * share)

    def girths(self, betas: Float[Tensor, "*batch B"]) -> Float[Tensor, "*batch M"]:
        """Mean distance (m) of the skin from the bone at each muscle, for people at rest."""
        ends = self.bone @ self.body.rest_joints(betas)[..., None, :, :]  # (*batch, M, 2, 3)
        return _distance(self.body.rest_vertices(betas)[..., self.felt, :], ends)


def out_of_class_surface(
    template_body: BodyModel, *, num_betas: int = 10, size: float = 1.0
) -> FleshySurface:
    """People of ``template_body`` under dual quaternion skinning, with muscles; ``size`` scales all
    bulges.

    Raises HabitusError where the body does not know its mirror or has none of the joints that
    muscles are known for.
    """
    body = replace(template_body.with_betas(num_betas), skinning="dqbs", posedirs=None)
    known = [m for m in MUSCLES if {m.joint, *m.bone} <= set(body.joint_names)]
    if not known or body.mirror is None:
        raise HabitusError(
            f"{body.name} has no joint with a known muscle, or no mirror; expected SMPL's joints "
            "and one"
        )
    left = [k for k, muscle in enumerate(known) if _has_twin(muscle)]
    patches, felt = (
        torch.stack(each) for each in zip(*(_patch(body, muscle) for muscle in known), strict=True)
    )
    patches = torch.cat([patches, patches[left][:, torch.as_tensor(body.mirror)]])
    felt = torch.cat([felt, torch.as_tensor(body.mirror[felt[left].numpy()])])
    muscles = [*known, *(_twin(known[k]) for k in left)]
    number = body.joint_names.index
    rest = torch.as_tensor(body.joint_template)
    bone = torch.zeros(len(muscles), 2, body.num_joints, dtype=torch.float64)
    for k, muscle in enumerate(muscles):
        bone[k, 0, number(muscle.bone[0])] = bone[k, 1, number(muscle.bone[1])] = 1.0
    normals = torch.as_tensor(vertex_normals(body.v_template, body.faces).T)
    heights = torch.tensor([m.height for m in muscles], dtype=torch.float64) * size * 1e-3
    return FleshySurface(
        body=replace(body, name=f"flesh on {template_body.name}"),
        joint=torch.tensor([number(m.joint) for m in muscles]),
        axis=torch.tensor([m.axis for m in muscles], dtype=torch.float64),
        span=torch.tensor([(m.start, m.end) for m in muscles], dtype=torch.float64).deg2rad(),
        bulges=((heights[:, None] * patches)[:, None] * normals).flatten(1),
        bone=bone,
        felt=felt,
        girth=_distance(torch.as_tensor(body.v_template)[felt], bone @ rest),
    )


def _has_twin(muscle: Muscle) -> bool:
    return muscle.joint.startswith("left_") or muscle.towards[0] != 0


def _twin(muscle: Muscle) -> Muscle:
    """The muscle on the right."""
    joint, first, second = (
        name.replace("left_", "right_") for name in (muscle.joint, *muscle.bone)
    )
    x, y, z = muscle.axis
    return muscle._replace(joint=joint, bone=(first, second), axis=(x, -y, -z))


def _patch(body: BodyModel, muscle: Muscle) -> tuple[Float[Tensor, " V"], Int[Tensor, " K"]]:
    """A Gaussian on the skin around a muscle's centre, on the limbs of its bone only; and where it
    is strongest.
    """
    assert body.mirror is not None
    first, second = (body.joint_names.index(name) for name in muscle.bone)
    mask = torch.from_numpy(np.maximum(patch_mask(body, first), patch_mask(body, second)))
    rest, template, mirror = (
        torch.as_tensor(a) for a in (body.joint_template, body.v_template, body.mirror)
    )
    away = template - torch.lerp(rest[first], rest[second], muscle.along)
    direction = torch.tensor(muscle.towards, dtype=torch.float64)
    direction = direction / direction.norm()
    along = away @ direction
    beside = (away - along[:, None] * direction).norm(dim=1)
    centre = torch.where((mask > 0.5) & (along > 0), beside, torch.inf).argmin()
    squared = ((template - template[centre]) ** 2).sum(1)
    patch = mask * torch.exp(-0.5 * squared / (muscle.width * 1e-3) ** 2)
    if _has_twin(muscle):
        return patch, patch.topk(2 * max(FEWEST, body.num_vertices // 400)).indices
    patch = torch.maximum(patch, patch[mirror])
    felt = (
        torch.where(template[:, 0] >= 0, patch, -1.0)
        .topk(max(FEWEST, body.num_vertices // 400))
        .indices
    )
    return patch, torch.cat([felt, mirror[felt]])


def _distance(
    points: Float[Tensor, "*batch M K 3"], ends: Float[Tensor, "*batch M 2 3"]
) -> Float[Tensor, "*batch M"]:
    """Mean distance of points from the lines through two ends."""
    axis = ends[..., 1, :] - ends[..., 0, :]
    axis = (axis / axis.norm(dim=-1, keepdim=True))[..., None, :]
    away = points - ends[..., :1, :]
    return (away - (away * axis).sum(-1, keepdim=True) * axis).norm(dim=-1).mean(-1)
