"""What a detector found in the pictures of one camera or several, frame by frame."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError, listed


@dataclass(frozen=True, eq=False)
class Detections:
    """Keypoints of up to P people in C cameras over T frames.

    names (K,): of `habitus.body.keypoints.CONVENTIONS`, or of the table assets/keypoints.toml.
    pixels (T, C, P, K, 2): pixel centres at halves, NaN where missing; confidence (T, C, P, K), 0
    to 1, 0 where missing. The order of people means nothing. first_number: the first frame's in the
    files' own numbers.
    """

    name: str
    convention: str
    names: tuple[str, ...]
    cameras: tuple[str, ...]
    pixels: Float[np.ndarray, "T C P K 2"]
    confidence: Float[np.ndarray, "T C P K"]
    rate_hz: float
    notes: tuple[str, ...] = ()
    first_number: int = 0

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.pixels)

    @property
    def people(self) -> int:
        """P."""
        return self.pixels.shape[2]

    def of_cameras(self, names: tuple[str, ...]) -> "Detections":
        """Those of these cameras, in their order. Names match where their letters and numbers do:
        ``cam01_json`` is ``cam_01``; one camera alone matches whatever its name. Raises
        HabitusError where one is missing.
        """
        if len(names) == len(self.cameras) == 1:
            return replace(self, cameras=names)
        own = {plain_camera_name(name): k for k, name in enumerate(self.cameras)}
        rows = [own.get(plain_camera_name(name), -1) for name in names]
        if -1 in rows or len(own) < len(self.cameras):
            raise HabitusError(
                f"{self.name}: detections of {listed(self.cameras)}, calibration of "
                f"{listed(names)}; expected the same names in both"
            )
        return replace(
            self,
            cameras=names,
            pixels=self.pixels[:, rows],
            confidence=self.confidence[:, rows],
        )


def plain_camera_name(name: str) -> tuple[str, str]:
    """Letters without what names of files add, and numbers without leading zeros."""
    low = name.lower()
    for ending in ("_json", "-json", "_keypoints", "_pose", ".json"):
        low = low.removesuffix(ending)
    letters = "".join(c for c in low if c.isalpha())
    digits = "".join(c if c.isdigit() else " " for c in low).split()
    return letters, " ".join(str(int(part[-18:])) for part in digits)
