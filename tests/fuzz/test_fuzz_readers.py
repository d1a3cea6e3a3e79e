"""Every reader, given spoilt files: values or one short clear error. `make fuzz` does the same for
an hour.
"""

import pytest
from attempts import attempt, spoilt
from targets import all_targets

MUTANTS = 12


@pytest.fixture(scope="module")
def targets():
    return {target.name: target for target in all_targets()}


NAMES = (
    "capture.c3d",
    "capture.npz",
    "capture.trc",
    "capture.csv",
    "capture.tsv",
    "layout.toml",
    "layout.json",
    "body.npz",
    "body.pkl",
    "worm.npz",
    "template.npz",
    "template.toml",
    "registrations.npz",
    "mesh.ply",
    "mesh.obj",
    "registrations _npy_folder",
    "registrations _mesh_folder",
    "registrations _numbered_folder",
    "registrations.h5",
    "registrations.zarr",
    "checkpoint",
    "fit.npz",
    "motion.npz",
    "person.npz",
    "archive.sqlite",
    "subject.npz",
    "results",
    "addon.npz",
    "correctives.json",
    "scan.ply",
    "scan.obj",
    "scan.glb",
    "scan.gltf",
    "scan.stl",
    "scan.off",
    "scan.xyz",
    "depth folder",
    "organised cloud",
    "plates.c3d",
    "band.csv",
    "cycles.csv",
    "robot.xml",
    "robot.urdf",
    "pairs.toml",
    "motion.bvh",
    "motion.glb",
    "motion.fbx",
    "motion_text.fbx",
    "vertices.npz",
    "vertices.obj",
    "calibration.toml",
    "calibration.qca.txt",
    "calibration.xcp",
    "calibration.yml",
    "calibration.pickle",
    "easymocap folder",
    "openpose folder",
    "detections.json",
    "list.json",
    "detections.csv",
    "sleap.csv",
    "sam3d keypoints folder",
    "detections.npy",
    "detection lines",
    "camera fit.npz",
    "cameras.json",
    "cameras.yaml",
    "keypoints.json",
    "natnet",
    "qtm.xml",
    "qtm.stream",
    "layout.txt",
    "layout.xml",
    "layout.osim",
    "tapes.smis",
    "tapes.yaml",
    "tapes.json",
    "tapes.csv",
)


@pytest.mark.parametrize("name", NAMES)
def test_sound_files_are_read_and_spoilt_ones_are_read_or_refused(targets, name, tmp_path):
    target = targets[name]
    for tree in target.trees:
        assert attempt(target, tree, tmp_path / "sound") is None
        target.read(tmp_path / "sound" / target.entry)
    wrong = {}
    for number in range(MUTANTS):
        wrong[number] = attempt(*spoilt([target], number), tmp_path / "spoilt")
    assert not {number: text for number, text in wrong.items() if text}


def test_every_reader_has_its_targets(targets):
    assert set(targets) == set(NAMES)
