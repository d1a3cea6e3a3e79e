"""Age as a direction of its own: the mean person of some ages, straight lines between them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError

ADULT = 18.0


@dataclass(frozen=True, eq=False)
class Ages:
    """How the mean person of each of ``years`` (A, rising) differs from the template (m), and how
    tall they stand (m).

    ``statures`` are those of the whole body, so that two levels of detail grow alike; ``adult`` is
    the template's.
    """

    years: Float[np.ndarray, " A"]
    directions: Float[np.ndarray, "V 3 A"]
    statures: Float[np.ndarray, " A"]
    adult: float

    def at(self, years: float | int) -> tuple[Float[np.ndarray, "V 3"], float]:
        """What to add to the template at an age, and the stature of that age over the template's.

        Raises HabitusError for an age before the first or after the last.
        """
        if not self.years[0] <= years <= self.years[-1]:
            raise HabitusError(
                f"age {years:g}: this body knows {self.years[0]:g} to {self.years[-1]:g} years"
            )
        shares = np.array([np.interp(years, self.years, unit) for unit in np.eye(len(self.years))])
        near = np.flatnonzero(shares)
        offset = self.directions[..., near].astype(np.float64) @ shares[near]
        return offset, float(self.statures @ shares) / self.adult
