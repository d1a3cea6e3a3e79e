"""What is known of registrations that were made, not scanned: poses, places, shape coefficients,
rest surfaces.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float, Int

from habitus.errors import HabitusError


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of N registrations, NaN in the rows of which it is not; None where it is of
    none.

    ``pose`` (rotation vectors, rad, root first) and ``betas`` are by the joints and shape
    directions of the body that a training starts from, ``trans`` (m) is where it stands. ``rest``
    has the rest surfaces (m) of some subjects, by name: a subject that is not in it has the body's
    surface of its ``betas``.
    """

    pose: Float[np.ndarray, "N J 3"] | None = None
    trans: Float[np.ndarray, "N 3"] | None = None
    betas: Float[np.ndarray, "N B"] | None = None
    rest: Mapping[str, Float[np.ndarray, "V 3"]] = field(
        default_factory=lambda: MappingProxyType({})
    )

    def check(self, count: int, vertices: int) -> None:
        """Raise HabitusError where these do not fit so many registrations of so many vertices."""
        for name, last in (("pose", (None, 3)), ("trans", (3,)), ("betas", (None,))):
            array = getattr(self, name)
            if array is not None and not _fits(array, (count, *last)):
                want = ", ".join("*" if n is None else str(n) for n in (count, *last))
                raise HabitusError(
                    f"the registrations' {name} have shape {array.shape}; expected numbers ({want})"
                )
        for subject, surface in self.rest.items():
            if not _fits(surface, (vertices, 3)) or not np.isfinite(surface).all():
                raise HabitusError(
                    f"the rest surface of {subject} has shape {surface.shape}, or numbers that "
                    "are not finite; "
                    f"expected ({vertices}, 3)"
                )

    def take(self, rows: Int[np.ndarray, " n"]) -> "Known":
        """What is known of these registrations."""
        return Known(
            _rows(self.pose, rows), _rows(self.trans, rows), _rows(self.betas, rows), self.rest
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """``pose``, ``trans`` and ``betas``, by name, where they are known."""
        arrays = {"pose": self.pose, "trans": self.trans, "betas": self.betas}
        return {name: array for name, array in arrays.items() if array is not None}

    def known_rows(self, name: str, count: int) -> Bool[np.ndarray, " N"]:
        """Of which of ``count`` registrations ``pose``, ``trans`` or ``betas`` is known."""
        array = getattr(self, name)
        return (
            np.zeros(count, bool) if array is None else np.isfinite(array.reshape(count, -1)).all(1)
        )


def _fits(array: np.ndarray, shape: tuple[int | None, ...]) -> bool:
    alike = array.ndim == len(shape) and all(
        n in (None, m) for n, m in zip(shape, array.shape, strict=True)
    )
    return alike and array.dtype.kind == "f" and not np.isinf(array).any()


def _rows(array: np.ndarray | None, rows: np.ndarray) -> np.ndarray | None:
    return None if array is None else array[rows]
