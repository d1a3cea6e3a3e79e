"""One posed surface as a mesh file: PLY, OBJ or binary glTF 2.0, with texture or vertex colours.

Metres, +y up. Formats whose vertices have one texture coordinate get vertices doubled along the
seams of the texture (`Seams`). The parts of a glTF document that `habitus.export.glb` also needs
are here: `GltfBuffer`, `gltf_primitive`, `gltf_material`.
"""

import json
import os
import struct
from collections.abc import Callable, Mapping, Sized
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gl
from jaxtyping import Float, Int, UInt8

from habitus import __version__
from habitus.arrays import to_numpy
from habitus.body.body_mesh import BodyMesh
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.mesh.normals import vertex_normals

_COMPONENTS = {
    "f4": gl.FLOAT,
    "u1": gl.UNSIGNED_BYTE,
    "u2": gl.UNSIGNED_SHORT,
    "u4": gl.UNSIGNED_INT,
}
SKIN_COLOUR = (0.78, 0.58, 0.47, 1.0)


def write_surface(
    surface: Any, path: str | os.PathLike[str], faces: Int[np.ndarray, "F 3"] | None = None
) -> None:
    """Write a `BodySurface` as one mesh, atomically: .ply (binary), .obj or .glb by the path's
    ending; metres.

    surface: what a body gives, without batch axes and with all its vertices; that of ``body.full``
    brings quads (.obj) and texture coordinates (.obj, .glb) along. faces: the triangles, where the
    surface does not carry its own (``body.faces``). Raises HabitusError for another ending, for
    several surfaces at once, and where the file cannot be written.
    """
    target = Path(path)
    content = _CONTENT.get(target.suffix.lower())
    if content is None:
        raise HabitusError(
            f"cannot write a surface to {target.name}: expected a name in {', '.join(_CONTENT)}"
        )
    vertices = to_numpy(surface.vertices).astype(np.float64)
    triangles = getattr(surface, "faces", None) if faces is None else faces
    if triangles is None:
        raise HabitusError(
            "the surface carries no faces; give them, write_surface(surface, path, "
            "faces=body.faces)"
        )
    triangles = to_numpy(triangles).astype(np.int64)
    if vertices.ndim != 2:
        raise HabitusError(
            f"vertices have shape {vertices.shape}; expected (V, 3), one surface: take one of the "
            "batch"
        )
    if triangles.max(initial=-1) >= len(vertices):
        raise HabitusError(
            f"{len(vertices)} vertices, and faces of more; evaluate the body at all its vertices"
        )
    mesh = getattr(surface, "mesh", None) if faces is None else None
    with atomic_write(target) as temporary:
        temporary.write_bytes(content(vertices, triangles, mesh))


def ply(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: UInt8[np.ndarray, "V 3"] | None = None,
) -> bytes:
    """A binary PLY file's content (m); colours: sRGB of each vertex."""
    points = np.zeros(len(vertices), dtype=[("place", "<f4", 3), ("colour", "u1", 3)])
    points["place"] = vertices
    named = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    if colours is not None:
        points["colour"] = colours
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment metres\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"{'' if colours is None else named}element face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return header.encode("ascii") + (
        (points["place"] if colours is None else points).tobytes() + rows.tobytes()
    )


