"""A limb that was lost, looked for again: where a piece of the scan lies off the surface, the limbs
near it are tried.

What is found counts only where it leaves less of the scan off a quick surface, the model with an
offset of few steps, so that nothing more is spent on what no limb explains: spread fingers, of
which the default body knows nothing.
"""

import numpy as np
from jaxtyping import Float

from habitus.fit.registration.extremities import ARMS, TRIES, with_extremities
from habitus.fit.registration.guesses import Guesser, Limb
from habitus.fit.registration.judge import lost_piece, lost_share
from habitus.fit.registration.model_stage import Cloud, ModelState, ModelStep
from habitus.fit.registration.nearest import nearest
from habitus.fit.registration.offset_stage import EVERYTHING, fit_with_offsets

WHOLE = 5
"""Arms, legs and head are the first of the guesser's limbs."""
NEAR = 0.1
"""Metres: a limb so much further from the lost piece than the nearest one is tried, too."""
QUICK = (ModelStep(2, 6000, 0.03, 0.004, 0.0, EVERYTHING),)
LOOKED_AT = 20_000
LESS = 0.7
"""Of what is off the surface so much may be left for a limb to count as found."""


def away_from(
    guesser: Guesser, cloud: Cloud, surface: Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, " N"]:
    """How far (m) each point of a scan is from a surface."""
    place = nearest(guesser.fitter.topology, surface, cloud.points, cloud.normals).place
    return np.linalg.norm(cloud.points - place, axis=1)


def found_limbs(
    guesser: Guesser,
    state: ModelState,
    cloud: Cloud,
    surface: Float[np.ndarray, "V 3"],
    schedule: tuple[ModelStep, ...],
) -> ModelState | None:
    """The state of one scan with the limbs near its lost piece placed anew; None where that is no
    better.
    """
    few = cloud.first(LOOKED_AT)
    _, place = lost_piece(few.points, away_from(guesser, few, surface))
    tried = state
    for limb in limbs_near(guesser, surface, place):
        tried = _anew(guesser, tried, cloud, limb, schedule)
    before, after = (_quickly_lost(guesser, one, few) for one in (state, tried))
    return tried if after < LESS * before else None


def limbs_near(
    guesser: Guesser, surface: Float[np.ndarray, "V 3"], place: Float[np.ndarray, " 3"]
) -> list[Limb]:
    """The arm, leg or head nearest a place (m), and those hardly further off."""
    weights = guesser.fitter.body.skinning_weights
    limbs = guesser.limbs[:WHOLE]
    mine = [weights[:, limb.joints].sum(1) > 0.5 for limb in limbs]
    away = np.array([np.linalg.norm(surface[rows] - place, axis=1).min() for rows in mine])
    return [limb for limb, far in zip(limbs, away, strict=True) if far <= away.min() + NEAR]


def _anew(
    guesser: Guesser, state: ModelState, cloud: Cloud, limb: Limb, schedule: tuple[ModelStep, ...]
) -> ModelState:
    """A whole limb and its parts in the ways of the bank, then turned about itself, then hand or
    foot.
    """
    fitter = guesser.fitter
    names = guesser.fitter.body.joint_names
    parts = [one for one in guesser.limbs if np.isin(one.joints, limb.joints).all()]
    state = fitter.fit(guesser.scene(cloud).limbs(state, parts), [cloud], schedule)
    for tries in (ARMS, TRIES):
        own = {
            name: ways
            for name, ways in tries.items()
            if name in names and names.index(name) in limb.joints
        }
        state = with_extremities(fitter, state, cloud, own)
    return state


def _quickly_lost(guesser: Guesser, state: ModelState, cloud: Cloud) -> float:
    """The share of a scan that lies together off the model and a quick offset."""
    _, (surface,) = fit_with_offsets(guesser.fitter, state, [cloud], QUICK)
    return lost_share(cloud.points, away_from(guesser, cloud, surface))
