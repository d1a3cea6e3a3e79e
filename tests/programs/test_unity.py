"""The Unity package, compiled by Mono against a stub of the engine: its blend shapes make habitus'
own surface.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from imported_person import UNITY, Z_UP, Imported, exported
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "programs" / "unity"
needs_mono = pytest.mark.skipif(
    shutil.which("mcs") is None,
    reason="no Mono here: apt-get install --no-install-recommends mono-mcs mono-runtime",
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    program = tmp_path_factory.mktemp("mono") / "drive.exe"
    sources = [*PACKAGE.glob("Runtime/*.cs"), *Path(__file__).parent.glob("unity/*.cs")]
    told = subprocess.run(
        ["mcs", "-langversion:7.2", "-warnaserror", f"-out:{program}", *map(str, sources)],
        capture_output=True,
        text=True,
    )
    assert told.returncode == 0, told.stdout + told.stderr
    return program


def given(person: Imported, full: float, prefix: str) -> str:
    """What the stub of the engine poses, as text: the scene's turn, the mesh, its bones, its
    shapes, the poses.
    """
    file = person.file
    rests = np.linalg.inv(person.rests)
    names = file.body.joint_names
    lines = [
        _quaternions(Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()),
        f"{full} {len(names)}",
    ]
    for name, parent, rest in zip(names, file.body.parents, rests, strict=True):
        lines.append(f"{prefix}{name} {parent} " + " ".join(f"{x:.9g}" for x in rest[:3].ravel()))
    lines += [
        str(len(file.animation.morph_names)),
        *(f"{prefix}{name}" for name in file.animation.morph_names),
    ]
    return "\n".join(
        [*lines, str(len(file.poses)), *(_quaternions(pose) for pose in person.locals)]
    )


def _quaternions(turns: np.ndarray) -> str:
    return " ".join(
        f"{x:.9g}" for x in Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat().ravel()
    )


def driven(program: Path, drivers: Path, text: str) -> subprocess.CompletedProcess[str]:
    folder = drivers.parent
    (folder / "given.txt").write_text(text)
    files = [str(path) for path in (drivers, folder / "given.txt", folder / "found.txt")]
    return subprocess.run(
        ["mono", str(program), *files], capture_output=True, text=True, timeout=60
    )


@needs_mono
@pytest.mark.parametrize(
    ("axes", "scale", "own_axes", "full", "prefix", "folds"),
    [
        (UNITY, 1.0, False, 100.0, "", False),
        (UNITY @ Z_UP, 100.0, True, 1.0, "person:", False),
        (UNITY, 1.0, False, 100.0, "", True),
    ],
    ids=["as the importer leaves it", "bones of other axes, mesh z up in cm", "with folds"],
)
def test_any_pose_gets_the_bodys_own_surface(
    tmp_path, drive, axes, scale, own_axes, full, prefix, folds
):
    person = Imported(axes, scale, exported("all", folds), own_axes)
    told = driven(drive, person.save_drivers(tmp_path), given(person, full, prefix))
    assert told.returncode == 0, told.stderr
    weights = np.loadtxt(tmp_path / "found.txt") / full
    assert person.file.off(weights).max() < 1e-4
    assert person.file.bare.max() > 0.01  # what it adds


@needs_mono
def test_few_blend_shapes_are_driven_alike_and_another_mesh_is_refused(tmp_path, drive):
    person = Imported(UNITY, 1.0, exported("live:64"), own_axes=False)
    text = given(person, 100.0, "")
    assert driven(drive, person.save_drivers(tmp_path), text).returncode == 0
    assert np.abs(np.loadtxt(tmp_path / "found.txt") / 100 - person.file.weights).max() < 1e-5
    refused = driven(
        drive, person.save_drivers(tmp_path), text.replace("left_knee_01\n", "left_knee_99\n")
    )
    assert refused.returncode == 3 and "drives left_knee_01, which body has not" in refused.stderr
    assert "edition 3" in driven(drive, person.save_drivers(tmp_path, version=3), text).stderr


def test_every_file_of_the_package_has_its_meta_file():
    assert json.loads((PACKAGE / "package.json").read_text())["license"] == "Apache-2.0"
    files = [path for path in sorted(PACKAGE.rglob("*")) if path.suffix != ".meta"]
    guids = [
        re.search(r"^guid: ([0-9a-f]{32})$", Path(f"{path}.meta").read_text(), re.M)[1]
        for path in files
    ]
    assert len(set(guids)) == len(guids) and len(guids) == len(list(PACKAGE.rglob("*.meta")))
