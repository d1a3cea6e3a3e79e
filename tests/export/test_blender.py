"""The GLB in Blender: its importer and its armature give the body's surface back. Skips where Blender is missing."""

import shutil
import subprocess

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.export import write_glb
from habitus.export.obj import fitted_vertices

SCRIPT = """
import bpy, sys, numpy as np
np.bool = getattr(np, "bool", bool)  # some distributions pair an old importer with a new NumPy
glb, out, rate = sys.argv[-3:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=glb)
scene, found = bpy.context.scene, {}
body = next(o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups)
for frame in (0, 25, 60):
    at = frame / float(rate) * scene.render.fps
    scene.frame_set(int(at), subframe=at - int(at))
    posed = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = posed.to_mesh()
    points = np.empty(3 * len(mesh.vertices))
    mesh.vertices.foreach_get("co", points)
    whole = np.array(posed.matrix_world)
    found[str(frame)] = points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3]
np.savez(out, **found)
"""


@pytest.mark.skipif(shutil.which("blender") is None, reason="no Blender here: apt-get install blender")
def test_blender_shows_the_body(tmp_path):
    fit = synthetic_fit(body=tube_body(posedirs=True))
    write_glb(fit, tmp_path / "a.glb", max_morphs=400, tolerance=0)
    (tmp_path / "read.py").write_text(SCRIPT)
    where = [str(tmp_path / "a.glb"), str(tmp_path / "a.npz"), str(fit.rate_hz)]
    command = [
        "blender",
        "--background",
        "--python-exit-code",
        "1",
        "--python",
        str(tmp_path / "read.py"),
        "--",
        *where,
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=180)
    with np.load(tmp_path / "a.npz") as found:
        for frame, expected in zip((0, 25, 60), fitted_vertices(fit, (0, 25, 60)), strict=True):
            assert np.abs(found[str(frame)] - expected).max() < 2e-4  # z is up in both
