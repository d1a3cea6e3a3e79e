"""Readers of skeletons in motion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from target import Target, alone

BVH = b"""HIERARCHY
ROOT Hips
{
  OFFSET 0.0 90.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 9.0 -2.0 0.0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 -40.0 0.0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.00833333
0 90 0 1 2 3 4 5 6
0 91 0 1 2 3 4 5 6
"""


def motion_makers() -> tuple[Callable[[Path], list[Target]], ...]:
    """What makes the targets, each in a folder of its own."""
    return _skeletons, _characters, _scenes


def _check(motion) -> None:
    rig = motion.rig
    assert len(motion.places) > 0 and 0 < motion.rate_hz < 1e5
    assert np.isfinite(motion.places).all() and np.isfinite(motion.turns).all()
    assert all(parent < k for k, parent in enumerate(rig.parents))
    assert len(rig.names) == len(rig.ends) == len(rig.places)


def _read_bvh(path: Path) -> None:
    from habitus.io.motions.bvh import read_bvh

    _check(read_bvh(path))


def _skeletons(_: Path) -> list[Target]:
    return [alone("motion.bvh", _read_bvh, BVH)]


def _read_gltf(path: Path) -> None:
    from habitus.export.character import skin_of
    from habitus.io.motions.gltf import read_gltf, read_gltf_motion

    _check(read_gltf_motion(path))
    assert np.isfinite(skin_of(read_gltf(path)).vertices).all()


def _characters(folder: Path) -> list[Target]:
    from made_character import write_character

    write_character(folder / "a.glb", step=40)
    return [alone("motion.glb", _read_gltf, (folder / "a.glb").read_bytes())]


def _read_fbx(path: Path) -> None:
    from habitus.export.fbx.character import skin_of_scene
    from habitus.io.motions.fbx import read_fbx
    from habitus.io.motions.fbx_motion import read_fbx_motion

    _check(read_fbx_motion(path))
    assert np.isfinite(skin_of_scene(read_fbx(path)).vertices).all()


def _scenes(folder: Path) -> list[Target]:
    from made_fbx_character import as_text, write_fbx_character

    write_fbx_character(folder / "a.fbx", step=40, frames=3)
    binary = (folder / "a.fbx").read_bytes()
    return [
        alone("motion.fbx", _read_fbx, binary),
        alone("motion_text.fbx", _read_fbx, as_text(binary).encode()),
    ]
