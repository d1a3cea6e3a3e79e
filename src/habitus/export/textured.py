"""One posed surface with the person's own colours as .glb: a texture where the body has
coordinates, else by vertex.
"""

import os

import numpy as np
import pygltflib as gl
from jaxtyping import Float, Int

from habitus.body.mesh import BodyMesh
from habitus.export.glb import mesh_document
from habitus.files import atomic_write


def write_textured(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    path: str | os.PathLike[str],
    albedo: Float[np.ndarray, "V 3"],
    mesh: BodyMesh | None = None,
    picture: bytes | None = None,
) -> None:
    """Write a mesh (m, +y up) as .glb, atomically. albedo: linear, 0..1, of each vertex. picture: a
    PNG in sRGB, row 0 at the top, for the coordinates of ``mesh``; with it the vertices' own albedo
    is left out.
    """
    textured = picture is not None and mesh is not None and mesh.triangle_uv(faces) is not None
    document = mesh_document(vertices, faces, mesh if textured else None)
    document.materials[0].pbrMetallicRoughness.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
    document.materials[0].pbrMetallicRoughness.roughnessFactor = 0.9
    if textured:
        assert picture is not None
        document.images = [gl.Image(bufferView=_add(document, picture), mimeType="image/png")]
        document.samplers = [gl.Sampler(magFilter=gl.LINEAR, minFilter=gl.LINEAR_MIPMAP_LINEAR)]
        document.textures = [gl.Texture(source=0, sampler=0)]
        document.materials[0].pbrMetallicRoughness.baseColorTexture = gl.TextureInfo(index=0)
    else:
        colours = np.ascontiguousarray(albedo.clip(0.0, 1.0), dtype="<f4")
        view = _add(document, colours.tobytes(), gl.ARRAY_BUFFER)
        document.accessors.append(
            gl.Accessor(bufferView=view, componentType=gl.FLOAT, count=len(colours), type=gl.VEC3)
        )
        document.meshes[0].primitives[0].attributes.COLOR_0 = len(document.accessors) - 1
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"".join(document.save_to_bytes()))


def _add(document: gl.GLTF2, data: bytes, target: int | None = None) -> int:
    """The number of a new part of the document's binary chunk."""
    blob = document.binary_blob() or b""
    document.bufferViews.append(
        gl.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data), target=target)
    )
    document.set_binary_blob(blob + data + b"\0" * (-len(data) % 4))
    document.buffers[0].byteLength = len(blob) + len(data) + (-len(data) % 4)
    return len(document.bufferViews) - 1
