"""One Wavefront .obj file a frame, for tools that know nothing else."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from habitus.export.arrays import up_rotation
from habitus.io.files import atomic_write

if TYPE_CHECKING:
    from habitus.fit.mosh.result import MarkerFit


def write_obj_sequence(
    fit: "MarkerFit", folder: str | os.PathLike[str], frames: Iterable[int] | None = None, *, y_up: bool = False
) -> list[Path]:
    """Write the fitted surface of ``frames`` (default: all) as ``<capture>_<frame>.obj`` and return the paths.

    Metres; the capture's own world frame, or turned so that +y is up with ``y_up``. The vertex order never changes.
    Each file is written whole or not at all. Raises HabitusError where the folder cannot be written to.
    """
    chosen = range(len(fit.pose)) if frames is None else list(frames)
    turn = up_rotation(fit.up_axis) if y_up else np.eye(3)
    faces = "".join(f"f {a} {b} {c}\n" for a, b, c in fit.body.faces + 1)
    written = []
    for frame, vertices in zip(chosen, fitted_vertices(fit, chosen), strict=True):
        path = Path(folder) / f"{Path(fit.capture_name).name}_{frame:06d}.obj"
        with atomic_write(path) as temporary:
            temporary.write_text(f"# {len(vertices)} vertices, metres\n{obj_lines(vertices @ turn.T)}{faces}", "ascii")
        written.append(path)
    return written


def fitted_vertices(
    fit: "MarkerFit", frames: Iterable[int], vertices: np.ndarray | None = None
) -> Iterator[np.ndarray]:
    """Yield the fitted surface (V, 3), or some vertices, of each frame: metres, capture world, with soft tissue."""
    for surface in fit.surfaces(np.asarray(list(frames), dtype=np.int64), vertices):
        yield from surface.vertices


def obj_lines(vertices: np.ndarray) -> str:
    """Vertices (V, 3) as lines of an OBJ file."""
    return ("v %.6f %.6f %.6f\n" * len(vertices)) % tuple(vertices.ravel())
