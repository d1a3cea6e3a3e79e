"""A scan: points of a person's surface, with or without triangles, and what was done to it since it was read."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class Scan:
    """Points (N, 3) of a surface, in metres and y up once `habitus.fit.registration.cleaning.cleaned` has seen them.

    ``normals`` (N, 3) are unit, outward where ``oriented``, else of either sign. ``faces`` (F, 3) where it was a mesh.
    ``to_body`` (4, 4) took the file's own numbers to these; ``notes`` say in sentences what was found and done.
    """

    name: str
    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"] | None = None
    faces: Int[np.ndarray, "F 3"] | None = None
    oriented: bool = True
    to_body: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    notes: tuple[str, ...] = ()
