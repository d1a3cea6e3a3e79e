"""What is written, in assimp (the importer of many engines and viewers): meshes, bones, blend shapes
and the animation.

Skips where assimp is missing: ``apt-get install assimp-utils``. Tried with assimp 5.2.5.
"""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.export.motion import export_motion

FRAMES = 20


def assimp_info(path: Path) -> dict[str, float]:
    """The table of numbers that ``assimp info`` prints."""
    program = shutil.which("assimp")
    if program is None:
        pytest.skip("no assimp here: apt-get install assimp-utils")
    done = subprocess.run([program, "info", path], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ignoring" not in done.stdout, done.stdout  # a link that it cannot follow
    rows = re.findall(r"^([A-Z][\w .]+?):\s+([\d.]+)", done.stdout, re.MULTILINE)
    return {name: float(value) for name, value in rows}


@pytest.mark.parametrize("ending", ["fbx", "glb"])
def test_assimp_finds_the_animation(tmp_path, ending):
    fit = synthetic_fit(FRAMES, body=tube_body(posedirs=True), rate_hz=60.0)
    export_motion(fit, tmp_path / f"a.{ending}", correctives="pca:5")
    found = assimp_info(tmp_path / f"a.{ending}")
    assert found["Animations"] == 1 and found["Meshes"] >= 1
    moving = np.ptp(fit.pose, axis=0).any(axis=1).sum()
    assert found["Animation Channels"] >= moving > 1
    assert found["Bones"] >= fit.body.num_joints
