"""A rigged FBX character with an added animation; every object of the file is kept unchanged."""

from collections.abc import Iterator, Mapping

import numpy as np
from jaxtyping import Float

from habitus.errors import HabitusError
from habitus.export.euler import continuous_angles
from habitus.export.fbx.motion import Curves
from habitus.export.fbx.nodes import Node, document, kept
from habitus.export.fbx.scene import TICKS, Objects, ticks
from habitus.files import atomic_write
from habitus.fit.retarget.characters import CharacterMotion, Skin, node_tracks
from habitus.io.motions.fbx import FbxScene, form_of, geometric, name_of
from habitus.io.motions.fbx_motion import matrix_of, rest_of
from habitus.io.motions.fbx_nodes import FbxNode
from habitus.io.motions.sampling import turns_of
from habitus.rotations import quaternion_from_matrix
from habitus.types import PathLike

OUT = ".fbx"
MAX_INFLUENCES = 8
MAX_ERROR = 0.01
"""Largest distance (m) of joints in the written file from their solved places."""


# -- the skin --------------------------------------------------------------------------------------


def skin_of_scene(scene: FbxScene) -> Skin:
    """All skinned vertices of a scene at rest, in metres and the file's world axes; joints are
    indices of ``scene.models``. Raises HabitusError where there are none.
    """
    parts = [part for part in _skinned(scene) if len(part[0])]
    if not parts:
        raise HabitusError(f"{scene.path}: no skinned mesh; expected a rigged character")
    vertices, index, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Skin(scene.scale * vertices, index, weights)


