"""glTF 2.0: skeletons of skinned meshes and their animations, .glb, .gltf and .vrm.

Formulas: the glTF 2.0 specification, 3.5 (scenes, nodes), 3.6.2 (accessors), 3.7.3 (skins), 3.11
and Appendix C (animations and their interpolation).
"""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float

from habitus.body.rig import Rig, RigMotion
from habitus.errors import HabitusError, shown
from habitus.fit.retarget.rig_names import VRM_PARTS
from habitus.io.archives import reason
from habitus.io.gltf_claims import check_gltf, glb_chunks
from habitus.io.limits import MAX_NAME_LENGTH, Allowance, read_file, read_json
from habitus.io.motions.sampling import even_times, reading_animation, turns_of
from habitus.io.names import inside
from habitus.rotations import matrix_from_quaternion

ENDINGS = (".glb", ".gltf", ".vrm")
_TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


@dataclass(frozen=True, eq=False)
class GltfFile:
    """A glTF file: its JSON as it is, the bytes of its buffers, and nodes with parents first."""

    path: Path
    document: dict[str, Any]
    buffers: tuple[bytes, ...]
    order: tuple[int, ...]
    parents: tuple[int, ...]
    """Of each node, by its number in the file; -1 for roots."""

    def array(self, accessor: object) -> Float[np.ndarray, "n w"]:
        """The numbers of an accessor as (count, width). Raises HabitusError."""
        given = _one(self.document.get("accessors", []), accessor, "accessor")
        width = _WIDTHS.get(str(given.get("type")), 0)
        kind = _TYPES.get(given.get("componentType", 0))
        if not width or kind is None or "sparse" in given or "bufferView" not in given:
            raise HabitusError(f"accessor {shown(accessor)} is sparse or of another type")
        view = _one(self.document.get("bufferViews", []), given["bufferView"], "bufferView")
        buffer = _one(self.buffers, view.get("buffer"), "buffer")
        item = np.dtype("<" + kind)
        count = given.get("count", 0)
        start = view.get("byteOffset", 0) + given.get("byteOffset", 0)
        stride = view.get("byteStride", width * item.itemsize)
        last = start + (count - 1) * stride + width * item.itemsize
        if count < 1 or start < 0 or stride < width * item.itemsize or last > len(buffer):
            raise HabitusError(f"accessor {shown(accessor)} goes beyond its buffer")
        raw = np.ndarray(
            (count, width), item, buffer=buffer, offset=start, strides=(stride, item.itemsize)
        )
        out = raw.astype(np.float64)
        if not np.isfinite(out).all():
            raise HabitusError(f"accessor {shown(accessor)} holds numbers that are not finite")
        if given.get("normalized") and kind != "f4":
            out = np.maximum(out / np.iinfo(item).max, -1.0)
        return out

    def nodes(self) -> list[dict[str, Any]]:
        """The nodes of the file."""
        return self.document["nodes"]

    def skin_joints(self) -> set[int]:
        """Numbers of all nodes that are joints of skins."""
        skins = self.document.get("skins", [])
        return {joint for skin in skins for joint in skin.get("joints", [])}


def read_gltf(path: Path) -> GltfFile:
    """A glTF file with its buffers. Raises HabitusError with the file named."""
    try:
        check_gltf(path)
        content = read_file(path)
        binary = content[:4] == b"glTF"
        text, packed = glb_chunks(content) if binary else (content, b"")
        document = read_json(text.decode("utf-8-sig"))
        buffers = tuple(
            _buffer(one, packed if binary and k == 0 else b"", path.parent)
            for k, one in enumerate(document.get("buffers", []))
        )
        nodes = document.get("nodes", [])
        parents = _parents(nodes)
        return GltfFile(path, document, buffers, _ordered(parents), parents)
    except OSError as error:
        raise HabitusError(
            f"{path}: {shown(error.strerror or error)}; expected a glTF file"
        ) from error
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(f"{path}: cannot be read ({reason(error)}); expected glTF") from error


def _one(items: Any, number: object, what: str) -> Any:
    if type(number) is not int or not 0 <= number < len(items):
        raise HabitusError(f"{what} {shown(number)} of {len(items)}; export the file again")
    return items[number]


def _buffer(given: Mapping[str, Any], packed: bytes, folder: Path) -> bytes:
    uri = given.get("uri")
    if uri is None:
        return packed
    _, mark, data = str(uri).partition("base64,")
    return base64.b64decode(data) if mark else read_file(folder / inside(unquote(str(uri))))


def _parents(nodes: list[dict[str, Any]]) -> tuple[int, ...]:
    parents = [-1] * len(nodes)
    for k, node in enumerate(nodes):
        for child in node.get("children", []):
            _one(nodes, child, "node")
            if parents[child] >= 0:
                raise HabitusError(f"node {child} hangs on two others; export the file again")
            parents[child] = k
    return tuple(parents)


