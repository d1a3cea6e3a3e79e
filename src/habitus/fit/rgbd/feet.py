"""E_F (T eq. 4.6): the soles of the feet stand on the floor that was found."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.retarget.contacts import find_soles
from habitus.residuals.surface_points import PointMatches


@dataclass(frozen=True, eq=False)
class Footpads:
    """Vertices of the soles as points of the surface: face and corner of each."""

    face: Int[np.ndarray, " P"]
    corner: Int[np.ndarray, " P"]

    @staticmethod
    def of(body: BodyModel) -> "Footpads | None":
        """Those of a body; None where it has no feet."""
        try:
            used = find_soles(body).used
        except HabitusError:
            return None
        order = np.argsort(body.faces.ravel(), kind="stable")
        first = order[np.searchsorted(body.faces.ravel(), used, sorter=order)]
        return Footpads(first // 3, first % 3)

    def on_floor(self, weight: float) -> PointMatches:
        """Drawn to height 0, with ``weight`` in all."""
        count = len(self.face)
        direction = np.tile([[[0.0, np.sqrt(weight / count), 0.0]]], (count, 1, 1))
        return PointMatches(self.face, np.eye(3)[self.corner], np.zeros((count, 3)), direction)
