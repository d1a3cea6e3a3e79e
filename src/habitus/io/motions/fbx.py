"""The scene of an FBX file (binary 7.x or text): models, transformations, connections.

Formulas of transformations: Autodesk's FBX SDK, "Computing transformation matrices" and the
comments of ``fbxnode.h`` (RotationActive, InheritType).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError, shown
from habitus.io.archives import reason
from habitus.io.limits import MAX_NAME_LENGTH, check_joints, read_file
from habitus.io.motions.fbx_nodes import FbxDocument, FbxNode, FbxValue, read_document

ORDERS = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")
"""Rotation orders by their number: fixed axes of the parent, first rotation first."""
TICKS, NEW_TICKS = 46_186_158_000, 141_120_000
_LIMBS = ("LimbNode", "Limb", "Root")

Properties = Mapping[str, list[FbxValue]]


@dataclass(frozen=True, eq=False)
class Model:
    """A node of the scene and the parameters of its transformation, in the file's unit and degrees.

    ``order`` is scipy's, of fixed axes; ``before`` and ``after`` are PreRotation and PostRotation.
    """

    number: int
    name: str
    parts: Float[np.ndarray, "3 3"]
    """Translation, rotation (Euler angles), scaling, where no curve animates them."""
    order: str
    before: Float[np.ndarray, "3 3"]
    after: Float[np.ndarray, "3 3"]
    rotation_offset: Float[np.ndarray, " 3"]
    rotation_pivot: Float[np.ndarray, " 3"]
    scaling_offset: Float[np.ndarray, " 3"]
    scaling_pivot: Float[np.ndarray, " 3"]
    inherit: int

    def turn(self, degrees: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
        """Rotations in the parent's axes for Euler angles (degrees)."""
        flat = np.asarray(degrees).reshape(-1, 3)
        columns = flat[:, ["xyz".index(axis) for axis in self.order]]
        turn = Rotation.from_euler(self.order, columns, degrees=True).as_matrix()
        return self.before @ turn.reshape(*np.shape(degrees)[:-1], 3, 3) @ self.after.T

    def pivot(
        self, turn: Float[np.ndarray, "*batch 3 3"], scaling: Float[np.ndarray, "*batch 3"]
    ) -> Float[np.ndarray, "*batch 3"]:
        """Translation by pivots and offsets, in the parent's axes."""
        inner = self.scaling_offset + self.scaling_pivot * (1.0 - scaling) - self.rotation_pivot
        return self.rotation_offset + self.rotation_pivot + (turn @ inner[..., None])[..., 0]

    def local(
        self, parts: Float[np.ndarray, "*batch 3 3"]
    ) -> tuple[Float[np.ndarray, "*batch 3 3"], Float[np.ndarray, "*batch 3"]]:
        """Rotation and origin in the parent's axes for translation, rotation and scaling."""
        turn = self.turn(parts[..., 1, :])
        return turn, parts[..., 0, :] + self.pivot(turn, parts[..., 2, :])


@dataclass(frozen=True, eq=False)
class FbxScene:
    """The scene of a file: objects by number, connections, and the models of joints and of their
    ancestors, parents first.
    """

    path: Path
    document: FbxDocument
    settings: Properties
    objects: dict[int, FbxNode]
    links: tuple[tuple[int, int, str], ...]
    """(child, parent, property or "")."""
    models: tuple[Model, ...]
    parents: tuple[int, ...]
    """Index of each model's parent among ``models``; -1 for none."""
    joints: frozenset[int]
    """Numbers of models that are joints."""

    @cached_property
    def below(self) -> dict[int, list[tuple[int, str]]]:
        """Children of each object: (number, property)."""
        found: dict[int, list[tuple[int, str]]] = {}
        for child, parent, name in self.links:
            found.setdefault(parent, []).append((child, name))
        return found

    @property
    def scale(self) -> float:
        """Metres per unit of the file. Raises HabitusError where that is not positive."""
        unit = real_number(self.settings, "UnitScaleFactor", 1.0)
        if unit < 0.0:
            raise HabitusError(f"UnitScaleFactor {unit:g}; expected a positive number")
        return 0.01 * unit

    @property
    def second(self) -> int:
        """Ticks per second of the file's clock."""
        return _ticks(self.document)

    def world(
        self, parts: Float[np.ndarray, "*batch N 3 3"]
    ) -> tuple[Float[np.ndarray, "*batch N 3 3"], Float[np.ndarray, "*batch N 3"]]:
        """Linear parts and origins of the models in the world (the file's unit), for translations,
        rotations (degrees) and scalings.
        """
        shape = parts.shape[:-2]
        linear, places = np.empty((*shape, 3, 3)), np.empty((*shape, 3))
        turned = np.empty_like(linear)
        for k, (model, parent) in enumerate(zip(self.models, self.parents, strict=True)):
            turn, place = model.local(parts[..., k, :, :])
            scaling = parts[..., k, 2, None, :]
            if parent < 0:
                turned[..., k, :, :], places[..., k, :] = turn, place
                linear[..., k, :, :] = turn * scaling
                continue
            above, way = linear[..., parent, :, :], turned[..., parent, :, :]
            places[..., k, :] = places[..., parent, :] + (above @ place[..., None])[..., 0]
            turned[..., k, :, :] = way @ turn
            if model.inherit == 1:
                linear[..., k, :, :] = above @ (turn * scaling)
                continue
            stretch = np.swapaxes(way, -1, -2) @ above
            if model.inherit == 2:
                stretch = stretch / parts[..., parent, 2, None, :]
            linear[..., k, :, :] = way @ turn @ stretch * scaling
        return linear, places

    def at_rest(self) -> Float[np.ndarray, "N 3 3"]:
        """Translations, rotations and scalings of the models where no curve animates them."""
        return np.array([model.parts for model in self.models]).reshape(-1, 3, 3)


