"""What a body model answers about the person: its measurements."""

from functools import cached_property

import numpy as np

from habitus.arrays import to_numpy
from habitus.body.measurements import MeasuringKit, lay_out, measure, measure_many
from habitus.body.state import BodySurface
from habitus.errors import HabitusError
from habitus.types import ArrayLike


class Measured:
    """Of a `habitus.body.model.BodyModel`: how tall, how heavy, how wide."""

    @cached_property
    def measuring_kit(self) -> MeasuringKit | None:
        """Tapes and yardsticks laid on the template; None for hands and animals."""
        return lay_out(self)  # type: ignore[arg-type]

    def measure(self, surface: BodySurface | ArrayLike | None = None) -> dict[str, float]:
        """Measurements of a person at rest (`habitus.body.measurements`), in metres and kilograms.

        Of the template, of shape coefficients (B,), or of the person whose surface is given,
        whatever its pose: a surface knows its betas. Raises HabitusError for several people.
        """
        betas = () if surface is None else getattr(surface, "betas", surface)
        rest = self.rest_vertices(to_numpy(betas, np.float64))  # type: ignore[attr-defined]
        if rest.ndim != 2:
            raise HabitusError(f"{rest.shape[:-2]} people to measure; give the betas of one, (B,)")
        return measure(self, rest, self.measuring_kit)  # type: ignore[arg-type]

    def measure_rest(self, rest_vertices: np.ndarray) -> dict[str, float]:
        """Measurements of a person whose surface at rest (V, 3) is given, whatever shape it has."""
        return measure(self, rest_vertices, self.measuring_kit)  # type: ignore[arg-type]

    def measure_people(self, betas: ArrayLike) -> dict[str, np.ndarray]:
        """Measurements (N,) of N people at once, of betas (N, B)."""
        rest = self.rest_vertices(to_numpy(betas, np.float64))  # type: ignore[attr-defined]
        return measure_many(self, rest, self.measuring_kit)  # type: ignore[arg-type]
