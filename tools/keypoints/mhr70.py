"""Where SAM 3D Body's keypoints are on our body, from its output for people: prints the tables to be
put into ``habitus/assets/keypoints.toml``.

    python tools/keypoints/mhr70.py person0.npz person1.npz ...

Our body is fitted to each person's mesh (`habitus.cameras` with ``source="sam3d"``); the person's
keypoints in space then have places in our bones' frames, of which left and right are mirrored.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from habitus.body.keypoints import CONVENTIONS
from habitus.io.archives import open_archive
from habitus.io.keypoints.archives import MHR70
from habitus.io.keypoints.sam3d import mhr_points, read_sam3d
from habitus.jobs.cameras import sam3d
from habitus.jobs.options import CameraOptions
from habitus.observe.keypoints import KeypointRig
from habitus.rotations import procrustes

NAMES = CONVENTIONS["mhr70"]


def offsets_of(path: Path) -> np.ndarray:
    """The keypoints' places (K, 3; m) beside those of the table, in our bones' frames."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(path, folder)
        fit = sam3d(folder, options=CameraOptions(fps=30.0, source="sam3d"))
        capture, _ = read_sam3d(folder, 30.0, fit.body)
    with open_archive(path) as archive:
        mesh = np.asarray(archive.read("pred_vertices"), float)
        points = np.asarray(archive.read("pred_keypoints_3d"), float)
    points = points[[MHR70.index(name) for name in NAMES]]
    own = mhr_points().on(mesh[None])
    turn, shift = procrustes(own, np.asarray(capture.markers)[:1], np.ones(own.shape[:2]))
    points = points @ turn[0].T + shift[0]
    rig = KeypointRig.of(fit.body, NAMES)
    shaped = rig.shaped(fit.betas, np.zeros((len(NAMES), 3)))
    world, _ = shaped.skeleton(fit.pose, fit.trans)
    off = points - shaped.points(fit.pose, fit.trans)[0]
    local = np.einsum("kji,kj->ki", world[0, rig.bone], off)
    local[[name.startswith("right_") for name in NAMES], 0] *= -1.0
    return local


def main(paths: list[str]) -> None:
    """Print the tables."""
    found = np.array([offsets_of(Path(path)) for path in paths])
    plain = [name.removeprefix("left_").removeprefix("right_") for name in NAMES]
    for name in dict.fromkeys(plain):
        own = found[:, [k for k, other in enumerate(plain) if other == name]].reshape(-1, 3)
        mean = own.mean(0)
        if name in NAMES:
            mean[0] = 0.0
        spread = float(np.sqrt(((own - mean) ** 2).mean()))
        place = ", ".join(f"{x:.4f}" for x in mean)
        print(f"[mhr70.{name}]\noffset = [{place}]\ndefinition = {max(0.006, spread):.4f}\n"
              "noise = 0.008")  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
