"""What a glTF file claims, held against its size before trimesh reads it: nodes, numbers of its
accessors in each place where a mesh stands, and pixels of pictures.
"""

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from habitus.errors import HabitusError, shown
from habitus.io.limits import (
    MAX_IMAGE_BYTES,
    MAX_NODES,
    MAX_TEXT_BYTES,
    Allowance,
    check_count,
    check_present,
    check_text,
    read_file,
    read_json,
)
from habitus.io.names import inside

_LISTS = ("nodes", "meshes", "materials", "images", "textures", "scenes")
_TABLES = ("accessors", "bufferViews", "buffers")
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_DECODED_AT_ONCE = "KHR_materials_pbrSpecularGlossiness"
"""A material of this extension is converted as it is read, its pictures with it."""


def check_gltf(path: Path) -> None:
    """Raise HabitusError where a .glb or .gltf claims more than a file of its size may."""
    stored = path.stat().st_size
    content = read_file(path)
    text, packed = glb_chunks(content) if content[:4] == b"glTF" else (content, b"")
    check_text(len(text), "its JSON")
    try:
        document = read_json(text.decode("utf-8-sig"), MAX_TEXT_BYTES)
    except UnicodeDecodeError as error:
        raise HabitusError(f"its JSON is no UTF-8 ({shown(error, 80)})") from error
    if not isinstance(document, Mapping):
        raise HabitusError(f"{shown(document)}; expected a glTF document")
    for key in (*_LISTS, *_TABLES):
        value = document.get(key, [])
        if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
            raise HabitusError(f"{key} = {shown(value)}; expected a list of tables")
        check_count(len(value), MAX_NODES if key in _LISTS else 4 * MAX_NODES, key)
    _check_numbers(document, Allowance(stored))
    _check_pictures(document, packed, path.parent, Allowance(stored, MAX_IMAGE_BYTES))


def glb_chunks(content: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a .glb."""
    size = int.from_bytes(content[12:16], "little")
    check_present(20 + size, len(content), "its JSON")
    return content[20 : 20 + size], content[28 + size :]


def _check_numbers(document: Mapping[str, Any], allowance: Allowance) -> None:
    """Every accessor is read once, every primitive's once more for itself and for each node that
    shows its mesh.
    """
    sizes = []
    for accessor in document.get("accessors", []):
        count = accessor.get("count")
        if type(count) is not int:
            raise HabitusError(f"an accessor's count is {shown(count)}; expected a whole number")
        sizes.append(count * _COMPONENTS.get(str(accessor.get("type")), 16))
        allowance.take(sizes[-1], 8, "an accessor")
    meshes = []
    primitives = 0
    for mesh in document.get("meshes", []):
        parts = mesh.get("primitives")
        if not isinstance(parts, list) or not all(isinstance(part, Mapping) for part in parts):
            raise HabitusError(f"a mesh's primitives are {shown(parts)}; expected a list of tables")
        primitives += len(parts)
        check_count(primitives, MAX_NODES, "primitives")
        numbers = sum(_numbers_of(part, sizes) for part in parts)
        allowance.take(numbers, 8, "a mesh")
        meshes.append((len(parts), numbers))
    shown_parts = 0
    for node in document.get("nodes", []):
        which = node.get("mesh")
        if which is None:
            continue
        parts, numbers = meshes[_index(which, len(meshes), "a node's mesh")]
        shown_parts += parts
        check_count(shown_parts, MAX_NODES, "places of meshes")
        allowance.take(numbers, 8, "its meshes at all their places")


def _numbers_of(primitive: Mapping[str, Any], sizes: list[int]) -> int:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, Mapping):
        raise HabitusError(f"a primitive's attributes are {shown(attributes)}; expected a table")
    used = [*attributes.values(), *([primitive["indices"]] if "indices" in primitive else [])]
    return sum(sizes[_index(one, len(sizes), "a primitive's accessor")] for one in used)


def _index(value: object, count: int, what: str) -> int:
    if type(value) is not int or not 0 <= value < count:
        raise HabitusError(f"{what} is number {shown(value)} of {count}; export the file again")
    return value


def _check_pictures(
    document: Mapping[str, Any], packed: bytes, folder: Path, allowance: Allowance
) -> None:
    sizes = [_unpacked_size(one, document, packed, folder) for one in document.get("images", [])]
    copies = 1 + sum(
        _DECODED_AT_ONCE in (one.get("extensions") or {}) for one in document.get("materials", [])
    )
    allowance.take_bytes(copies * sum(sizes), "its pictures, unpacked,")


def _unpacked_size(
    image: Mapping[str, Any], document: Mapping[str, Any], packed: bytes, folder: Path
) -> int:
    """Bytes of a picture, unpacked, by its header; 0 where it is missing or none."""
    try:
        from PIL import Image

        with Image.open(_picture_file(image, document, packed, folder)) as picture:
            return 4 * picture.width * picture.height
    except Exception:  # whatever is not there, or no picture, is not decoded either
        return 0


def _picture_file(
    image: Mapping[str, Any], document: Mapping[str, Any], packed: bytes, folder: Path
) -> Path | io.BytesIO:
    uri = image.get("uri")
    if isinstance(uri, str):
        _, mark, data = uri.partition("base64,")
        return io.BytesIO(base64.b64decode(data)) if mark else folder / inside(unquote(uri))
    view = document["bufferViews"][image["bufferView"]]
    buffer = document["buffers"][view["buffer"]].get("uri")
    if isinstance(buffer, str):
        _, mark, data = buffer.partition("base64,")
        packed = base64.b64decode(data) if mark else read_file(folder / inside(unquote(buffer)))
    start = view.get("byteOffset", 0)
    return io.BytesIO(packed[start : start + view["byteLength"]])
