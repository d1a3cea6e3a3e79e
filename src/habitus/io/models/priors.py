"""The pose prior that ships with the default body."""

from importlib.resources import files
from pathlib import Path

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.io.files import atomic_write


def load_pose_prior(path: str | Path | None = None) -> PosePrior:
    """The shipped pose prior, or another one written by ``save_pose_prior``."""
    source = files("habitus.assets") / "pose_prior.npz" if path is None else Path(path)
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        names = tuple(str(name) for name in arrays["joint_names"])
        return PosePrior(names, arrays["mean"].astype(np.float64), arrays["covariance"].astype(np.float64))


def prior_of(body: BodyModel | None) -> PosePrior:
    """A body's own pose prior where it has one, else the shipped one."""
    return load_pose_prior() if body is None or body.pose_prior is None else body.pose_prior


def save_pose_prior(prior: PosePrior, path: str | Path) -> None:
    """Write a prior as npz, atomically."""
    with atomic_write(path) as temporary:
        np.savez_compressed(
            temporary, joint_names=np.array(prior.joint_names), mean=prior.mean, covariance=prior.covariance
        )