def read_fbx(path: Path) -> FbxScene:
    """The scene of an FBX file. Raises HabitusError with the file named."""
    try:
        return _scene(path, read_document(read_file(path)))
    except OSError as error:
        raise HabitusError(f"{path}: {shown(error.strerror or error)}; expected FBX") from error
    except HabitusError as error:
        raise HabitusError(f"{path}: {error}") from error
    except Exception as error:  # a damaged file may raise anything
        raise HabitusError(f"{path}: cannot be read ({reason(error)}); expected FBX") from error


def _scene(path: Path, document: FbxDocument) -> FbxScene:
    objects = {
        object_number(node.value()): node
        for node in document.first("Objects").nodes
        if node.encoded
    }
    links = []
    for node in document.first("Connections").nodes:
        words = node.values
        if node.name == "C" and len(words) >= 3 and words[0] in ("OO", "OP"):
            name = str(words[3]) if words[0] == "OP" and len(words) > 3 else ""
            links.append((object_number(words[1]), object_number(words[2]), name))
    settings = properties(document.first("GlobalSettings"))
    default = _templates(document).get("Model", {})
    models = {n: node for n, node in objects.items() if node.name == "Model"}
    parent = {}
    for child, above, name in links:
        if not name and child in models and (above in models or above == 0):
            parent.setdefault(child, above)
    skinned = clustered(objects, links)
    joints = {n for n, node in models.items() if form_of(node) in _LIMBS}
    joints |= skinned & set(models)
    if not joints:
        joints = {n for n, node in models.items() if form_of(node) == "Null"}
    kept = _ordered(joints, parent)
    check_joints(len(kept))
    made = tuple(_model(n, models[n], default) for n in kept)
    at = {n: k for k, n in enumerate(kept)}
    parents = tuple(at.get(parent.get(n, 0), -1) for n in kept)
    return FbxScene(
        path, document, settings, objects, tuple(links), made, parents, frozenset(joints)
    )


def form_of(node: FbxNode) -> str:
    """An object's form: "LimbNode", "Mesh", "Cluster", …"""
    return str(node.value(2))


def _ordered(joints: set[int], parent: Mapping[int, int]) -> list[int]:
    """Joints and their ancestors, depth first."""
    kept: set[int] = set()
    for joint in joints:
        way: set[int] = set()
        at = joint
        while at and at not in kept:
            if at in way:
                raise HabitusError("nodes are each other's parents; export the file again")
            way.add(at)
            at = parent.get(at, 0)
        kept.update(way)
    children: dict[int, list[int]] = {}
    for child, above in parent.items():
        if child in kept:
            children.setdefault(above if above in kept else 0, []).append(child)
    loose = [n for n in kept if n not in parent]
    order: list[int] = []
    waiting = [*children.get(0, []), *loose][::-1]
    while waiting:
        node = waiting.pop()
        order.append(node)
        waiting.extend(reversed(children.get(node, [])))
    return order


def clustered(objects: Mapping[int, FbxNode], links: list[tuple[int, int, str]]) -> set[int]:
    """Models that influence a skin: those connected to its clusters."""
    clusters = {n for n, node in objects.items() if node.name == "Deformer"}
    return {child for child, above, name in links if above in clusters and not name} - clusters


