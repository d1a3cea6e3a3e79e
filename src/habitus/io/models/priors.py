"""The pose prior that ships with the default body."""

from importlib.resources import files
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from habitus.body.prior import PosePrior
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.io.limits import check_joints
from habitus.io.models.arrays import ModelArrays


def load_pose_prior(path: str | Path | None = None) -> PosePrior:
    """The shipped pose prior, or another one written by ``save_pose_prior``.

    Raises HabitusError, with the file named, where it holds none.
    """
    source = files("habitus.assets") / "pose_prior.npz" if path is None else Path(path)
    try:
        with source.open("rb") as stream:
            arrays = ModelArrays(cast(BinaryIO, stream))
            names = arrays.text("joint_names")
            check_joints(len(names))
            size = 3 * len(names)
            return PosePrior(
                names, arrays.number("mean", size), arrays.number("covariance", size, size)
            )
    except HabitusError as error:
        raise HabitusError(f"{source}: {error}") from error
    except OSError as error:
        raise HabitusError(
            f"{source}: {error.strerror or error}; expected a pose prior (.npz)"
        ) from error


def save_pose_prior(prior: PosePrior, path: str | Path) -> None:
    """Write a prior as npz, atomically."""
    with atomic_write(path) as temporary:
        np.savez_compressed(
            temporary,
            joint_names=np.array(prior.joint_names),
            mean=prior.mean,
            covariance=prior.covariance,
        )
