"""Somebody's glTF character with a new animation: all that the file holds stays as it is."""

import json
import mimetypes
import struct
from collections.abc import Iterator, Sequence
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float

from habitus.body.surface_files import unit_float32
from habitus.errors import HabitusError
from habitus.export.animation import continuous_quaternions
from habitus.files import atomic_write
from habitus.fit.retarget.characters import CharacterMotion, Skin, node_tracks
from habitus.io.archives import reason
from habitus.io.limits import read_file
from habitus.io.motions.gltf import GltfFile, rest_parts, world_of
from habitus.io.names import inside
from habitus.rotations import quaternion_from_matrix
from habitus.types import PathLike

OUT = (".glb", ".vrm")


def skin_of(file: GltfFile) -> Skin:
    """All skinned vertices of a file at rest, in its world, joints in the order of its nodes.

    Raises HabitusError where it has none.
    """
    try:
        parts = list(_skinned(file))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise HabitusError(
            f"{file.path}: its skin is damaged ({reason(error)}); export it again"
        ) from error
    if not parts:
        raise HabitusError(f"{file.path}: no skinned mesh; expected a rigged character")
    vertices, index, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
    weighted = weights.sum(axis=1) > 1e-6
    return Skin(vertices[weighted], index[weighted], weights[weighted])


def _skinned(file: GltfFile) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Vertices at rest, joints and weights of each part of the meshes."""
    linear, places = world_of(file, rest_parts(file))
    at = {node: k for k, node in enumerate(file.order)}
    for node in file.nodes():
        if "mesh" not in node or "skin" not in node:
            continue
        skin = file.document["skins"][node["skin"]]
        joints = np.array(skin["joints"])
        bind = np.tile(np.eye(4), (len(joints), 1, 1))
        if "inverseBindMatrices" in skin:
            flat = file.array(skin["inverseBindMatrices"])
            bind = np.swapaxes(flat.reshape(-1, 4, 4), 1, 2)
        turns = linear[joints] @ bind[:, :3, :3]
        moves = (linear[joints] @ bind[:, :3, 3:])[..., 0] + places[joints]
        for primitive in file.document["meshes"][node["mesh"]]["primitives"]:
            named = primitive["attributes"]
            if "JOINTS_0" not in named or "WEIGHTS_0" not in named:
                continue
            points = file.array(named["POSITION"])
            index = file.array(named["JOINTS_0"]).astype(np.int64)
            weights = file.array(named["WEIGHTS_0"])
            there = np.einsum("vkab,vb->vka", turns[index], points) + moves[index]
            moved = (weights[..., None] * there).sum(axis=1)
            numbers = np.array([at[joint] for joint in joints.tolist()])
            yield moved, numbers[index], weights


def write_character(
    file: GltfFile, moved: CharacterMotion, path: PathLike, name: str = "habitus"
) -> int:
    """Write a character's file with one animation more, as .glb, atomically; its number.

    Mesh, skin, materials and what else there is are copied; buffers and pictures beside a .gltf are
    packed into the file. Raises HabitusError where it cannot be written.
    """
    local, places = node_tracks(moved)
    nodes = [file.order[joint] for joint in moved.character.joints]
    document, chunks = _packed(file)
    quaternions = np.roll(quaternion_from_matrix(local), -1, axis=-1)
    quaternions = unit_float32(continuous_quaternions(quaternions))
    times = np.arange(len(places)) / moved.motion.rate_hz
    input_ = _add(document, chunks, times.astype("f4")[:, None], "SCALAR", bounds=True)
    root = _in_parent(file, nodes[0], places).astype("f4")
    tracks = [(nodes[0], "translation", _add(document, chunks, root, "VEC3"))]
    tracks += [
        (node, "rotation", _add(document, chunks, quaternions[:, k], "VEC4"))
        for k, node in enumerate(nodes)
    ]
    animation = {
        "name": name,
        "samplers": [
            {"input": input_, "output": values, "interpolation": "LINEAR"}
            for _, _, values in tracks
        ],
        "channels": [
            {"sampler": k, "target": {"node": node, "path": what}}
            for k, (node, what, _) in enumerate(tracks)
        ],
    }
    document.setdefault("animations", []).append(animation)
    _plain_transforms(document, file, nodes)
    data = b"".join(chunks)
    document["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    with atomic_write(path) as temporary:
        temporary.write_bytes(
            struct.pack("<4sII", b"glTF", 2, size)
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(data), b"BIN\0")
            + data
        )
    return len(document["animations"]) - 1


def _packed(file: GltfFile) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON with all buffers in one, and pictures of other files in it, and its bytes."""
    document = json.loads(json.dumps(file.document))
    chunks: list[bytes] = []
    starts = []
    for buffer in file.buffers:
        starts.append(sum(map(len, chunks)))
        chunks.append(buffer + b"\0" * (-len(buffer) % 4))
    for view in document.get("bufferViews", []):
        start = starts[view["buffer"]]
        if start or view["buffer"]:
            view["byteOffset"] = view.get("byteOffset", 0) + start
            view["buffer"] = 0
    for image in document.get("images", []):
        uri = image.get("uri", "data:")
        if not uri.startswith("data:"):
            content = read_file(file.path.parent / inside(unquote(uri)))
            del image["uri"]
            image["mimeType"] = mimetypes.guess_type(uri)[0] or "image/png"
            image["bufferView"] = _view(document, chunks, content)
    return document, chunks


def _view(document: dict[str, Any], chunks: list[bytes], content: bytes) -> int:
    start = sum(map(len, chunks))
    view = {"buffer": 0, "byteOffset": start, "byteLength": len(content)}
    document.setdefault("bufferViews", []).append(view)
    chunks.append(content + b"\0" * (-len(content) % 4))
    return len(document["bufferViews"]) - 1


def _add(
    document: dict[str, Any],
    chunks: list[bytes],
    values: np.ndarray,
    kind: str,
    bounds: bool = False,
) -> int:
    """An accessor of float32 values (n, w); its number."""
    data = np.ascontiguousarray(values, dtype="<f4")
    accessor = {
        "bufferView": _view(document, chunks, data.tobytes()),
        "componentType": 5126,
        "count": len(data),
        "type": kind,
    }
    if bounds:
        accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
    document.setdefault("accessors", []).append(accessor)
    return len(document["accessors"]) - 1


def _in_parent(
    file: GltfFile, node: int, places: Float[np.ndarray, "T 3"]
) -> Float[np.ndarray, "T 3"]:
    """Places in the world in what a node hangs on, which stands still."""
    parent = file.parents[node]
    if parent < 0:
        return places
    linear, origins = world_of(file, rest_parts(file))
    return np.linalg.solve(linear[parent], (places - origins[parent]).T).T


def _plain_transforms(document: dict[str, Any], file: GltfFile, nodes: Sequence[int]) -> None:
    """Nodes that move must not have matrices (glTF 2.0, 3.5.3): the same as three parts."""
    rest = rest_parts(file)
    for node in nodes:
        if document["nodes"][node].pop("matrix", None) is not None:
            document["nodes"][node] |= {
                "translation": rest.translations[node].tolist(),
                "rotation": rest.quaternions[node].tolist(),
                "scale": rest.scales[node].tolist(),
            }
