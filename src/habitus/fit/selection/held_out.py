"""Posed people that a body has not seen and cannot explain whole, to judge sets of markers by."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.body.prior import PosePrior
from habitus.fit.selection.problem import SELECTION, Posed, SelectionSettings

WAVES = 60
"""Waves that make up a random field: it is nearly normal from some tens on."""


def held_out_people(
    models: Sequence[BodyModel],
    prior: PosePrior,
    count: int,
    seed: int,
    settings: SelectionSettings = SELECTION,
) -> tuple[Posed, ...]:
    """People drawn from ``models`` in turn, in poses drawn from the prior: their surfaces (V, 3),
    m.

    On each skin lies a smooth random offset (``settings.flesh``): what no model knows of a person.
    The state that comes with a surface is the one that made it; betas of other models are no start,
    so those are zero.
    """
    rng = np.random.default_rng(seed)
    return tuple(_person(models[k % len(models)], prior, rng, settings) for k in range(count))


def _person(
    model: BodyModel, prior: PosePrior, rng: np.random.Generator, settings: SelectionSettings
) -> Posed:
    own = prior.for_joints(model.joint_names)
    joints = own.mean + np.linalg.cholesky(own.covariance) @ rng.normal(size=len(own.mean))
    pose = np.concatenate([np.zeros((1, 3)), joints.reshape(-1, 3)])
    betas = rng.normal(size=model.num_betas)
    surface = model(betas, pose).vertices
    off = smooth_field(model.v_template, rng, settings.flesh_reach)
    return Posed(np.zeros(model.num_betas), pose, np.zeros(3), surface + settings.flesh * off)


def smooth_field(
    points: Float[np.ndarray, "V 3"],
    rng: np.random.Generator,
    reach: float = SELECTION.flesh_reach,
) -> Float[np.ndarray, "V 3"]:
    """A random field of variance 1 in every coordinate, alike over some ``reach`` metres (random
    Fourier features).
    """
    waves = rng.normal(size=(3, WAVES)) / reach
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    return np.sqrt(2.0 / WAVES) * np.cos(points @ waves + phases) @ rng.normal(size=(WAVES, 3))