def _skinned(scene: FbxScene) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Vertices at rest (in the file's unit), joints and weights of each mesh."""
    linear, places, _ = rest_of(scene)
    at = {model.number: k for k, model in enumerate(scene.models)}
    meshes = {child: above for child, above, _ in scene.links if _is_model(scene, above)}
    for number, node in scene.objects.items():
        given = node.first("Vertices") if node.name == "Geometry" else None
        if given is None:
            continue
        points = _points(given)
        if number in meshes:
            points = geometric(scene.objects[meshes[number]], points)
        moved, total = np.zeros_like(points), np.zeros(len(points))
        influences = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
        for joint, indices, values, matrix in _clusters(scene, number, at):
            if len(indices) and not 0 <= indices.min() <= indices.max() < len(points):
                raise HabitusError(
                    "a cluster has vertices beyond its mesh's; export the file again"
                )
            there = points[indices] @ matrix[:3, :3].T + matrix[:3, 3]
            there = there @ linear[joint].T + places[joint]
            np.add.at(moved, indices, values[:, None] * there)
            np.add.at(total, indices, values)
            influences.append((indices, np.full(len(indices), joint), values))
        used = np.flatnonzero(total > 1e-6)
        index, value = _strongest(influences, len(points))
        yield moved[used] / total[used, None], index[used], value[used]


def _is_model(scene: FbxScene, number: int) -> bool:
    return number in scene.objects and scene.objects[number].name == "Model"


def _points(node: FbxNode) -> Float[np.ndarray, "V 3"]:
    """The vertices of a mesh. Raises HabitusError."""
    numbers = node.array().astype(np.float64)
    if len(numbers) % 3 or not (np.abs(numbers) < 1e9).all():
        raise HabitusError("vertices that are not three finite numbers each; export the file again")
    return numbers.reshape(-1, 3)


def _strongest(
    influences: list[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Joints and weights (V, K) of each vertex, the strongest first."""
    vertex, joint, weight = (np.concatenate(each) for each in zip(*influences, strict=True))
    order = np.lexsort((-weight, vertex))
    vertex, joint, weight = vertex[order], joint[order], weight[order]
    rank = np.arange(len(vertex)) - np.searchsorted(vertex, vertex)
    first = rank < MAX_INFLUENCES
    index = np.zeros((count, MAX_INFLUENCES), np.int64)
    value = np.zeros((count, MAX_INFLUENCES))
    index[vertex[first], rank[first]] = joint[first]
    value[vertex[first], rank[first]] = weight[first]
    return index, value


def _clusters(
    scene: FbxScene, geometry: int, at: Mapping[int, int]
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
    """Joint, vertices, weights and the mesh's place in the joint, for each cluster of a mesh."""
    for skin, _ in scene.below.get(geometry, []):
        node = scene.objects.get(skin)
        if node is None or node.name != "Deformer" or form_of(node) != "Skin":
            continue
        for cluster, _ in scene.below.get(skin, []):
            part = scene.objects.get(cluster)
            joints = [at[child] for child, _ in scene.below.get(cluster, []) if child in at]
            inside = {each.name: each for each in part.nodes} if part is not None else {}
            if not joints or not {"Indexes", "Weights", "Transform"} <= set(inside):
                continue
            indices = inside["Indexes"].array().astype(np.int64)
            weights = inside["Weights"].array().astype(np.float64)
            if len(indices) != len(weights) or not (np.abs(weights) < 1e6).all():
                raise HabitusError("a cluster has invalid weights; export the file again")
            yield joints[0], indices, np.maximum(weights, 0.0), matrix_of(inside["Transform"])


# -- the motion ------------------------------------------------------------------------------------


def write_character_fbx(
    scene: FbxScene, moved: CharacterMotion, path: PathLike, name: str = "habitus"
) -> None:
    """Write a character's file with an added, active animation, atomically.

    Matched joints rotate, the pelvis also moves, other joints keep their rest pose. Raises
    HabitusError for text files, and where scaled bones put a joint more than `MAX_ERROR` off its
    solved place.
    """
    if scene.document.text:
        raise HabitusError(f"{scene.path}: text FBX cannot be written; save it as binary FBX")
    parts = _parts(scene, moved)
    frames, rate = len(parts), moved.motion.rate_hz
    name = _unused(scene, name)
    last = max([1_000_000, *scene.objects])
    if last > 1 << 62:
        raise HabitusError(
            f"object number {last}; expected at most {1 << 62}; export the file again"
        )
    objects = Objects(last + 1)
    curves = Curves(objects, name, frames, rate * TICKS / scene.second)
    for k, model in enumerate(scene.models):
        number = np.int64(model.number)
        for which, (title, short) in enumerate((("Lcl Translation", "T"), ("Lcl Rotation", "R"))):
            curves.add(number, title, short, "XYZ", parts[:, k, which], model.parts[which])
    end = ticks(np.array([frames - 1]), rate * TICKS / scene.second)[0]
    nodes = [_extended(kept(node), objects, name, end) for node in scene.document.nodes]
    with atomic_write(path) as temporary:
        temporary.write_bytes(document(nodes, scene.document.version, scene.document.footer[:16]))


def _parts(scene: FbxScene, moved: CharacterMotion) -> Float[np.ndarray, "T N 3 3"]:
    """Translations, rotations and scalings of the models in the new animation."""
    local, places = node_tracks(moved)
    linear, _, _ = rest_of(scene)
    turns = turns_of(linear)
    parts = np.tile(scene.at_rest(), (len(places), 1, 1, 1))
    track = {joint: local[:, k] for k, joint in enumerate(moved.character.joints)}
    for k, (model, parent) in enumerate(zip(scene.models, scene.parents, strict=True)):
        if model.number not in scene.joints:
            continue
        turn = track.get(k)
        if turn is None:
            still = turns[k] if parent < 0 else turns[parent].T @ turns[k]
            turn = np.tile(still, (len(places), 1, 1))
        parts[:, k, 0] += model.pivot(model.turn(model.parts[1]), model.parts[2])
        parts[:, k, 0] -= model.pivot(turn, model.parts[2])
        own = model.before.T @ turn @ model.after
        quaternions = np.roll(quaternion_from_matrix(own), -1, axis=-1)
        axes = ["xyz".index(axis) for axis in model.order]
        parts[:, k, 1][:, axes] = continuous_angles(quaternions[:, None], model.order)[:, 0]
    root = moved.character.joints[0]
    model, parent = scene.models[root], scene.parents[root]
    at = places / scene.scale
    if parent >= 0:
        above, origin = (each[:, parent] for each in scene.world(parts))
        at = np.linalg.solve(above, (at - origin)[..., None])[..., 0]
    parts[:, root, 0] = at - model.pivot(model.turn(parts[:, root, 1]), parts[:, root, 2])
    _check(scene, moved, parts)
    return parts


def _check(scene: FbxScene, moved: CharacterMotion, parts: np.ndarray) -> None:
    """Raise HabitusError where joints of the file are off their solved places."""
    chosen = list(moved.character.joints)
    setting = moved.character.setting
    there = scene.scale * scene.world(parts)[1][:, chosen]
    solved = moved.motion.joints() @ setting.upright / setting.scale
    off = setting.scale * np.linalg.norm(there - solved, axis=-1).max(axis=0)
    if off.max() > MAX_ERROR:
        worst = scene.models[chosen[int(off.argmax())]].name
        raise HabitusError(
            f"{worst} would be {1e3 * off.max():.0f} mm off its solved place: bones are scaled or "
            "moved relative to their bind pose; apply scale and pose, export the file again"
        )


def _unused(scene: FbxScene, name: str) -> str:
    stacks = {name_of(n) for n in scene.objects.values() if n.name == "AnimationStack"}
    title, count = name, 2
    while title in stacks:
        title, count = f"{name} {count}", count + 1
    return title


# -- the file --------------------------------------------------------------------------------------


def _extended(node: Node, objects: Objects, name: str, end: np.int64) -> Node:
    """A top node, extended by the new animation."""
    if node.name == "Objects":
        return Node(node.name, node.values, [*node.nodes, *objects.nodes])
    if node.name == "Connections":
        return Node(node.name, node.values, [*node.nodes, *objects.links])
    if node.name == "Takes":
        spans = [Node(each, (np.int64(0), end)) for each in ("LocalTime", "ReferenceTime")]
        take = Node("Take", (name,), [Node("FileName", (f"{name}.tak",)), *spans])
        rest = [each for each in node.nodes if each.name != "Current"]
        return Node(node.name, node.values, [Node("Current", (name,)), *rest, take])
    if node.name == "Definitions":
        return _counted(node, objects)
    if node.name == "Documents":
        return _active(node, name)
    return node


def _counted(node: Node, objects: Objects) -> Node:
    """The numbers of objects by type, with the new ones counted."""
    left = dict(objects.kinds)
    total = sum(left.values())
    nodes = []
    for each in node.nodes:
        kind = _read(each).value() if each.name == "ObjectType" else None
        if each.name == "Count":
            each = _more(each, total)
        elif isinstance(kind, str) and kind in left:
            extra = left.pop(kind)
            inside = [_more(n, extra) if n.name == "Count" else n for n in each.nodes]
            each = Node(each.name, each.values, inside, each.scope)
        nodes.append(each)
    nodes += [
        Node("ObjectType", (kind,), [Node("Count", (extra,))]) for kind, extra in left.items()
    ]
    return Node(node.name, node.values, nodes, node.scope)


def _read(node: Node) -> FbxNode:
    return FbxNode(node.name, tuple(bytes(value) for value in node.values))  # type: ignore[arg-type]


def _more(node: Node, extra: int) -> Node:
    count = _read(node).value()
    if type(count) is int and 0 <= count < 1 << 30:
        return Node(node.name, (count + extra,))
    return node


def _active(node: Node, name: str) -> Node:
    """The documents, with the new animation as the active one."""
    if node.name == "P":
        title = _read(node).value() if node.values else None
        if title == "ActiveAnimStackName":
            return Node("P", (*node.values[:4], name))
        return node
    inside = [_active(each, name) for each in node.nodes]
    return Node(node.name, node.values, inside, node.scope)
