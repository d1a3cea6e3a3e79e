"""The body's form alone, on people drawn from sliders: loadable files in minutes, to look at
meshes, joints, weights.

python -m habitus_lab.default_body.form --out FOLDER
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus_lab.default_body.ages import pelvis_kept
from habitus_lab.default_body.asset import FIRST_SHAPES, asset_arrays, write_asset
from habitus_lab.default_body.crowd import tposed
from habitus_lab.default_body.expressions import (
    expression_components,
    expression_units,
    without_jaw,
)
from habitus_lab.default_body.growth import AGES
from habitus_lab.default_body.people import Sliders
from habitus_lab.default_body.regressor import fit_regressor
from habitus_lab.default_body.rig import JOINTS, joint_weights
from habitus_lab.default_body.shape_space import ShapeSpace, principal_shapes
from habitus_lab.default_body.sliders import ANCHORS, MorphSpace, read_morphs
from habitus_lab.default_body.sources import Source, read_source
from habitus_lab.default_body.topology import Topology, build_topology
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.default_body.twist import twist_shapes

COMPONENTS = 24
SPREAD = 0.17
LOCAL_SPREAD = 0.08


def form_arrays(
    space: str,
    source: Source,
    topology: Topology,
    vertices: np.ndarray,
    joints: np.ndarray,
    ages: tuple[np.ndarray, np.ndarray, np.ndarray],
    shapes: ShapeSpace,
    skew: np.ndarray,
) -> dict[str, np.ndarray]:
    """All arrays of one space from its shapes, and from its people in the T-pose the regressor:
    vertices (N,V,3) and joints (N,55,3).
    """
    weights = joint_weights(source, topology.base, topology.mirror)
    regressor = fit_regressor(vertices, joints, weights, topology.mirror, topology.coarse)
    centres = regressor @ shapes.mean
    units = expression_units(source, topology.base)
    jaw = JOINTS.index("jaw")
    units, _ = without_jaw(units, shapes.mean, centres[jaw], weights[:, jaw])
    faces, _ = expression_components(units, topology.mirror)
    twist = twist_shapes(shapes.mean, centres, weights, topology.mirror)
    ages = ages[0], pelvis_kept(ages[1], regressor), ages[2]
    return asset_arrays(
        space, topology, shapes, regressor, weights, source.mirror, twist, faces, ages, skew
    )


def drawn_people(morphs: MorphSpace, count: int, rng: np.random.Generator) -> Sliders:
    """Sliders drawn about their middle, of women first, then as many men: no population, but all
    that sliders move.
    """
    macro = {name: np.clip(rng.normal(0.5, SPREAD, count), 0, 1) for name in ANCHORS}
    macro |= {
        "gender": np.repeat([0.0, 1.0], [count // 2, count - count // 2]),
        "age": rng.uniform(0.5, 0.8, count),
    }
    local = rng.normal(0, LOCAL_SPREAD, (count, len(morphs.local_names)))
    return Sliders(macro, rng.dirichlet(np.ones(3), count), local)


def main() -> None:
    """Read, draw a few people, write three files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mpfb2", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--people", type=int, default=200)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    source = read_source(options.mpfb2)
    morphs = read_morphs(source)
    topology = build_topology(source, morphs)
    sliders = drawn_people(morphs, options.people, rng)
    rest = RestPose(source, topology.base, topology.faces, topology.mirror, morphs.average())
    vertices, joints = tposed(morphs.at(rest.points), rest, sliders)
    female = sliders.macro["gender"] < 0.5
    for space, who in (("female", female), ("male", ~female), ("neutral", female | True)):
        still = np.zeros((*vertices.shape[1:], len(AGES)))
        ages = np.array(AGES), still, np.ones(len(AGES))
        shapes = principal_shapes(vertices[who], COMPONENTS, topology.mirror)
        skew = np.zeros(FIRST_SHAPES)
        arrays = form_arrays(
            space, source, topology, vertices[who], joints[who], ages, shapes, skew
        )
        write_asset(arrays, options.out / f"{space}.npz")


if __name__ == "__main__":
    main()
