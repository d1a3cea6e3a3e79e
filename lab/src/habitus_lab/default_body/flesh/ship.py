"""Put learned pose blend shapes into a shipped body's file; everything else in it stays as it is.

python -m habitus_lab.default_body.flesh.ship female trained/female/model.npz [--bodies FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus_lab.default_body.asset import DESCRIPTION, LEARNED, VERSION, write_asset
from habitus_lab.repository import BODIES


def shipped(
    own: dict[str, np.ndarray], learned: dict[str, np.ndarray], space: str
) -> dict[str, np.ndarray]:
    """A body's arrays with the pose blend shapes of a trained model of the same mesh.

    Raises ValueError for a model whose template is another one.
    """
    if not np.array_equal(own["v_template"], learned["v_template"]):
        raise ValueError(
            f"the model's template is not that of {space}; expected one trained with --template "
            f"{space}"
        )
    drivers = {
        "posedirs": learned["posedirs"].astype(np.float16),
        "posedirs_joints": learned["posedirs_joints"],
    }
    words = {
        "description": np.array(DESCRIPTION.format(space=space, pose=LEARNED)),
        "version": np.array(VERSION),
    }
    return own | drivers | words


def main() -> None:
    """Read both, write the body."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("space", choices=("female", "male", "neutral"))
    parser.add_argument("model", type=Path)
    parser.add_argument("--bodies", type=Path, default=BODIES)
    options = parser.parse_args()
    path = options.bodies / f"{options.space}.npz"
    with np.load(path) as own, np.load(options.model) as learned:
        arrays = shipped(dict(own), dict(learned), options.space)
    write_asset(arrays, path)
    print(
        f"{path}: {len(arrays['posedirs_joints'])} joints drive, {path.stat().st_size / 1e6:.1f} MB"
    )


if __name__ == "__main__":
    main()