def _ordered(parents: tuple[int, ...]) -> tuple[int, ...]:
    children: dict[int, list[int]] = {}
    for node, parent in enumerate(parents):
        children.setdefault(parent, []).append(node)
    order: list[int] = []
    waiting = children.get(-1, [])[::-1]
    while waiting:
        node = waiting.pop()
        order.append(node)
        waiting.extend(reversed(children.get(node, [])))
    if len(order) != len(parents):
        raise HabitusError("nodes hang on one another in a circle; export the file again")
    return tuple(order)


# -- the skeleton ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Parts:
    """Translations, quaternions (x, y, z, w) and scales of nodes in their parents."""

    translations: Float[np.ndarray, "*batch N 3"]
    quaternions: Float[np.ndarray, "*batch N 4"]
    scales: Float[np.ndarray, "*batch N 3"]

    def matrices(self, node: int) -> Float[np.ndarray, "*batch 3 4"]:
        """Local transformations of a node."""
        turn = matrix_from_quaternion(self.quaternions[..., node, [3, 0, 1, 2]])
        scaled = turn * self.scales[..., node, None, :]
        return np.concatenate([scaled, self.translations[..., node, :, None]], axis=-1)


def rest_parts(file: GltfFile) -> Parts:
    """The transformations that nodes have by themselves. Raises HabitusError."""
    nodes = file.nodes()
    translations, quaternions = np.zeros((len(nodes), 3)), np.zeros((len(nodes), 4))
    scales = np.ones((len(nodes), 3))
    quaternions[:, 3] = 1.0
    for k, node in enumerate(nodes):
        if "matrix" in node:
            matrix = _vector(node["matrix"], 16).reshape(4, 4).T
            translations[k] = matrix[:3, 3]
            scales[k] = np.linalg.norm(matrix[:3, :3], axis=0)
            if np.linalg.det(matrix[:3, :3]) < 0.0:
                scales[k, 0] *= -1.0
            quaternions[k] = _quaternion(matrix[:3, :3] / scales[k])
            continue
        translations[k] = _vector(node.get("translation", [0, 0, 0]), 3)
        quaternions[k] = _vector(node.get("rotation", [0, 0, 0, 1]), 4)
        scales[k] = _vector(node.get("scale", [1, 1, 1]), 3)
    sizes = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if (np.abs(sizes - 1.0) > 0.1).any() or (np.abs(scales) < 1e-9).any():
        raise HabitusError("a node's rotation is none, or its scale is zero; export it again")
    return Parts(translations, quaternions / sizes, scales)


def _quaternion(matrix: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix).as_quat()


def _vector(given: object, count: int) -> np.ndarray:
    values = np.array(given, dtype=np.float64)
    if values.shape != (count,) or not (np.abs(values) < 1e9).all():
        raise HabitusError(f"a node's {shown(given, 60)}; expected {count} numbers")
    return values


def world_of(file: GltfFile, parts: Parts) -> tuple[np.ndarray, np.ndarray]:
    """Linear parts (..., N, 3, 3) and places (..., N, 3) of nodes in the world."""
    shape = parts.translations.shape[:-1]
    linear, places = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
    for node in file.order:
        local = parts.matrices(node)
        parent = file.parents[node]
        if parent < 0:
            linear[..., node, :, :], places[..., node, :] = local[..., :3], local[..., 3]
            continue
        above = linear[..., parent, :, :]
        linear[..., node, :, :] = above @ local[..., :3]
        moved = (above @ local[..., 3][..., None])[..., 0]
        places[..., node, :] = places[..., parent, :] + moved
    return linear, places


def rig_of(file: GltfFile) -> Rig:
    """The skeleton of the nodes at rest, in the order of ``file.order``. Raises HabitusError."""
    linear, places = world_of(file, rest_parts(file))
    order = list(file.order)
    at = {node: k for k, node in enumerate(order)}
    joints = file.skin_joints() or set(order)
    nodes = file.nodes()
    return Rig(
        names=tuple(
            str(nodes[n].get("name", ""))[:MAX_NAME_LENGTH] if n in joints else "" for n in order
        ),
        parents=tuple(at.get(file.parents[n], -1) for n in order),
        places=places[order],
        turns=turns_of(linear[order]),
        ends=(False,) * len(order),
        roles=tuple((part, at[n]) for part, n in _roles(file) if n in at),
    )


def _roles(file: GltfFile) -> list[tuple[str, int]]:
    """Parts of a body that a VRM file names itself, 1.0 or 0.x."""
    extensions = file.document.get("extensions") or {}
    new = (extensions.get("VRMC_vrm") or {}).get("humanoid") or {}
    old = (extensions.get("VRM") or {}).get("humanoid") or {}
    bones = new.get("humanBones", old.get("humanBones", {}))
    if isinstance(bones, Mapping):
        pairs = [(name, each.get("node")) for name, each in bones.items()]
    else:
        pairs = [(each.get("bone"), each.get("node")) for each in bones]
    return [
        (VRM_PARTS[name], node) for name, node in pairs if name in VRM_PARTS and type(node) is int
    ]