def _ply(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    return ply(vertices, faces)


def _obj(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    text = f"# {len(vertices)} vertices, metres\n{obj_lines(vertices)}{face_lines(faces, mesh)}"
    return text.encode("ascii")


def _glb(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None
) -> bytes:
    return glb_bytes(mesh_document(vertices, faces, mesh))


def write_textured(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    path: str | os.PathLike[str],
    albedo: Float[np.ndarray, "V 3"],
    mesh: BodyMesh | None = None,
    picture: bytes | None = None,
    roughness: float = 0.9,
) -> None:
    """Write a mesh (m, +y up) as .glb, atomically. albedo: linear, 0..1, of each vertex. picture: a
    PNG in sRGB, row 0 at the top, for the coordinates of ``mesh``; with it the vertices' own albedo
    is left out. roughness: of the material, 0 to 1.
    """
    textured = picture is not None and mesh is not None and mesh.triangle_uv(faces) is not None
    document = mesh_document(vertices, faces, mesh if textured else None)
    if textured:
        assert picture is not None
        add_picture(document, picture, roughness)
    else:
        _white_material(document, roughness)
        colours = np.ascontiguousarray(albedo.clip(0.0, 1.0), dtype="<f4")
        view = _add(document, colours.tobytes(), gl.ARRAY_BUFFER)
        document.accessors.append(
            gl.Accessor(bufferView=view, componentType=gl.FLOAT, count=len(colours), type=gl.VEC3)
        )
        document.meshes[0].primitives[0].attributes.COLOR_0 = len(document.accessors) - 1
    with atomic_write(path) as temporary:
        temporary.write_bytes(glb_bytes(document))


def _white_material(document: gl.GLTF2, roughness: float) -> gl.PbrMetallicRoughness:
    """The document's material, white until its picture or its vertices colour it."""
    material = document.materials[0].pbrMetallicRoughness or gl.PbrMetallicRoughness()
    document.materials[0].pbrMetallicRoughness = material
    material.baseColorFactor = [1.0, 1.0, 1.0, 1.0]
    material.roughnessFactor = roughness
    return material


def add_picture(document: gl.GLTF2, picture: bytes, roughness: float) -> None:
    """Give a document's material a texture: a PNG in sRGB, row 0 at the top."""
    document.images = [gl.Image(bufferView=_add(document, picture), mimeType="image/png")]
    document.samplers = [gl.Sampler(magFilter=gl.LINEAR, minFilter=gl.LINEAR_MIPMAP_LINEAR)]
    document.textures = [gl.Texture(source=0, sampler=0)]
    material = _white_material(document, roughness)
    material.baseColorTexture = gl.TextureInfo(index=0)


def _add(document: gl.GLTF2, data: bytes, target: int | None = None) -> int:
    """The number of a new part of the document's binary chunk."""
    blob = document.binary_blob() or b""
    document.bufferViews.append(
        gl.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data), target=target)
    )
    document.set_binary_blob(blob + data + b"\0" * (-len(data) % 4))
    document.buffers[0].byteLength = len(blob) + len(data) + (-len(data) % 4)
    return len(document.bufferViews) - 1


def glb_bytes(document: gl.GLTF2) -> bytes:
    """A document with one buffer in the binary form of glTF 2.0."""
    return b"".join(glb_parts(document))


def glb_parts(document: gl.GLTF2) -> list[bytes]:
    """The bytes of `glb_bytes` in parts, so that a large buffer is written without a copy of it.

    pygltflib's own `save_to_bytes` gives the same bytes; it copies each entry of the document
    several times, which takes longer than the rest of the file where there are many morphs.
    """
    text = json.dumps(_entries(document), separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    blob = document.binary_blob() or b""
    fill = b"\0" * (-len(blob) % 4)
    text_size, blob_size = len(text), len(blob) + len(fill)
    head = struct.pack("<4sII", b"glTF", 2, 28 + text_size + blob_size)
    return [
        head + struct.pack("<I4s", text_size, b"JSON") + text,
        struct.pack("<I4s", blob_size, b"BIN\0"),
        blob,
        fill,
    ]


def _entries(value: Any) -> Any:
    """The JSON form of a part of a document. None and empty values are left out, except inside
    extensions.
    """
    if isinstance(value, list | tuple):
        return [_entries(item) for item in value]
    if is_dataclass(value) or isinstance(value, gl.Attributes):
        names = getattr(value, "__dataclass_fields__", vars(value))
        return {
            name: getattr(value, name) if name == "extensions" else _entries(getattr(value, name))
            for name in names
            if not _is_empty(getattr(value, name))
        }
    if isinstance(value, dict):
        return {name: _entries(item) for name, item in value.items() if not _is_empty(item)}
    return value


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, Sized) and not len(value))


