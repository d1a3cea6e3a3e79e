"""What soft tissue may move along: directions of shape (M 6), dynamic blend shapes (S 6), or both,
side by side.
"""

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.soft_tissue import dynamics_of
from habitus.errors import HabitusError

SPACES = {"shape": ("shape",), "dynamics": ("dynamics",), "both": ("shape", "dynamics")}
"""Soft-tissue spaces, and the directions that they are made of, in their order."""


def check_space(body: BodyModel, space: str) -> None:
    """Raise HabitusError for a space that is not known, and for one that the body has not."""
    if space not in SPACES:
        raise HabitusError(f"soft tissue is {space!r}; expected one of {', '.join(SPACES)}")
    if "dynamics" in SPACES[space]:
        dynamics_of(body)


def soft_count(body: BodyModel, space: str) -> int:
    """How many coefficients soft tissue has."""
    return sum(
        {"shape": body.num_betas, "dynamics": body.num_dynamics}[part] for part in SPACES[space]
    )


def soft_directions(
    body: BodyModel, space: str, vertices: np.ndarray
) -> tuple[Float[np.ndarray, "N 3 S"], Float[np.ndarray, "J 3 S"]]:
    """How some vertices at rest and the rest joints move with soft tissue; dynamics move no
    joint.
    """
    parts = []
    for part in SPACES[space]:
        if part == "shape":
            parts.append((body.shapedirs[vertices], body.joint_shapedirs))
        else:
            parts.append(
                (
                    dynamics_of(body).directions[vertices],
                    np.zeros((body.num_joints, 3, body.num_dynamics)),
                )
            )
    corners, joints = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    return np.ascontiguousarray(corners), np.ascontiguousarray(joints)


def parted(
    body: BodyModel, space: str, soft_tissue: Float[np.ndarray, "T S"]
) -> tuple[Float[np.ndarray, "T B"], Float[np.ndarray, "T D"] | None]:
    """Coefficients of soft tissue as changes of the betas, zero where the space has none, and as
    dynamics.
    """
    parts = SPACES[space]
    count = body.num_betas if "shape" in parts else 0
    change = soft_tissue[:, :count] if count else np.zeros((len(soft_tissue), body.num_betas))
    return change, soft_tissue[:, count:] if "dynamics" in parts else None
