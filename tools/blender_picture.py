"""Pictures of a body.glb as Blender reads it, moments side by side: for docs/tutorial.md.

    blender -b -P tools/blender_picture.py -- body.glb out.png 60 1320 1560 2040
    python tools/blender_picture.py -- body.glb out.png 60 1320 1560 2040             # with the package bpy

Numbers are frames of the capture. Rendered with Cycles on the processor.
"""

import sys
import tempfile
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

RATE_HZ = 120
WIDTH = 400
HEIGHT = 560
SAMPLES = 64


def main(glb: str, out: str, frames: list[int]) -> None:
    """Import, light, and render each frame from the front and a little to the side."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = RATE_HZ  # before the import: the importer turns seconds into frames by it
    bpy.ops.import_scene.gltf(filepath=glb)
    body = max(
        (one for one in bpy.data.objects if one.type == "MESH"),
        key=lambda one: len(one.data.vertices),
    )
    ground, camera = _studio(scene)
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for k, frame in enumerate(frames):
            scene.frame_set(frame)
            middle = _middle(body)
            ground.location = (middle.x, middle.y, 0.0)
            camera.location = middle + Vector((1.3, -4.6, 0.5))
            camera.rotation_euler = (middle - camera.location).to_track_quat("-Z", "Y").to_euler()
            scene.render.filepath = str(Path(folder) / f"{k}.png")
            bpy.ops.render.render(write_still=True)
            pictures.append(_pixels(scene.render.filepath))
        _save(np.concatenate(pictures, axis=1), out)


def _middle(body) -> Vector:
    """The middle of the posed body's box, its height that of a standing one's."""
    posed = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([posed.matrix_world @ vertex.co for vertex in posed.to_mesh().vertices])
    x, y, _ = (points.min(axis=0) + points.max(axis=0)) / 2.0
    return Vector((x, y, 0.82))


def _studio(scene) -> tuple:
    """A ground, a sun, a sky and a camera."""
    scene.render.engine, scene.cycles.samples = "CYCLES", SAMPLES
    scene.cycles.use_denoising = False
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    bpy.ops.mesh.primitive_plane_add(size=60)
    ground = bpy.context.object
    ground.data.materials.append(_material((0.32, 0.36, 0.42, 1.0)))
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle, sun.rotation_euler = 2.2, 0.12, (0.8, 0.15, 0.7)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens = 68
    for one in (sun, camera):
        scene.collection.objects.link(one)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    sky = scene.world.node_tree.nodes["Background"].inputs
    sky[0].default_value, sky[1].default_value = (0.55, 0.62, 0.72, 1.0), 0.45
    return ground, camera


def _material(colour: tuple):
    material = bpy.data.materials.new("ground")
    material.use_nodes = True
    material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = colour
    return material


def _pixels(path: str) -> np.ndarray:
    image = bpy.data.images.load(path)
    return np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)


def _save(pixels: np.ndarray, path: str) -> None:
    image = bpy.data.images.new("all", pixels.shape[1], pixels.shape[0])
    image.pixels = pixels.ravel()
    image.filepath_raw = str(Path(path).resolve())
    image.file_format = "PNG"
    image.save()


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :]
    main(given[0], given[1], [int(one) for one in given[2:]])
