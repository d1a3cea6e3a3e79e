"""Put faces on bodies that are already built: closed lips, the jaw's axis, face units, identity,
parts.

    python -m habitus_lab.default_body.add_faces [--bodies FOLDER] [--out FOLDER] [--mpfb2 FOLDER]

build.py does the same by itself.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus_lab.default_body.asset import write_asset
from habitus_lab.default_body.face_arrays import face_maker
from habitus_lab.default_body.sliders import read_morphs
from habitus_lab.default_body.sources import read_source
from habitus_lab.repository import BODIES

SPACES = ("female", "male", "neutral")


def main() -> None:
    """Read, add, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--out", type=Path, help="folder; the files themselves if left out")
    parser.add_argument("--mpfb2", type=Path)
    options = parser.parse_args()
    source = read_source(options.mpfb2)
    morphs = read_morphs(source)
    make = None
    for name in SPACES:
        with np.load(options.bodies / f"{name}.npz", allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        make = make or face_maker(source, morphs, arrays, np.random.default_rng(0))
        before = (options.bodies / f"{name}.npz").stat().st_size
        made = make(arrays)
        path = (options.out or options.bodies) / f"{name}.npz"
        write_asset(arrays | made, path)
        between, left = 1000 * made["face_numbers"]
        print(
            f"{path.name}: {before / 1e6:.2f} -> {path.stat().st_size / 1e6:.2f} MB; faces "
            f"{between:.1f} mm rms from the mean, error on held-out faces {left:.1f} mm",
            flush=True,
        )


if __name__ == "__main__":
    main()
