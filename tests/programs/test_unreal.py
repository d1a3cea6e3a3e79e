"""Unreal's editor script against a stub of the editor: the curves that it bakes make habitus' own
surface.
"""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from imported_person import Imported, exported
from scipy.spatial.transform import Rotation
from unreal_stub import Sequence, module

FOLDER = Path(__file__).resolve().parents[2] / "programs"
UNREAL = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
"""From the body's axes (y up, right-handed) to a mesh's in Unreal (z up, left-handed): a mirror."""


def motion_of(person: Imported) -> Sequence:
    def pair(turns):
        return person.rests[:, :3, 3], Rotation.from_matrix(turns).as_quat()

    still = Rotation.from_matrix(person.rest_turns).as_matrix()
    return Sequence(
        ["root", *person.file.body.joint_names],
        tuple(np.concatenate([[part[0]], part]) for part in pair(still)),
        [
            tuple(np.concatenate([[part[0]], part]) for part in pair(turns))
            for turns in person.worlds
        ],
        30.0,
        {"left_knee_xy": [(0.0, 9.0)], "smile": [(0.0, 1.0)]},
    )


@pytest.fixture(params=[False, True], ids=["without folds", "with folds"])
def editor(monkeypatch, request):
    person = Imported(UNREAL, 100.0, exported("all", request.param))
    imported = []
    assets = {
        "/Game/dance": motion_of(person),
        "/Game/People/walk": object(),
        "/Game/People/bones": "bones",
    }
    monkeypatch.setitem(sys.modules, "unreal", module(assets, imported))
    monkeypatch.syspath_prepend(str(FOLDER))
    yield person, assets, imported, importlib.import_module("habitus_unreal")
    sys.modules.pop("habitus_unreal", None)


def test_curves_make_the_bodys_own_surface(tmp_path, editor):
    person, assets, _, script = editor
    path = person.save_drivers(tmp_path)
    count = script.bake("/Game/dance", path, "/Game/People/walk")
    motion = assets["/Game/dance"]
    names = person.file.animation.morph_names
    weights = np.zeros((len(person.file.poses), len(names)))
    for name, keys in motion.curves.items():
        if name in names:
            assert np.allclose([time for time, _ in keys], [0, 1 / 30])
            weights[:, names.index(name)] = [value for _, value in keys]
    assert person.file.off(weights).max() < 1e-4 + 1e-3 and person.file.bare.max() > 0.01
    assert np.abs(weights - person.file.weights).max() < 1.1e-3  # what is too small for a curve
    assert (
        motion.saved and motion.curves["smile"] == [(0.0, 1.0)] and count == len(motion.curves) - 1
    )
    with pytest.raises(ValueError, match="there is no /Game/song"):
        script.bake("/Game/song", path, "/Game/People/walk")
    motion.names[4] = "elsewhere"
    with pytest.raises(ValueError, match="needs the joint spine1"):
        script.bake("/Game/dance", path, "/Game/People/walk")


def test_an_import_keeps_rate_units_and_morph_targets(editor):
    _, _, imported, script = editor
    assert script.import_person("walk.fbx", "/Game/People", "/Game/People/bones") == [
        "/Game/People/walk"
    ]
    (task,) = imported
    options = task.held["options"].held
    assert (
        options["import_as_skeletal"]
        and options["import_animations"]
        and options["skeleton"] == "bones"
    )
    assert options["skeletal_mesh_import_data"].held["import_morph_targets"]
    assert not options["anim_sequence_import_data"].held["use_default_sample_rate"]
    assert task.held["automated"] and Path(task.held["filename"]).is_absolute()
    with pytest.raises(ValueError, match="nothing was imported"):
        script.import_person("run.obj", "/Game/People")
