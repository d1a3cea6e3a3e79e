"""The pose prior: a Gaussian over joint rotations (MoSh eq. 7), carried over to any body that
shares joint names; one ships with the package, for bodies whose file brings none.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Protocol

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from habitus.body.hand_space import hand_gaussian, hand_joints, has_hands
from habitus.body.hands import FingeredBody

UNKNOWN_JOINT_SD = (
    0.15  # rad: joints that the prior does not know (fingers, jaw, eyes) stay near rest
)


@dataclass(frozen=True)
class PosePrior:
    """Mean (3 N,) and covariance (3 N, 3 N) of the rotation vectors (rad) of ``joint_names`` (N),
    without the root.

    A body model carries one where its file brings one (`habitus.body.model.BodyModel.pose_prior`).
    """

    joint_names: tuple[str, ...]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]

    def for_joints(self, joint_names: Sequence[str]) -> "PosePrior":
        """The prior of a body with ``joint_names`` (root first, left out of it); unknown joints
        independent at rest.
        """
        joints = tuple(joint_names[1:])
        mean = np.zeros(3 * len(joints))
        covariance = np.eye(3 * len(joints)) * UNKNOWN_JOINT_SD**2
        known = [
            (k, self.joint_names.index(name))
            for k, name in enumerate(joints)
            if name in self.joint_names
        ]
        if known:
            here, there = (
                np.add.outer(3 * np.array(side), np.arange(3)).ravel()
                for side in zip(*known, strict=True)
            )
            mean[here] = self.mean[there]
            covariance[np.ix_(here, here)] = self.covariance[np.ix_(there, there)]
        return PosePrior(joints, mean, covariance)

    def replaced(self, other: "PosePrior") -> "PosePrior":
        """The prior with the joints of another, independent of the rest, instead of its own."""
        rest = self.for_joints(
            ("root", *(name for name in self.joint_names if name not in other.joint_names))
        )
        return PosePrior(
            (*rest.joint_names, *other.joint_names),
            np.concatenate([rest.mean, other.mean]),
            np.asarray(block_diag(rest.covariance, other.covariance)),
        )

    def joint_deviations(self, pose: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, " N"]:
        """How far each joint's rotation by itself (rad; root first, left out) is from the mean, in
        standard deviations of that joint.
        """
        off = (pose[1:].ravel() - self.mean).reshape(-1, 3)
        own = np.arange(len(self.covariance)).reshape(-1, 3)
        blocks = self.covariance[own[:, :, None], own[:, None, :]]
        return np.sqrt(np.einsum("ni,ni->n", off, np.linalg.solve(blocks, off[..., None])[..., 0]))

    @property
    def precision(self) -> Float[np.ndarray, "n n"]:
        """Inverse covariance."""
        return np.linalg.inv(self.covariance)

    @property
    def whitening(self) -> Float[np.ndarray, "n n"]:
        """W with WᵀW = precision."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance))


def shipped_prior() -> PosePrior:
    """The Gaussian of the package's own poses, over the joints of SMPL-X."""
    source = files("habitus.assets") / "pose_prior.npz"
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        names = tuple(map(str, arrays["joint_names"]))
        return PosePrior(names, arrays["mean"], arrays["covariance"])


class _MayHavePrior(FingeredBody, Protocol):
    """A body model, as far as it counts here."""

    @property
    def pose_prior(self) -> PosePrior | None: ...


def prior_of(body: _MayHavePrior | None) -> PosePrior:
    """A body's own pose prior where it has one, else the shipped one, with fingers about the axes
    of the body's own hands (`habitus.body.hand_space`).
    """
    if body is not None and body.pose_prior is not None:
        return body.pose_prior
    prior = shipped_prior()
    if body is None or not has_hands(body):
        return prior
    return prior.replaced(PosePrior(hand_joints(), *hand_gaussian(body)))
