"""Put the landmarks of landmarks.py on a body that is already built, without the ten minutes of building it.

    python tools/default_body/place_landmarks.py [BODY.npz]

Works while every landmark is one of the body's kept vertices; build.py keeps them all by itself.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from default_body.landmarks import LEFT, MIDLINE

BODY = Path(__file__).resolve().parents[2] / "src/habitus/assets/default_body.npz"


def placed(names: list[str], base_vertices: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """(L,) vertex of each landmark. Raises ValueError naming a landmark whose base vertex the body does not keep."""
    where = {int(base): row for row, base in enumerate(base_vertices)}
    missing = [name for name, base in {**MIDLINE, **LEFT}.items() if base not in where]
    if missing:
        raise ValueError(f"the body does not keep the vertices of {', '.join(missing)}; build it anew with build.py")
    rows = {name: where[base] for name, base in MIDLINE.items()}
    for name, base in LEFT.items():
        rows["left_" + name], rows["right_" + name] = where[base], int(mirror[where[base]])
    return np.array([rows[name] for name in names])


def main() -> None:
    """Read, place, write."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else BODY
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    old = arrays["landmark_vertices"]
    names = [str(name) for name in arrays["landmark_names"]]
    arrays["landmark_vertices"] = placed(names, arrays["base_vertices"], arrays["mirror"]).astype(old.dtype)
    np.savez_compressed(path, **arrays)
    print(f"{int((arrays['landmark_vertices'] != old).sum())} of {len(old)} landmarks moved in {path.name}")


if __name__ == "__main__":
    main()
