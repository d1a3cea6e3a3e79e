"""What Blender makes of a file: the program, or its Python module, imports it and tells the surface
of some frames.
"""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

PROGRAMS = {
    "blender": ["blender", "--background", "--python-exit-code", "1", "--python"]
    if shutil.which("blender")
    else None,
    "bpy": [sys.executable] if find_spec("bpy") else None,
}
READERS = {
    # As they are: nothing of an importer is patched. Debian's Blender 3.4.1 reads FBX; its glTF importer
    # needs a NumPy before 1.24, its BVH importer a Python before 3.11, and USD it does not import.
    "blender": {"FBX": ("fbx", "import_scene.fbx")},
    "bpy": {
        "glTF": ("glb", "import_scene.gltf"),
        "FBX, in Python": ("fbx", "import_scene.fbx"),
        "FBX": ("fbx", "wm.fbx_import"),
        "USD": ("usdc", "wm.usd_import"),
    },
}
_SCRIPT = """
import bpy, sys, numpy as np
files, frames, fps = (words.split("|") for words in sys.argv[sys.argv.index("--") + 1 :])
for path, operator in zip(files[::2], files[1::2]):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = int(fps[0])
    if operator.endswith(".fbx"):
        bpy.ops.preferences.addon_enable(module="io_scene_fbx")
    group, call = operator.split(".")
    getattr(getattr(bpy.ops, group), call)(filepath=path)
    body = next(o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups)
    keys = body.data.shape_keys
    found = {"fps": scene.render.fps, "keys": len(keys.key_blocks) - 1 if keys else 0}
    for frame in map(int, frames):
        scene.frame_set(frame + ("fbx" in operator))  # where importers put time zero
        posed = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = posed.to_mesh()
        points = np.empty(3 * len(mesh.vertices))
        mesh.vertices.foreach_get("co", points)
        whole = np.array(posed.matrix_world)
        found[str(frame)] = points.reshape(-1, 3) @ whole[:3, :3].T + whole[:3, 3]
    np.savez(f"{path}.{operator}.npz", **found)
"""


def run(command: Sequence[str | Path]) -> None:
    """A program that must end well."""
    ended = subprocess.run(
        [str(word) for word in command], capture_output=True, timeout=500, text=True
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def in_blender(
    program: str, files: Sequence[tuple[Path, str]], fps: int, frames: Sequence[int]
) -> list[dict]:
    """Of files and the operators that import them: surfaces (V, 3; m, z up) by frame, ``fps`` and
    shape ``keys``.
    """
    script = files[0][0].with_suffix(".py")
    script.write_text(_SCRIPT)
    words = (
        "|".join(map(str, part)) for part in ([w for file in files for w in file], frames, [fps])
    )
    run([*(PROGRAMS[program] or []), script, "--", *words])
    found = []
    for path, operator in files:
        with np.load(f"{path}.{operator}.npz") as seen:
            found.append(
                {int(name) if name.isdecimal() else name: seen[name] for name in seen.files}
            )
    return found