def obj_lines(vertices: np.ndarray) -> str:
    """Vertices (V, 3) as lines of an OBJ file."""
    return ("v %.6f %.6f %.6f\n" * len(vertices)) % tuple(vertices.ravel())


def face_lines(faces: np.ndarray, mesh: BodyMesh | None = None) -> str:
    """Triangles (F, 3) as lines of an OBJ file; with ``mesh`` its texture coordinates and quads in
    their place.
    """
    if mesh is None:
        return ("f %d %d %d\n" * len(faces)) % tuple((faces + 1).ravel())
    corners = np.stack([mesh.quads, mesh.quad_uv], -1) + 1
    places = ("vt %.6f %.6f\n" * len(mesh.uv)) % tuple(mesh.uv.ravel())
    return places + ("f %d/%d %d/%d %d/%d %d/%d\n" * len(corners)) % tuple(corners.ravel())


@dataclass(frozen=True)
class Seams:
    """The mesh as it is written: N vertices, each a copy of the body's vertex ``source``; ``uv``
    from below left.
    """

    source: Int[np.ndarray, " N"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "N 2"] | None = None


def texture_seams(faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None) -> Seams | None:
    """The seams of faces that are a body's quads cut in two; None where they are not, or nothing is
    known of quads.
    """
    uv_faces = None if mesh is None else mesh.triangle_uv(faces)
    return None if mesh is None or uv_faces is None else doubled_vertices(faces, mesh.uv, uv_faces)


def doubled_vertices(
    faces: Int[np.ndarray, "F 3"], uv: Float[np.ndarray, "U 2"], uv_faces: Int[np.ndarray, "F 3"]
) -> Seams:
    """Each pair of a vertex and a texture coordinate that some face uses, as one vertex."""
    corners = np.stack([faces.ravel(), uv_faces.ravel()], axis=1)
    pairs, place = np.unique(corners, axis=0, return_inverse=True)
    return Seams(pairs[:, 0], place.reshape(faces.shape), uv[pairs[:, 1]])


def mesh_document(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], mesh: BodyMesh | None = None
) -> gl.GLTF2:
    """A still mesh, metres, +y up; with texture coordinates where ``mesh`` has them for its
    faces.
    """
    document = gl.GLTF2(
        asset=gl.Asset(version="2.0", generator=f"habitus {__version__}"),
        scene=0,
        scenes=[gl.Scene(nodes=[0])],
        nodes=[gl.Node(name="body", mesh=0)],
        materials=[gltf_material()],
    )
    buffer = GltfBuffer(document)
    document.meshes.append(
        gl.Mesh(
            name="body",
            primitives=[gltf_primitive(vertices, faces, buffer, texture_seams(faces, mesh))],
        )
    )
    return buffer.closed()


def gltf_material() -> gl.Material:
    """Plain skin, for meshes without colours of their own."""
    surface = gl.PbrMetallicRoughness(
        baseColorFactor=list(SKIN_COLOUR), metallicFactor=0.0, roughnessFactor=0.7
    )
    return gl.Material(
        name="skin", pbrMetallicRoughness=surface, alphaMode="OPAQUE", doubleSided=False
    )


