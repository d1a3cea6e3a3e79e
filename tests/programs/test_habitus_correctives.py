"""The plain Python that Maya and Unreal share: no NumPy in it, and the same axes however a mesh was
turned.
"""

import ast
import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from imported_person import Imported, exported

FOLDER = Path(__file__).resolve().parents[2] / "programs"


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    import habitus_correctives

    return habitus_correctives


def test_any_turned_or_mirrored_mesh_of_any_person_has_the_bodys_axes(tmp_path, module):
    file = exported("live:64")
    told = module.Correctives(Imported(np.eye(3), 1.0, file).save_drivers(tmp_path).read_text())
    rng = np.random.default_rng(4)
    names = file.body.joint_names
    for order in itertools.permutations(range(3)):
        for signs in itertools.product([1.0, -1.0], repeat=3):
            axes = np.eye(3)[list(order)] * signs
            other = (
                file.body.rest_joints(rng.normal(size=file.body.num_betas)) @ axes.T * 100.0 + 7.0
            )
            found = told.axes(dict(zip(names, other.tolist(), strict=True)))
            assert np.array_equal([sign * np.eye(3)[axis] for axis, sign in found], axes.T)
    with pytest.raises(ValueError, match="another skeleton"):
        told.axes({"Hips": (0.0, 0.0, 0.0)})


def test_text_that_is_none_is_refused(module):
    for text in ("[]", "{}", '{"format": "gltf"}'):
        with pytest.raises(ValueError, match="is no"):
            module.Correctives(text)


def test_folds_need_a_bias_and_a_positive_power(tmp_path, module):
    path = Imported(np.eye(3), 1.0, exported("all", folds=True)).save_drivers(tmp_path)
    told = json.loads(path.read_text())
    folds = [channel for channel in told["channels"] if "_fold_" in channel["name"]]
    assert len(folds) == 4 and all(channel["power"] == 2.0 for channel in folds)
    module.Correctives(json.dumps(told))
    for change in ({"power": 0.0}, {"power": "2"}, {"bias": 1e9}):
        changed = {**told, "channels": [{**folds[0], **change}]}
        with pytest.raises(ValueError, match="without a bias and a positive power"):
            module.Correctives(json.dumps(changed))
    del folds[0]["bias"]
    with pytest.raises(ValueError, match="damaged"):
        module.Correctives(json.dumps({**told, "channels": folds}))


def test_scripts_need_nothing_but_their_program():
    found = set()
    for path in FOLDER.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(), feature_version=(3, 7))):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = (
                    [node.module]
                    if isinstance(node, ast.ImportFrom)
                    else [alias.name for alias in node.names]
                )
                found |= {name.partition(".")[0] for name in names}
    assert found - set(sys.stdlib_module_names) == {"maya", "unreal", "habitus_correctives"}
