"""The add-on's own arithmetic of deep folds, which needs NumPy alone: it is habitus' own."""

import importlib
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hinged_body import KNEE, ROW, with_hinges
from synthetic_fit import tube_body

import habitus as hb
from habitus.body.pose_features import pose_coefficients
from habitus.export import folds
from habitus.io.models.bodies import save_body

BLENDER = Path(__file__).resolve().parents[2] / "blender"


@pytest.fixture
def addon(monkeypatch):
    """Imports modules of the add-on without its ``__init__``, which needs Blender."""
    package = types.ModuleType("habitus_body")
    package.__path__ = [str(BLENDER / "habitus_body")]
    monkeypatch.setitem(sys.modules, "habitus_body", package)
    yield lambda name: importlib.import_module(f"habitus_body.{name}")
    for name in [each for each in sys.modules if each.startswith("habitus_body.")]:
        del sys.modules[name]


@pytest.fixture
def build():
    spec = importlib.util.spec_from_file_location("build_addon", BLENDER / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def offsets(body, betas, rotations):
    """What a pose adds at rest."""
    posed = np.zeros((body.num_joints, 3)), rotations, np.pad(betas, (0, body.num_betas - 2))
    driven = body.features, body.hinges, body.shape_features, body.drivers
    return body.pose_directions @ pose_coefficients(*driven, *posed)


@pytest.mark.parametrize("degrees", [0.0, 100.0, 140.0])
def test_bodies_of_files_and_packed_ones_fold_as_the_body_does(tmp_path, addon, build, degrees):
    body = with_hinges(tube_body(posedirs=True))
    save_body(body, tmp_path / "body.npz")
    core = addon("core")
    packed = core.Body(build.pose_arrays(body) | arrays_of(body), "packed")
    pose = np.zeros((body.num_joints, 3))
    pose[body.joint_names.index(KNEE)] = [np.radians(degrees), 0.1, -0.05]
    rotations = hb.rotations.matrix_from_rotvec(pose)
    betas = np.array([1.5, -0.7])
    known = offsets(body, betas, rotations)
    for found in (addon("smpl").read_body(str(tmp_path / "body.npz")), packed):
        assert np.abs(found.correctives(rotations, betas) - known).max() < 1e-5
        names = [str(name) for name in found.arrays["fold_names"]]
        assert names == [f"{side}_knee_fold_{at}" for side in ("left", "right") for at in (60, 84)]
    weights = packed.folded(rotations[None])
    assert weights.shape == (1, 4) and (weights.max() > 0.2) == (degrees > 60)


def arrays_of(body):
    """What the add-on needs besides pose blend shapes."""
    named = {"joint_names": np.array(body.joint_names), "parents": np.array(body.parents)}
    return named | {"v_template": body.v_template, "shapedirs": body.shapedirs}


def test_files_whose_channels_do_not_fit_are_refused(tmp_path, addon):
    save_body(with_hinges(tube_body(posedirs=True)), tmp_path / "body.npz")
    with np.load(tmp_path / "body.npz") as file:
        held = dict(file)
    for change in (
        {"hingedirs": held["hingedirs"][..., :3, :]},
        {"hinge_rows": held["hinge_rows"][:3]},
        {"hinge_joints": np.zeros(4, int)},
    ):
        np.savez(tmp_path / "other.npz", **(held | change))
        with pytest.raises(ValueError):
            addon("smpl").read_body(str(tmp_path / "other.npz"))


def test_names_are_those_of_exports(addon):
    rng = np.random.default_rng(0)
    for rows, bias in (
        (rng.normal(size=(4, 9)), rng.uniform(0.1, 1.0, 4)),
        (np.tile(ROW, (2, 1)), np.array([0.5, 0.5])),
    ):
        assert addon("folds").fold_names(rows, bias) == folds.fold_names(rows, bias)
