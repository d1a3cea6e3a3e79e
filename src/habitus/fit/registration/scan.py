"""A scan: points of a person's surface, with or without triangles, and what was done to it since it
was read.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (N, 3) of a surface, in metres and y up once
    `habitus.fit.registration.cleaning.cleaned` has seen them.

    ``normals`` (N, 3) are unit, outward where ``oriented``, else of either sign. ``faces`` (F, 3)
    where it was a mesh. ``colours`` (M, 3) are linear light, 0 to 1 (files hold sRGB; readers make
    it linear), of the points themselves or of ``colour_places`` (M, 3), in the same unit and axes:
    a picture shows more of a surface than its points. ``to_body`` (4, 4) took the file's own
    numbers to these; ``notes`` say in sentences what was found and done.
    """

    name: str
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"] | None = None
    faces: Int[np.ndarray, "F 3"] | None = None
    oriented: bool = True
    to_body: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()
    colours: Float[np.ndarray, "M 3"] | None = None
    colour_places: Float[np.ndarray, "M 3"] | None = None
