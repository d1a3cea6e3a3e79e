"""The pose prior that ships with the package, for bodies whose file brings none."""

from importlib.resources import files

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior


def shipped_prior() -> PosePrior:
    """The Gaussian of the package's own poses, over the joints of SMPL-X."""
    source = files("habitus.assets") / "pose_prior.npz"
    with source.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
        names = tuple(map(str, arrays["joint_names"]))
        return PosePrior(names, arrays["mean"], arrays["covariance"])


def prior_of(body: BodyModel | None) -> PosePrior:
    """A body's own pose prior where it has one, else the shipped one."""
    return shipped_prior() if body is None or body.pose_prior is None else body.pose_prior