class GltfBuffer:
    """Collects arrays into one binary chunk and makes their accessors."""

    def __init__(self, document: gl.GLTF2):
        self.document = document
        self.chunks = []
        self.size = 0

    def add(
        self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False
    ) -> int:
        """Add an array of glTF type ``kind``; its accessor's number."""
        data = np.ascontiguousarray(array)
        columns = data.reshape(len(data), -1)
        rows = np.ascontiguousarray(columns.T) if bounds else columns  # numpy reduces rows faster
        self.document.accessors.append(
            gl.Accessor(
                bufferView=self._view(data, target),
                componentType=_COMPONENTS[data.dtype.str[1:]],
                count=columns.size if kind == gl.SCALAR else len(columns),
                type=kind,
                min=rows.min(axis=1).tolist() if bounds else None,
                max=rows.max(axis=1).tolist() if bounds else None,
            )
        )
        return len(self.document.accessors) - 1

    def add_morph(self, offsets: Float[np.ndarray, "V 3"], source: Int[np.ndarray, " N"]) -> int:
        """Offsets (m) of the vertices ``source``: those that move alone, where most do not."""
        x, y, z = offsets.T != 0
        moved = np.flatnonzero((x | y | z)[source])
        if len(moved) > 0.8 * len(source):
            return self.add(offsets[source], gl.VEC3, gl.ARRAY_BUFFER, bounds=True)
        moved = moved if len(moved) else np.zeros(1, np.int64)
        index = moved.astype("u2" if len(source) < 65535 else "u4")
        values = offsets[source[moved]]
        self.document.accessors.append(
            gl.Accessor(
                byteOffset=None,  # it has no view that one could count from
                componentType=gl.FLOAT,
                count=len(source),
                type=gl.VEC3,
                min=[float(each.min(initial=0.0)) for each in values.T],
                max=[float(each.max(initial=0.0)) for each in values.T],
                sparse=gl.Sparse(
                    count=len(index),
                    indices=gl.AccessorSparseIndices(
                        bufferView=self._view(index), componentType=_COMPONENTS[index.dtype.str[1:]]
                    ),
                    values=gl.AccessorSparseValues(bufferView=self._view(values)),
                ),
            )
        )
        return len(self.document.accessors) - 1

    def _view(self, data: np.ndarray, target: int | None = None) -> int:
        self.document.bufferViews.append(
            gl.BufferView(buffer=0, byteOffset=self.size, byteLength=data.nbytes, target=target)
        )
        padding = -data.nbytes % 4
        self.chunks.append(data.tobytes() + b"\0" * padding)
        self.size += data.nbytes + padding
        return len(self.document.bufferViews) - 1

    def closed(self) -> gl.GLTF2:
        """The document with all that was added."""
        self.document.buffers.append(gl.Buffer(byteLength=self.size))
        self.document.set_binary_blob(b"".join(self.chunks))
        return self.document


def gltf_primitive(
    vertices: np.ndarray, faces: np.ndarray, buffer: GltfBuffer, seams: Seams | None = None
) -> gl.Primitive:
    """Vertices, normals, texture coordinates and faces of a mesh, added to the buffer."""
    seams = Seams(np.arange(len(vertices)), faces) if seams is None else seams
    array = gl.ARRAY_BUFFER
    width = "u2" if len(seams.source) < 65535 else "u4"
    attributes = gl.Attributes(
        POSITION=buffer.add(vertices[seams.source].astype("f4"), gl.VEC3, array, bounds=True),
        NORMAL=buffer.add(_normals(vertices, faces)[seams.source], gl.VEC3, array),
    )
    if seams.uv is not None:  # glTF counts from the top left
        attributes.TEXCOORD_0 = buffer.add(
            (seams.uv * [1, -1] + [0, 1]).astype("f4"), gl.VEC2, array
        )
    indices = buffer.add(seams.faces.astype(width).reshape(-1), gl.SCALAR, gl.ELEMENT_ARRAY_BUFFER)
    return gl.Primitive(attributes=attributes, indices=indices, material=0, mode=gl.TRIANGLES)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals; up where a vertex has none."""
    normals = vertex_normals(vertices, faces)
    return unit_float32(np.where(normals.any(-1, keepdims=True), normals, (0.0, 1.0, 0.0)))


def unit_float32(vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n d"]:
    """Unit vectors as float32, rounded before they are scaled."""
    rounded = vectors.astype("f4")
    return rounded / np.linalg.norm(rounded, axis=-1, keepdims=True)


_Content = Callable[[np.ndarray, np.ndarray, BodyMesh | None], bytes]
_CONTENT: Mapping[str, _Content] = {
    ".ply": _ply,
    ".obj": _obj,
    ".glb": _glb,
}