# -- animations ------------------------------------------------------------------------------------


def read_gltf_motion(path: Path) -> RigMotion:
    """The skeleton of a glTF file in its first animation, +y up, metres as the format has it.

    Keys are sampled evenly at their own usual distance. Raises HabitusError.
    """
    file = read_gltf(path)
    with reading_animation(path):
        return _motion(file)


def _motion(file: GltfFile) -> RigMotion:
    animations = file.document.get("animations", [])
    if not animations:
        raise HabitusError("no animation; expected a skeleton in motion")
    animation = animations[0]
    samplers = animation["samplers"]
    channels = [
        (each["target"]["node"], each["target"]["path"], samplers[each["sampler"]])
        for each in animation["channels"]
        if each["target"].get("path") in ("translation", "rotation", "scale")
        and "node" in each["target"]
    ]
    if not any(path == "rotation" for _, path, _ in channels):
        raise HabitusError("its animation turns no joints; expected a skeleton in motion")
    keys = [file.array(sampler["input"])[:, 0] for _, _, sampler in channels]
    if any((np.diff(each) <= 0.0).any() for each in keys):
        raise HabitusError("keys that do not follow one another in time; export it again")
    times, rate = even_times(keys)
    rest = rest_parts(file)
    nodes = len(file.nodes())
    Allowance(file.path.stat().st_size).take(len(times) * nodes, 8 * 22, "its animation")
    moved = {
        "translation": np.tile(rest.translations, (len(times), 1, 1)),
        "rotation": np.tile(rest.quaternions, (len(times), 1, 1)),
        "scale": np.tile(rest.scales, (len(times), 1, 1)),
    }
    for (node, path, sampler), at in zip(channels, keys, strict=True):
        _one(file.nodes(), node, "node")
        moved[path][:, node] = _sampled(file, sampler, path, at, times)
    linear, places = world_of(file, Parts(moved["translation"], moved["rotation"], moved["scale"]))
    order = list(file.order)
    notes = ()
    if len(animations) > 1:
        name = animation.get("name", "")
        notes = (f"the first of its {len(animations)} animations is read: {shown(name)!r}",)
    turns = turns_of(linear[:, order])
    return RigMotion(rig_of(file), places[:, order], turns, rate, file.path.stem, "+y", notes)


def _sampled(
    file: GltfFile, sampler: Mapping[str, Any], path: str, keys: np.ndarray, times: np.ndarray
) -> Float[np.ndarray, "T w"]:
    values = file.array(sampler["output"])
    kind = sampler.get("interpolation", "LINEAR")
    width = 4 if path == "rotation" else 3
    if values.shape != (len(keys) * (3 if kind == "CUBICSPLINE" else 1), width):
        raise HabitusError(f"{len(values)} values for {len(keys)} keys; export it again")
    left = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 1)
    right = np.minimum(left + 1, len(keys) - 1)
    span = keys[right] - keys[left]
    share = np.clip((times - keys[left]) / np.where(span > 0, span, 1.0), 0.0, 1.0)[:, None]
    if kind == "CUBICSPLINE":
        out = _spline(values.reshape(len(keys), 3, width), left, right, share, span[:, None])
    elif kind == "STEP":
        out = values[left]
    elif path == "rotation":
        out = _slerp(values[left], values[right], share)
    else:
        out = (1.0 - share) * values[left] + share * values[right]
    if path != "rotation":
        return out
    size = np.linalg.norm(out, axis=1, keepdims=True)
    if (size < 0.1).any():
        raise HabitusError("a rotation that is none; export it again")
    return out / size


def _slerp(one: np.ndarray, other: np.ndarray, share: np.ndarray) -> np.ndarray:
    cosine = (one * other).sum(axis=1, keepdims=True)
    other = np.where(cosine < 0.0, -other, other)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    sine = np.sin(angle)
    close = sine < 1e-6
    safe = np.where(close, 1.0, sine)
    low = np.where(close, 1.0 - share, np.sin((1.0 - share) * angle) / safe)
    high = np.where(close, share, np.sin(share * angle) / safe)
    return low * one + high * other


def _spline(
    values: np.ndarray, left: np.ndarray, right: np.ndarray, t: np.ndarray, span: np.ndarray
) -> np.ndarray:
    """Hermite's cubic of in-tangents, values and out-tangents."""
    start, end = values[left, 1], values[right, 1]
    out, into = span * values[left, 2], span * values[right, 0]
    return (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * out
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * into
    )
