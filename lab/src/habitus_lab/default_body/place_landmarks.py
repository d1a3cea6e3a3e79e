"""Put the landmarks of landmarks.py on bodies that are already built, without building them anew.

    python -m habitus_lab.default_body.place_landmarks [BODY.npz ...]

Works while every landmark is a coarse vertex of the body; build.py keeps them all by itself. Those
that are no vertices of the base mesh (pupils) stay as they are.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from habitus_lab.default_body.landmarks import LEFT, MIDLINE, OF_WOMEN, landmark_vertices
from habitus_lab.repository import BODIES


def placed(mirror: np.ndarray, coarse: np.ndarray, space: str) -> dict[str, int]:
    """Name -> vertex. Raises ValueError naming the landmarks whose vertices the coarse body
    lacks.
    """
    missing = [name for name, base in {**MIDLINE, **LEFT, **OF_WOMEN}.items() if base not in coarse]
    if missing:
        raise ValueError(
            f"no coarse vertices: those of {', '.join(missing)}; build the bodies anew with "
            "build.py"
        )
    return landmark_vertices(mirror, space)


def main() -> None:
    """Read, place, write."""
    for path in [Path(name) for name in sys.argv[1:]] or sorted(BODIES.glob("*.npz")):
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        before = dict(
            zip(
                arrays["landmark_names"].tolist(), arrays["landmark_vertices"].tolist(), strict=True
            )
        )
        found = before | placed(arrays["mirror"], arrays["coarse_vertices"], path.stem)
        arrays["landmark_names"] = np.array(list(found))
        arrays["landmark_vertices"] = np.array(list(found.values()), np.int32)
        np.savez_compressed(path, **arrays)
        print(
            f"{sum(before.get(name) != k for name, k in found.items())} of {len(found)} moved in "
            f"{path.name}"
        )


if __name__ == "__main__":
    main()
