"""What is written, in Blender: its importers and its armature give the body's surface back.

Skips where Blender is missing: the program itself (``apt-get install blender python3-numpy``), or its Python module.
"""

import shutil
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.export.motion import export_motion
from habitus.export.obj import fitted_vertices

FRAMES = (0, 25, 59)
PROGRAMS = {
    "blender": ["blender", "--background", "--python-exit-code", "1", "--python"] if shutil.which("blender") else None,
    "bpy": [sys.executable] if find_spec("bpy") else None,
}
READERS = {
    "blender": {"glb": "import_scene.gltf", "fbx": "import_scene.fbx"},
    "bpy": {"glb": "import_scene.gltf", "fbx": "wm.fbx_import", "usdc": "wm.usd_import", "old.fbx": "import_scene.fbx"},
}
SCRIPT = """
import bpy, sys, numpy as np
np.bool = getattr(np, "bool", bool)  # some distributions pair an old importer with a new NumPy
folder, *readers = sys.argv[sys.argv.index("--") + 1 :]
for reader in readers:
    name, ending, operator = reader.split(":")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = 60
    if "fbx" in ending and hasattr(bpy.ops.preferences, "addon_enable"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    group, call = operator.split(".")
    getattr(getattr(bpy.ops, group), call)(filepath=f"{folder}/a.{ending.removeprefix('old.')}")
    body = next(o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups)
    found = {"fps": scene.render.fps, "uv": len(body.data.uv_layers)}
    first = 1 if "fbx" in ending else 0  # where importers put time zero
    for frame in (0, 25, 59):
        scene.frame_set(frame + first)
        posed = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = posed.to_mesh()
        points = np.empty(3 * len(mesh.vertices))
        mesh.vertices.foreach_get("co", points)
        whole = np.array(posed.matrix_world)
        found[str(frame)] = points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3]
    np.savez(f"{folder}/{name}.npz", **found)
"""


@pytest.mark.parametrize("program", PROGRAMS)
def test_blender_shows_the_body(tmp_path, program):
    if PROGRAMS[program] is None:
        pytest.skip(f"no {program} here: apt-get install blender python3-numpy, or pip install bpy")
    fit = synthetic_fit(60, body=tube_body(posedirs=True), rate_hz=60.0)
    for ending in {name.rpartition(".")[2] for name in READERS[program]}:
        export_motion(fit, tmp_path / f"a.{ending}")
    (tmp_path / "read.py").write_text(SCRIPT)
    told = [f"{k}:{ending}:{operator}" for k, (ending, operator) in enumerate(READERS[program].items())]
    command = [*PROGRAMS[program], str(tmp_path / "read.py"), "--", str(tmp_path), *told]
    run = subprocess.run(command, capture_output=True, timeout=180, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    for k, ending in enumerate(READERS[program]):
        with np.load(tmp_path / f"{k}.npz") as found:
            assert found["fps"] == 60
            for frame, expected in zip(FRAMES, fitted_vertices(fit, FRAMES), strict=True):
                away = np.linalg.norm(found[str(frame)] - expected, axis=1)  # z is up in both
                assert away.max() < 2e-4, f"{ending}, frame {frame}"
