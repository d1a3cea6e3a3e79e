# SPDX-License-Identifier: GPL-3.0-or-later
"""Packs the Blender add-on: python blender/build.py [habitus_body.zip]. Needs habitus, whose default body goes in."""

import io
import sys
import zipfile
from pathlib import Path

import numpy as np

import habitus

HERE = Path(__file__).resolve().parent


def body_arrays() -> dict[str, np.ndarray]:
    """The arrays that the add-on needs of the default body at its full level of detail."""
    model = habitus.load_body("default")
    model = model.full or model
    blocks = [model.posedirs[..., 9 * k : 9 * k + 9] for k in range(len(model.drivers))]
    moved = [np.flatnonzero(block.any((1, 2))) for block in blocks]
    quads = model.mesh
    return {
        "v_template": model.v_template,
        "shapedirs": model.shapedirs.astype(np.float32),
        "joint_template": model.joint_template,
        "joint_shapedirs": model.joint_shapedirs,
        "joint_names": np.array(model.joint_names),
        "parents": np.array(model.parents),
        "drivers": np.array(model.drivers),
        "pose_start": np.cumsum([0, *map(len, moved)]),
        "pose_vertices": np.concatenate(moved),
        "pose_values": np.concatenate([b[m] for b, m in zip(blocks, moved, strict=True)]).astype(np.float32),
        "skinning_index": model.skinning_index,
        "skinning_value": model.skinning_value.astype(np.float32),
        "quads": quads.quads,
        "uv": quads.uv.astype(np.float32),
        "quad_uv": quads.quad_uv,
    }


def build(path: Path) -> Path:
    """The zip that Blender installs."""
    file = io.BytesIO()
    np.savez_compressed(file, **body_arrays())
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for source in sorted((HERE / "habitus_body").glob("*.*")):
            archive.write(source, f"habitus_body/{source.name}")
        archive.write(HERE / "LICENSE", "habitus_body/LICENSE")
        archive.writestr("habitus_body/body.npz", file.getvalue())
    return path


if __name__ == "__main__":
    print(f"wrote {build(Path(sys.argv[1] if len(sys.argv) > 1 else 'habitus_body.zip'))}")
