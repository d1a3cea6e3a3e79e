# SPDX-License-Identifier: GPL-3.0-or-later
"""Packs the Blender add-on: python blender/build.py [habitus_body.zip]. Needs habitus, whose bodies
go in.
"""

import io
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtr

import habitus
from habitus.body.joint_layouts import SMPL, SMPLH, SMPLX
from habitus.body.measurements import DENSITY, DENSITY_SLOPE, LEAN_DENSITY, WAISTS, volume
from habitus.body.skin import TONES, Skin, skin_of
from habitus.export.png import png
from habitus.fit.from_measurements import ESTIMATE
from habitus.io.models.details import hinges_form

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE / "habitus_body"))  # whose __init__ needs Blender
from folds import fold_shapes  # noqa: E402

NEAR = 0.06
"""Metres from the highest and the lowest point of the template within which anybody's are looked
for.
"""


def body_arrays(name: str) -> dict[str, np.ndarray]:
    """The arrays that the add-on needs of a body at its full level of detail."""
    coarse = habitus.load_body(name)
    model = coarse.full or coarse
    mesh = skin_layout(model).mesh
    shape = {
        "v_template": model.v_template,
        "shapedirs": _short(model.shapedirs),
        "joint_template": model.joint_template,
        "joint_shapedirs": model.joint_shapedirs,
        "joint_names": np.array(model.joint_names),
        "parents": np.array(model.parents),
        "people_mean": model.people_mean,
        "age_years": model.ages.years,
        "age_directions": _short(model.ages.directions),
        "joint_age_directions": np.einsum(
            "jv,vca->jca", model.joint_regressor, model.ages.directions
        ),
        "age_statures": model.ages.statures,
        "age_adult": np.array(model.ages.adult),
        "age_spread": model.ages.spreads,
    }
    skin = {
        "skinning_index": model.skinning_index.astype(np.int32),
        "skinning_value": model.skinning_value.astype(np.float32),
        "faces": mesh.quads.astype(np.int32),
        "uv": mesh.uv.astype(np.float32),
        "face_uv": mesh.quad_uv.astype(np.int32),
    }
    return shape | skin | pose_arrays(model) | _dynamics(model) | _measures(coarse)


def skin_layout(model: Any, tone: str = "medium") -> Skin:
    """The skin of a default body, whose texture coordinates those of the add-on are."""
    skin = skin_of(model.mesh, tone)
    if skin is None:
        raise ValueError(f"{model.name} has no layout of the skin; expected a default body")
    return skin


def pose_arrays(model: Any) -> dict[str, np.ndarray]:
    """Those that the add-on needs of pose blend shapes, folds among them."""
    held = hinges_form(model.hinges)
    folds, shapes = fold_shapes(held, list(model.joint_names), model.drivers, model.posedirs)
    blocks = [shapes[..., 9 * k : 9 * k + 9] for k in range(len(model.drivers))]
    moved = [np.flatnonzero(block.any((1, 2))) for block in blocks]
    folds["fold_values"] = _short(folds["fold_values"])
    return folds | {
        "drivers": np.array(model.drivers),
        "pose_start": np.cumsum([0, *map(len, moved)]),
        "pose_vertices": np.concatenate(moved).astype(np.int32),
        "pose_values": _short(np.concatenate([b[m] for b, m in zip(blocks, moved, strict=True)])),
    }


def _short(values: np.ndarray) -> np.ndarray:
    """To a micrometre: half as large when packed."""
    return (np.round(values * 2**20) / 2**20).astype(np.float32)


def _dynamics(model: Any) -> dict[str, np.ndarray]:
    regressor = model.dynamics.regressor
    if regressor.controls != "joints":
        raise ValueError(f"the add-on knows controls of joints, not {regressor.controls!r}")
    return {
        "dynamics_directions": _short(model.dynamics.directions),
        "dynamics_history": regressor.history,
        "dynamics_drive": regressor.drive,
        "dynamics_joints": np.array(regressor.joints),
        "dynamics_rate": np.array(regressor.rate_hz),
        "dynamics_limits": regressor.limits,
        "dynamics_reach": regressor.reach,
    }


def _measures(model: Any) -> dict[str, np.ndarray]:
    """Where the points that measurements look at lie, along the coefficients (1, ages' shares,
    betas), last axis.

    Tapes lie on the adult's template (``tape_chest_0``) and on those of the ages' mean people (1
    and on).
    """
    ways = np.concatenate([model.ages.directions, model.shapedirs], -1)
    people = np.concatenate([model.v_template[None], model.v_template + np.moveaxis(ways, -1, 0)])
    height, midline = model.v_template[:, 1], model.measuring_kit.midline
    points = {
        "crown": people[:, height > height.max() - NEAR, 1],
        "sole": people[:, height < height.min() + NEAR, 1],
        "crotch": people[:, midline[height[midline] < height[midline].min() + NEAR], 1],
    }
    for k, model_at_age in enumerate([model, *map(model.at_age, model.ages.years)]):
        points |= {f"tape_{name}_{k}": each for name, each in _tapes(model_at_age, people).items()}
    full = model.full
    share = volume(model.v_template, model.faces) / volume(full.v_template, full.faces)
    measures = {
        name: _short(np.moveaxis(np.concatenate([p[:1], p[1:] - p[:1]]), 0, -1))
        for name, p in points.items()
    }
    # sums of so many squares, as rare as a person so far from the mean
    rarest = chdtri(np.arange(1, 7), 2 * ndtr(-ESTIMATE.max_sd))
    densities = np.array([DENSITY, LEAN_DENSITY, DENSITY_SLOPE, *WAISTS])
    return measures | {"volume_share": np.array(share), "densities": densities, "rarest": rarest}


def _tapes(model: Any, people: np.ndarray) -> dict[str, np.ndarray]:
    """Points of tapes across their axes (N, K, 2), on surfaces at rest (N, V, 3)."""
    kit = model.measuring_kit
    standing = kit.standing
    posed = standing.prepared.carried(
        people[:, standing.vertices], model.joint_regressor @ people, standing.pose
    )
    tapes = {
        name: standing.tapes[name].points(posed) @ standing.tapes[name].axes.T
        for name in ("chest", "hip")
    }
    (waist,) = (tape.rings[0] for tape in kit.tapes if tape.name == "waist")
    return tapes | {"waist": waist.points(people) @ waist.axes.T}


def build(path: Path, small: bool = True) -> Path:
    """The zip that Blender installs; with ``small`` its bodies are packed, which takes some
    seconds.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for source in sorted((HERE / "habitus_body").glob("*.*")):
            archive.write(source, f"habitus_body/{source.name}")
        archive.write(HERE / "LICENSE", "habitus_body/LICENSE")
        names = "\n".join(" ".join(layout.joint_names) for layout in (SMPL, SMPLH, SMPLX))
        archive.writestr("habitus_body/joint_names.txt", names)
        for name in ("neutral", "female", "male"):
            file = io.BytesIO()
            (np.savez_compressed if small else np.savez)(file, **body_arrays(name))
            archive.writestr(f"habitus_body/{name}.npz", file.getvalue(), zipfile.ZIP_STORED)
        for tone in TONES:
            picture = png(skin_layout(habitus.load_body("neutral", detail="full"), tone).image)
            archive.writestr(f"habitus_body/skin_{tone}.png", picture, zipfile.ZIP_STORED)
    return path


if __name__ == "__main__":
    print(f"wrote {build(Path(sys.argv[1] if len(sys.argv) > 1 else 'habitus_body.zip'))}")
