"""Learn the pose blend shapes of the default bodies from simulated flesh, and put them into their
files.

    python -m habitus_lab.default_body.flesh.learn FLESH [female male neutral] [--bodies FOLDER]
        [--numbers FILE]

FLESH is what `run.py --gather` wrote: a folder a sex; the neutral body learns from both. Each body
is trained as `habitus train` does it (docs/training.md), given hinge channels, and held beyond the
ranges of its joints. Everything else in its file stays as it is. The numbers are mean distances
(mm) from simulated surfaces about knees and elbows.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus.jobs.train import Trainer
from habitus.learn.options import EnergyWeights
from habitus_lab.default_body.asset import DESCRIPTION, LEARNED, VERSION, write_asset
from habitus_lab.default_body.flesh.folds import LEAST, errors, folded_body, surfaces
from habitus_lab.default_body.flesh.limits import limited_body
from habitus_lab.default_body.flesh.poses import SEXES
from habitus_lab.default_body.flesh.symmetry import symmetric
from habitus_lab.repository import BODIES

ROTATIONS = 0.01
"""mu of the prior on rotations that were not simulated. Blend shapes damped by .003 after a
training without it had errors .1 mm smaller, and four or five more rotations missed the gate."""


def learned_body(body: BodyModel, space: str, flesh: Path) -> tuple[BodyModel, dict]:
    """A body at full detail with pose blend shapes and hinge channels of simulated flesh, and the
    distances from it: of skinning alone, without channels, and of the result.
    """
    sexes = SEXES if space == "neutral" else (space,)
    trained = (
        Trainer(
            template=body,
            start="body",
            fixed=("skinning_weights", "joint_regressor", "shapedirs", "people", "poses"),
            pose_shapes="local",
            weights=EnergyWeights(pose_shapes=0.02),
            rounds=1,
            rotation_prior=ROTATIONS,
        )
        .fit([flesh / sex for sex in sexes])
        .body
    )
    plain = replace(body, posedirs=None, pose_joints=None, hinges=None, finer=None)
    assert trained.posedirs is not None
    drivers = np.array(trained.drivers)
    posedirs = symmetric(trained.posedirs, drivers, body.mirror)
    learned = replace(plain, posedirs=posedirs, pose_joints=trained.pose_joints)
    data = list(surfaces(flesh, plain, sexes))
    simulated = np.array([one.sample.pose for one in data if not one.tested])
    folded = folded_body(learned, data)
    limited = limited_body(folded, simulated)
    bodies = {"skinning": plain, "no channels": learned, "channels": folded, "limited": limited}
    return limited, errors(bodies, data)


def pose_arrays(body: BodyModel, space: str) -> dict[str, np.ndarray]:
    """The arrays of a body's file on which the shape of a pose depends."""
    hinges = body.hinges
    assert body.posedirs is not None and hinges is not None
    moved = np.abs(hinges.directions).max((1, 2, 3), keepdims=True) > LEAST
    return {
        "posedirs": body.posedirs.astype(np.float16),
        "posedirs_joints": np.array(body.drivers, np.int32),
        "hinge_joints": hinges.joint.astype(np.int32),
        "hinge_rows": hinges.rows.astype(np.float32),
        "hinge_bias": hinges.bias.astype(np.float32),
        "hinge_linear": hinges.linear.astype(np.float32),
        "hingedirs": (hinges.directions * moved).astype(np.float16),
        "description": np.array(DESCRIPTION.format(space=space, pose=LEARNED)),
        "version": np.array(VERSION),
    }


def main() -> None:
    """Learn, write, print the distances."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flesh", type=Path)
    parser.add_argument("spaces", nargs="*", default=["female", "male", "neutral"])
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument("--numbers", type=Path, help="JSON of what is printed")
    options = parser.parse_args()
    numbers = {}
    for space in options.spaces:
        path = options.bodies / f"{space}.npz"
        body = load_body(str(path), detail="full", joints="smplx")
        learned, numbers[space] = learned_body(body, space, options.flesh)
        with np.load(path) as own:
            arrays = dict(own)
        write_asset(arrays | pose_arrays(learned, space), path)
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")
        for key, row in numbers[space].items():
            print("  ", key, *(f"{word} {value:.1f}" for word, value in row.items()), flush=True)
    if options.numbers is not None:
        options.numbers.write_text(json.dumps(numbers, indent=1))


if __name__ == "__main__":
    main()
