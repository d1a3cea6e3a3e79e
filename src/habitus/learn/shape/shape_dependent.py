"""Pose blend shapes that depend on a person's shape (T 5.6, "Limitations"): once shapes are known,
training goes on.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.learn.estimate import Estimate
from habitus.learn.shape.shape_space import ShapeSpace


def with_shape_features(
    estimate: Estimate, shape: ShapeSpace, regressor: Float[np.ndarray, "J V"], count: int
) -> Estimate:
    """The same estimate, whose blend shapes may from now on depend on the first ``count`` shape
    coefficients.

    What depends on them begins at zero, so that the energy is what it was. Each subject is
    described by the coefficients of its rest surface. Raises HabitusError where there are fewer.
    """
    if shape.num_betas < count:
        raise HabitusError(
            f"{count} shape features asked for, and people vary along {shape.num_betas} "
            "directions only; "
            "ask for fewer, or train on more people"
        )
    rig = estimate.rig
    assert rig.posedirs is not None
    more = np.zeros((*rig.posedirs.shape[:2], rig.posedirs.shape[2] * count))
    wider = replace(rig, posedirs=np.concatenate([rig.posedirs, more], -1), shape_features=count)
    placed = at_one_root(estimate.templates, regressor, regressor[0] @ shape.mean)
    return replace(estimate, rig=wider, descriptors=shape.coefficients(placed)[:, :count])


def at_one_root(
    surfaces: Float[np.ndarray, "S V 3"],
    regressor: Float[np.ndarray, "J V"],
    root: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "S V 3"]:
    """Surfaces moved so that their root joints are at one place (m): where a subject rests is not
    its shape.
    """
    return surfaces + (root - regressor[0] @ surfaces)[:, None]
