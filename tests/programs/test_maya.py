"""Maya's node against a stub of Maya: the weights that it drives make habitus' own surface."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from imported_person import Z_UP, Imported, exported
from maya_stub import Scene, modules

FOLDER = Path(__file__).resolve().parents[2] / "programs"


def scene_of(person: Imported) -> Scene:
    """What Maya's FBX plug-in leaves: joints in a name space, a skin whose places have holes, baked
    blend shapes.
    """
    file = person.file
    scene = Scene(history=["skin", "blend"])
    skin = {}
    aliases = {name: f"weight[{3 * k}]" for k, name in enumerate(file.animation.morph_names)}
    for joint, name in enumerate(file.body.joint_names):
        place = 2 * joint
        skin[f"bindPreMatrix[{place}]"] = np.linalg.inv(person.rests[joint]).T.ravel().tolist()
        scene.nodes[f"walk:{name}"] = ("joint", {})
        scene.links[f"skin.matrix[{place}]"] = f"walk:{name}.worldMatrix"
    scene.nodes |= {"skin": ("skinCluster", skin), "blend": ("blendShape", {"aliases": aliases})}
    scene.links["blend.weight[0]"] = "curve.output"
    return scene


def pose(scene: Scene, person: Imported, frame: int) -> None:
    group = np.array([[0.0, 0, 2], [2, 0, 0], [0, 2, 0]])  # a group above, turned and scaled
    for joint, name in enumerate(person.file.body.joint_names):
        world = np.eye(4)
        world[:3, :3] = group @ person.worlds[frame, joint]
        scene.nodes[f"walk:{name}"][1]["worldMatrix[0]"] = world.T.ravel().tolist()


@pytest.fixture
def opened(monkeypatch):
    """A scene, and the module in it."""

    def open_scene(person):
        scene = scene_of(person)
        for name, module in modules(scene).items():
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.syspath_prepend(str(FOLDER))
        monkeypatch.delitem(sys.modules, "habitus_maya", raising=False)
        maya = importlib.import_module("habitus_maya")
        scene.load = lambda scene, path: maya.initializePlugin(Path(path).name)
        return scene, maya

    yield open_scene
    sys.modules.pop("habitus_maya", None)


@pytest.mark.parametrize(
    ("axes", "folds"), [(np.eye(3), False), (Z_UP, True)], ids=["y up", "z up, with folds"]
)
def test_any_pose_gets_the_bodys_own_surface(tmp_path, opened, axes, folds):
    person = Imported(axes, 100.0, exported("all", folds))
    scene, maya = opened(person)
    node = maya.attach(person.save_drivers(tmp_path), "body")
    weights = np.zeros((len(person.file.poses), len(person.file.animation.morphs)))
    for frame, row in enumerate(weights):
        pose(scene, person, frame)
        found = scene.evaluated(node)
        for into, out in scene.links.items():
            if into.startswith("blend.weight["):
                shape, channel = (int(plug.rpartition("[")[2][:-1]) for plug in (into, out))
                row[shape // 3] = found[channel]
    assert person.file.off(weights).max() < 1e-4 and person.file.bare.max() > 0.01
    assert scene.links["blend.weight[0]"].startswith(node)  # the baked curve gave way
    declared = scene.types["habitusCorrectives"]
    assert {first for first, second in declared.affects if second == "weight"} == set(
        declared.attributes
    ) - {"weight"}


def test_what_does_not_belong_together_is_refused(tmp_path, opened):
    person = Imported(np.eye(3), 1.0, exported("live:64"))
    scene, maya = opened(person)
    path = person.save_drivers(tmp_path)
    with pytest.raises(ValueError, match="skinCluster"):
        maya.attach(path)
    del scene.nodes["blend"][1]["aliases"]["left_knee_01"], scene.links["skin.matrix[2]"]
    with pytest.raises(ValueError, match="body has no left_hip, left_knee_01; export both"):
        maya.attach(path, "body")
    with pytest.raises(ValueError, match="edition 3"):
        maya.attach(person.save_drivers(tmp_path, version=3), "body")
    assert "habitus_correctives1" not in scene.nodes
