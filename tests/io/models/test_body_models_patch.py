"""The patch for the package ``body-models`` (docs/patches): its model gives our body's surface."""

import re
from pathlib import Path

import numpy as np
import pytest

from habitus.io.models.bodies import load_body, save_body

PATCH = Path(__file__).parents[3] / "docs/patches/body-models.patch"
NEW = re.compile(
    r"^diff --git a/(\S+) b/\1\nnew file mode \d+\nindex \S+\n.*\n.*\n@@ .* @@\n", re.M
)


def added_files(patch: str) -> dict[str, str]:
    """The files that a patch adds, by their paths."""
    found = {}
    for match in NEW.finditer(patch):
        body = patch[match.end() :].partition("\ndiff --git ")[0]
        found[match[1]] = (
            "\n".join(line[1:] for line in body.splitlines() if line[:1] == "+") + "\n"
        )
    return found


def test_the_patch_adds_a_model_and_its_page():
    files = added_files(PATCH.read_text())
    folder = "src/body_models/habitus/"
    assert {
        f"{folder}{name}.py" for name in ("__init__", "_io", "_model", "numpy", "torch", "jax")
    } | {"docs/models/habitus.md"} == set(files)
    for name, text in files.items():
        if name.endswith(".py"):
            compile(text, name, "exec")


@pytest.mark.parametrize("runtime", ["numpy", "torch"])
def test_its_surface_is_ours(runtime, tmp_path):
    package = pytest.importorskip(
        "body_models", reason="no body-models here: pip install body-models"
    )
    array = np.asarray
    if runtime == "torch":
        array = pytest.importorskip("torch").tensor
    for name, text in added_files(PATCH.read_text()).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    package.__path__.append(str(tmp_path / "src/body_models"))
    try:
        from importlib import import_module

        module = import_module(f"body_models.habitus.{runtime}")
        for name in ("default", "female"):
            body = load_body(name)
            save_body(body, tmp_path / "body.npz")
            model = module.Habitus(model_path=tmp_path / "body.npz")
            rng = np.random.default_rng(0)
            pose, betas = 0.6 * rng.normal(size=(4, 24, 3)), rng.normal(size=(4, 24))
            pose[0, body.joint_names.index("left_knee")] = [2.2, 0.0, 0.0]
            pose[1, body.joint_names.index("left_elbow")] = [0.0, -2.2, 0.0]
            ours = body(betas, pose, np.zeros((4, 3)))
            given = {
                "body_pose": array(pose[:, 1:].astype(np.float32)),
                "pelvis_rotation": array(pose[:, 0].astype(np.float32)),
                "shape": array(betas.astype(np.float32)),
            }
            theirs = np.asarray(model.forward_vertices(**given))
            np.testing.assert_allclose(theirs, np.asarray(ours.vertices), atol=2e-6)
            joints = np.asarray(model.forward_skeleton(**given))[..., :3, 3]
            np.testing.assert_allclose(joints, np.asarray(ours.joints), atol=2e-6)
    finally:
        package.__path__.pop()
