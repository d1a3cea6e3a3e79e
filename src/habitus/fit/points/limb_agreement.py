"""How the limbs of one scan agree with those of a person's other scans."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from habitus.fit.points.scan_result import LIMBS, LimbAgreement, ScanFit

MIN_WEIGHT = 0.5
"""Smallest weight of a vertex that counts as observed."""
MIN_LIMB_VERTICES = 30
"""Fewest observed vertices of a limb that is compared."""


def limbs_compared(fits: Sequence[ScanFit]) -> list[ScanFit]:
    """The fits of one person's scans, each with how its limbs agree with the others' (`LIMBS`).

    An arm is nearly round, so that an arm rotated about its own axis can fit the scan as well; the
    offsets of its skin then differ from those in the other scans. With fewer than three scans one
    cannot decide which of them is wrong, and nothing is compared.
    """
    people = [fit for fit in fits if fit.person]
    if len(people) < 3:
        return list(fits)
    body = people[0].body
    offsets = np.stack([fit.skin_offset for fit in people])
    owner = np.asarray(body.skinning_weights).argmax(1)
    found = []
    for fit in fits:
        if not fit.person:
            found.append(fit)
            continue
        k = next(k for k, other in enumerate(people) if other is fit)
        others = np.median(np.delete(offsets, k, 0), axis=0)
        limbs = {}
        for joint in LIMBS:
            if joint not in body.joint_names:
                continue
            rows = (owner == body.joint_names.index(joint)) & (fit.weights > MIN_WEIGHT)
            if rows.sum() >= MIN_LIMB_VERTICES:
                limbs[joint] = _agreement(offsets[k][rows], others[rows])
        found.append(replace(fit, limbs=limbs))
    return found


def _agreement(own: Float[np.ndarray, " N"], others: Float[np.ndarray, " N"]) -> LimbAgreement:
    deviation = float(np.sqrt(np.mean(np.square(own - others))))
    spread = float(own.std() * others.std())
    product = float(np.mean((own - own.mean()) * (others - others.mean())))
    return LimbAgreement(deviation, product / spread if spread > 0.0 else 1.0)