def object_number(value: FbxValue | None) -> int:
    """The value, which must be an object's number. Raises HabitusError."""
    if type(value) is not int:
        raise HabitusError(f"object number {shown(value, 40)}; expected a whole number")
    return value


def properties(node: FbxNode | None) -> Properties:
    """The values of a node's properties by their names."""
    listed = node.first("Properties70") if node is not None else None
    found = {}
    for each in listed.all("P") if listed is not None else ():
        words = each.values
        if len(words) > 4:
            found[str(words[0])] = words[4:]
    return found


def _templates(document: FbxDocument) -> dict[str, Properties]:
    """Default properties of each type of object."""
    found = {}
    for node in document.nodes:
        for kind in node.all("ObjectType") if node.name == "Definitions" else ():
            found[str(kind.value())] = properties(kind.first("PropertyTemplate"))
    return found


def real_number(given: Properties, name: str, missing: float) -> float:
    """A property that is a number; ``missing`` where it is absent or 0. Raises HabitusError."""
    value = given.get(name, [missing])[0]
    if not isinstance(value, int | float) or not 1e-9 <= abs(value) < 1e9:
        return missing if value == 0 else _refused(name, value)
    return float(value)


def _refused(name: str, value: object) -> float:
    raise HabitusError(f"{name} is {shown(value, 40)}; expected a number; export the file again")


def whole_number(given: Properties, name: str, missing: int) -> int:
    """A property that is a whole number; ``missing`` where it is absent or none."""
    value = given.get(name, [missing])[0]
    return int(value) if isinstance(value, int | float) and abs(value) < 1e6 else missing


def vector(given: Properties, name: str, missing: float = 0.0) -> Float[np.ndarray, " 3"]:
    """A property that is a vector. Raises HabitusError."""
    values = given.get(name, [missing] * 3)[:3]
    if len(values) != 3 or not all(
        isinstance(value, int | float) and abs(value) < 1e9 for value in values
    ):
        raise HabitusError(f"{name} is {shown(values, 60)}; expected three numbers")
    return np.array(values, dtype=np.float64)


def _model(number: int, node: FbxNode, default: Properties) -> Model:
    given = {**default, **properties(node)}
    active = bool(whole_number(given, "RotationActive", 0))
    order = whole_number(given, "RotationOrder", 0) if active else 0
    parts = [vector(given, f"Lcl {each}") for each in ("Translation", "Rotation")]
    parts.append(vector(given, "Lcl Scaling", 1.0))
    if not np.abs(parts[2]).min() > 1e-9:
        raise HabitusError(f"{shown(name_of(node))}: a scaling of zero; export the file again")

    if not 0 <= order < len(ORDERS):
        raise HabitusError(f"{shown(name_of(node))}: rotation order {order}; expected 0 to 5")

    def turn(name: str) -> np.ndarray:
        angles = vector(given, name) if active else np.zeros(3)
        return Rotation.from_euler("xyz", angles, degrees=True).as_matrix()

    return Model(
        number=number,
        name=name_of(node),
        parts=np.array(parts),
        order=ORDERS[order],
        before=turn("PreRotation"),
        after=turn("PostRotation"),
        rotation_offset=vector(given, "RotationOffset"),
        rotation_pivot=vector(given, "RotationPivot"),
        scaling_offset=vector(given, "ScalingOffset"),
        scaling_pivot=vector(given, "ScalingPivot"),
        inherit=whole_number(given, "InheritType", 0),
    )


def geometric(node: FbxNode, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points of a model's mesh in the model's own axes: its geometric transformation, which moves
    the mesh alone (3ds Max writes one for an object offset).
    """
    given = properties(node)
    angles = vector(given, "GeometricRotation")
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    scaled = points * vector(given, "GeometricScaling", 1.0)
    return scaled @ turn.T + vector(given, "GeometricTranslation")


def name_of(node: FbxNode) -> str:
    """An object's name."""
    return str(node.value(1) or "").partition("\0")[0][:MAX_NAME_LENGTH]


def _ticks(document: FbxDocument) -> int:
    """The file's clock: TCDefinition of files from FBX SDK 2020 on may choose a coarser one."""
    head = document.first("FBXHeaderExtension")
    flags, version = head.first("OtherFlags"), head.first("FBXHeaderVersion")
    chosen = flags.first("TCDefinition") if flags is not None else None
    newer = version is not None and isinstance(v := version.value(), int) and v >= 1004
    if newer and chosen is not None:
        return TICKS if chosen.value() == 127 else NEW_TICKS
    return TICKS if document.version < 8000 else NEW_TICKS
