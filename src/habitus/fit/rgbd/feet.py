"""E_F (T eq. 4.6): the soles of the feet stand on the floor that was found."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.retarget.contacts import find_soles
from habitus.residuals.robust import geman_mcclure_weight
from habitus.residuals.surface_points import PointMatches

LIFTED = 0.02
"""Metres off the floor at which a sole counts a quarter."""


@dataclass(frozen=True, eq=False)
class Footpads:
    """Vertices of the soles as points of the surface: face and corner of each, and how high (m)
    above the floor each is where the foot stands flat: soles are arched, and round at their rims.
    """

    face: Int[np.ndarray, " P"]
    corner: Int[np.ndarray, " P"]
    height: Float[np.ndarray, " P"]

    @staticmethod
    def of(body: BodyModel) -> "Footpads | None":
        """Those of a body; None where it has no feet."""
        try:
            used = find_soles(body).used
        except HabitusError:
            return None
        order = np.argsort(body.faces.ravel(), kind="stable")
        first = order[np.searchsorted(body.faces.ravel(), used, sorter=order)]
        mean = np.zeros(body.num_betas) if body.people_mean is None else body.people_mean
        rest = body.rest_vertices(mean)[:, 1]
        return Footpads(first // 3, first % 3, rest[used] - rest[used].min())

    def on_floor(
        self, weight: float, surface: Float[np.ndarray, "V 3"], body: BodyModel
    ) -> PointMatches:
        """Drawn to their heights, with ``weight`` in all, those less that are far off it: a foot
        may be lifted.
        """
        count = len(self.face)
        target = np.column_stack([np.zeros(count), self.height, np.zeros(count)])
        off = surface[body.faces[self.face, self.corner], 1] - self.height
        root = np.sqrt(weight / count * geman_mcclure_weight(off, LIFTED))
        return PointMatches(
            self.face,
            np.eye(3)[self.corner],
            target,
            root[:, None, None] * np.array([0.0, 1.0, 0.0]),
        )
