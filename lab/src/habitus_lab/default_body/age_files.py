"""Fit the ages of finished bodies anew, in place: minutes, where the whole build takes half an
hour.

python -m habitus_lab.default_body.age_files --mpfb2 FOLDER
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy import sparse

from habitus_lab.default_body.ages import (
    Variation,
    age_directions,
    age_spaces,
    pelvis_kept,
)
from habitus_lab.default_body.asset import age_arrays, write_asset
from habitus_lab.default_body.growth import AGES, SEXES
from habitus_lab.default_body.rig import JOINTS
from habitus_lab.default_body.ruler import Ruler
from habitus_lab.default_body.sliders import read_morphs
from habitus_lab.default_body.sources import BODY_VERTICES, Source, read_source
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.repository import BODIES


def main() -> None:
    """Read the three files, fit, write them back."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mpfb2", type=Path)
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--out", type=Path, help="folder; the files themselves if left out")
    options = parser.parse_args()
    files = {name: dict(np.load(options.bodies / f"{name}.npz")) for name in (*SEXES, "neutral")}
    source = read_source(options.mpfb2)
    for name, (offsets, spread) in fitted_ages(source, files).items():
        arrays = files[name]
        index = arrays["joint_regressor_rows"], arrays["joint_regressor_cols"]
        regressor = sparse.csr_matrix(
            (arrays["joint_regressor_values"], index), (len(JOINTS), len(offsets))
        )
        kept = pelvis_kept(offsets, regressor)
        ages = age_arrays(np.array(AGES), kept, spread)
        write_asset(arrays | ages, (options.out or options.bodies) / f"{name}.npz")


def fitted_ages(
    source: Source, files: dict[str, dict[str, np.ndarray]]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """`agedirs` (V, 3, A) and `age_spread` (A,) of every file."""
    one = files["neutral"]
    base = one["base_vertices"]
    coarse = one["coarse_vertices"][one["coarse_faces"]]
    skins = tuple(f[(f < BODY_VERTICES).all(1)] for f in (one["faces"], coarse))
    variations = {
        name: Variation(
            arrays["v_template"].astype(float),
            arrays["shapedirs"].astype(float),
            skins,
            one["mirror"],
        )
        for name, arrays in files.items()
    }
    rest = RestPose(source, base, one["faces"], one["mirror"], read_morphs(source).average())
    ruler = Ruler(variations["neutral"].template, one["mirror"], skins[0])
    return age_directions(age_spaces(source, base, rest, ruler), variations)


if __name__ == "__main__":
    main()
