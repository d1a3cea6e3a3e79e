"""The floor in a depth image: the largest level plane below the camera (T eq. 4.6 needs it; so does
what is up).

E_F (T eq. 4.6): the soles of the feet stand on the floor that was found.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.retarget.contacts import find_soles
from habitus.residuals.points import PointObservations
from habitus.solve.terms import geman_mcclure_weight

TRIES = 300
SAMPLE = 4000
NEAR = 0.006
"""Metres over depth squared within which a point counts as on the plane, and 1 cm more."""
STEEPEST = 40.0
"""Degrees that a camera may be tilted."""
FEWEST = 0.02
"""Share of the image's points on a plane that makes it a floor."""
LEAST = 500


@dataclass(frozen=True, eq=False)
class Floor:
    """A plane in the sensor's frame: ``normal`` (up) times a point is ``height``; below the camera
    height < 0.
    """

    normal: Float[np.ndarray, " 3"]
    height: float

    def above(self, points: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "*any"]:
        """Metres of points above it."""
        return points @ self.normal - self.height

    @property
    def world(self) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
        """Rotation and translation from the sensor's frame to a world with y up and the floor at
        0.
        """
        return level_frame(self.normal), np.array([0.0, -self.height, 0.0])


def level_frame(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation from the sensor's frame to one whose y is up and whose z points back to the
    camera.
    """
    back = np.array([0.0, 0.0, -1.0])
    back = back - up * (back @ up)
    back /= np.linalg.norm(back)
    return np.stack([np.cross(up, back), up, back])


def find_floor(
    points: Float[np.ndarray, "H W 3"], seen: Bool[np.ndarray, "H W"], seed: int = 0
) -> Floor | None:
    """The floor among the points (m) that were seen, or None. Sensor's frame: y down, z forward."""
    found = points[seen]
    if len(found) < LEAST:
        return None
    rng = np.random.default_rng(seed)
    some = found[rng.choice(len(found), min(SAMPLE, len(found)), replace=False)]
    best = None
    most = 0.0
    for _ in range(TRIES):
        plane = _through(some[rng.choice(len(some), 3, replace=False)])
        if plane is None:
            continue
        off = np.abs(plane.above(some)) < _tolerance(some)
        below = np.mean(plane.above(some) < -2.0 * _tolerance(some))
        score = off.mean() - below
        if plane.height < -0.2 and off.mean() > FEWEST and below < 0.02 and score > most:
            best = plane
            most = score
    return None if best is None else _refined(best, found)


def _tolerance(points: np.ndarray) -> np.ndarray:
    return 0.01 + NEAR * points[:, 2] ** 2


def _through(points: Float[np.ndarray, "3 3"]) -> Floor | None:
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    length = np.linalg.norm(normal)
    if length < 1e-6:
        return None
    normal = normal / length * -np.sign(normal[1] or 1.0)
    if -normal[1] < np.cos(np.deg2rad(STEEPEST)):
        return None
    return Floor(normal, float(points[0] @ normal))


def _refined(plane: Floor, points: np.ndarray) -> Floor:
    """The plane of least squares through the points near it, each by its certainty."""
    for _ in range(3):
        near = points[np.abs(plane.above(points)) < _tolerance(points)]
        weight = 1.0 / near[:, 2] ** 4
        middle = (near * weight[:, None]).sum(0) / weight.sum()
        apart = near - middle
        normal = np.linalg.eigh((apart * weight[:, None]).T @ apart)[1][:, 0]
        normal = normal * -np.sign(normal[1] or 1.0)
        plane = Floor(normal, float(middle @ normal))
    return plane


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
    ) -> PointObservations:
        """Drawn to their heights, with ``weight`` in all, those less that are far off it: a foot
        may be lifted.
        """
        count = len(self.face)
        target = np.column_stack([np.zeros(count), self.height, np.zeros(count)])
        off = surface[body.faces[self.face, self.corner], 1] - self.height
        root = np.sqrt(weight / count * geman_mcclure_weight(off, LIFTED))
        return PointObservations(
            self.face,
            np.eye(3)[self.corner],
            target,
            root[:, None, None] * np.array([0.0, 1.0, 0.0]),
        )
