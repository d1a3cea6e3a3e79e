"""Rest pose and motion of the skeleton in an FBX scene."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from habitus.body.rig import Rig, RigMotion
from habitus.errors import HabitusError, shown
from habitus.io.limits import Allowance
from habitus.io.motions.fbx import (
    FbxScene,
    clustered,
    form_of,
    name_of,
    object_number,
    properties,
    read_fbx,
    real_number,
    whole_number,
)
from habitus.io.motions.fbx_curves import Curve, curve_of
from habitus.io.motions.fbx_nodes import FbxDocument, FbxNode
from habitus.io.motions.sampling import even_times, reading_animation, turns_of

ENDINGS = (".fbx",)
_AXES = {"d|X": 0, "d|Y": 1, "d|Z": 2}
_MOVING = {"Lcl Translation": 0, "Lcl Rotation": 1, "Lcl Scaling": 2}
_RATES = {1: 120.0, 2: 100.0, 3: 60.0, 4: 50.0, 5: 48.0, 6: 30.0, 7: 30.0, 10: 25.0, 11: 24.0}
_RATES |= {8: 30 / 1.001, 9: 30 / 1.001, 12: 1000.0, 13: 24 / 1.001, 15: 96.0, 16: 72.0}
_RATES |= {17: 60 / 1.001, 18: 120 / 1.001}
_CUSTOM = 14
SAME = 0.05
"""Relative difference up to which bones of the bind pose and of the nodes have the same length."""
Curves = dict[tuple[int, int, int], Curve]
"""By model, part (0 translation, 1 rotation, 2 scaling) and axis."""


# -- the rest pose ---------------------------------------------------------------------------------


def up_axis_of(scene: FbxScene) -> str:
    """The up axis that the file names. Raises HabitusError for mirrored axes."""
    axes = np.zeros((3, 3))
    given = scene.settings
    for row, (name, missing) in enumerate((("CoordAxis", 0), ("UpAxis", 1), ("FrontAxis", 2))):
        axis, sign = whole_number(given, name, missing), whole_number(given, f"{name}Sign", 1)
        if axis not in (0, 1, 2) or sign not in (-1, 1):
            raise HabitusError(f"{name} {axis} with sign {sign}; export the file again")
        axes[row, axis] = sign
    if np.linalg.det(axes) < 0.5:
        raise HabitusError(
            "left-handed axes; export it again with right-handed ones (y up or z up)"
        )
    k = int(np.abs(axes[1]).argmax())
    return ("+" if axes[1, k] > 0 else "-") + "xyz"[k]


def bind_matrices(scene: FbxScene) -> dict[int, Float[np.ndarray, "4 4"]]:
    """World matrices of joints in the bind pose, by the models' numbers, in the file's unit."""
    found: dict[int, np.ndarray] = {}
    for node in scene.objects.values():
        if node.name == "Pose" and form_of(node) == "BindPose":
            for each in node.all("PoseNode"):
                number, matrix = each.first("Node"), each.first("Matrix")
                if number is not None and matrix is not None:
                    found[object_number(number.value())] = matrix_of(matrix)
    for number, node in scene.objects.items():
        link = node.first("TransformLink") if node.name == "Deformer" else None
        if link is not None:
            matrix = matrix_of(link)
            found |= {child: matrix for child, _ in scene.below.get(number, [])}
    return found


def matrix_of(node: FbxNode) -> Float[np.ndarray, "4 4"]:
    """A regular matrix, stored by columns. Raises HabitusError."""
    values = node.array().astype(np.float64)
    if values.shape != (16,) or not (np.abs(values) < 1e9).all():
        raise HabitusError(f"{shown(node.name)} is no matrix; export the file again")
    matrix = values.reshape(4, 4).T
    if not np.abs(np.linalg.det(matrix[:3, :3])) > 1e-12:
        raise HabitusError(f"{shown(node.name)} has no inverse; export the file again")
    return matrix


def rest_of(
    scene: FbxScene,
) -> tuple[Float[np.ndarray, "N 3 3"], Float[np.ndarray, "N 3"], tuple[str, ...]]:
    """Linear parts and origins of the models at rest, in the file's unit, and notes.

    The rest pose of a skinned joint is its bind pose. Other joints have only their PreRotations, if
    the file has any, else the rotations of their nodes. If bones of the bind pose and of the nodes
    differ in length, the rest pose is that of the nodes.
    """
    joints = np.array([model.number in scene.joints for model in scene.models], bool)
    bound = bind_matrices(scene)
    bound = {m.number: bound[m.number] for m in scene.models if m.number in bound}
    parts = scene.at_rest()
    own_linear, own_places = scene.world(parts)
    oriented = any(np.abs(model.before - np.eye(3)).max() > 1e-6 for model in scene.models)
    if oriented:
        parts[joints, 1] = 0.0
    linear, places = scene.world(parts)
    rest, there = linear.copy(), places.copy()
    ratios = []
    for k, (model, parent) in enumerate(zip(scene.models, scene.parents, strict=True)):
        matrix = bound.get(model.number) if joints[k] else None
        if matrix is not None:
            rest[k], there[k] = matrix[:3, :3], matrix[:3, 3]
            bone = own_places[k] - own_places[parent] if parent >= 0 else np.zeros(3)
            long = np.linalg.norm(bone)
            if long > 0.0 and scene.models[parent].number in bound:
                ratios.append(np.linalg.norm(there[k] - there[parent]) / long)
        elif parent >= 0:
            way = rest[parent] @ np.linalg.inv(linear[parent])
            rest[k], there[k] = way @ linear[k], there[parent] + way @ (places[k] - places[parent])
    if ratios and abs(float(np.median(ratios)) - 1.0) > SAME:
        note = (
            "bones of its bind pose and of its nodes differ in length: the nodes' pose is its rest"
        )
        return own_linear, own_places, (note,)
    if not bound and not oriented:
        note = "no skin and no PreRotations: the nodes' pose is used as its rest pose"
        return rest, there, (note,)
    return rest, there, ()


def rig_of_scene(scene: FbxScene) -> Rig:
    """The skeleton at rest, in metres and the file's own axes. Raises HabitusError."""
    if not scene.models:
        raise HabitusError(f"{scene.path}: no skeleton; expected limb nodes or a skin")
    up_axis_of(scene)  # mirrored axes are refused
    linear, places, _ = rest_of(scene)
    with_child = set(scene.parents)
    skinned = clustered(scene.objects, list(scene.links))
    return Rig(
        names=tuple(m.name if m.number in scene.joints else "" for m in scene.models),
        parents=scene.parents,
        places=scene.scale * places,
        turns=turns_of(linear),
        ends=tuple(
            k not in with_child and m.number not in skinned and m.name.lower().endswith("end")
            for k, m in enumerate(scene.models)
        ),
    )


# -- motion ----------------------------------------------------------------------------------------


def read_fbx_motion(path: Path) -> RigMotion:
    """The skeleton of an FBX file and its active animation, in metres and the file's axes.

    Curves are sampled evenly: at the distance of the keys, or at the file's frame rate where keys
    are sparser. Raises HabitusError with the file named.
    """
    scene = read_fbx(path)
    with reading_animation(path):
        return _motion(scene)


def _motion(scene: FbxScene) -> RigMotion:
    rig = rig_of_scene(scene)
    curves, notes = animation_of(scene)
    if not any(which == 1 for _, which, _ in curves):
        raise HabitusError("no animation rotates its joints; expected a skeleton in motion")
    times, rate = even_times(
        [curve.times / scene.second for curve in curves.values()], frame_rate(scene)
    )
    Allowance(scene.path.stat().st_size).take(
        len(times) * len(scene.models), 8 * 33, "its animation"
    )
    parts = np.tile(scene.at_rest(), (len(times), 1, 1, 1))
    at = {model.number: k for k, model in enumerate(scene.models)}
    for (number, which, axis), curve in curves.items():
        parts[:, at[number], which, axis] = curve.at(times * scene.second, scene.second)
    if not np.abs(parts[..., 2, :]).min() > 1e-9:
        raise HabitusError("a scaling of zero; export it again")
    linear, places = scene.world(parts)
    notes = (*rest_of(scene)[2], *notes)
    turns = turns_of(linear)
    up = up_axis_of(scene)
    return RigMotion(rig, scene.scale * places, turns, rate, scene.path.stem, up, notes)


def frame_rate(scene: FbxScene) -> float:
    """The file's frame rate (Hz); 0 where it has none."""
    mode = whole_number(scene.settings, "TimeMode", 0)
    if mode == _CUSTOM:
        return max(real_number(scene.settings, "CustomFrameRate", 0.0), 0.0)
    return _RATES.get(mode, 0.0)


def animation_of(scene: FbxScene) -> tuple[Curves, tuple[str, ...]]:
    """Curves of the active animation, and notes on what is left out."""
    stacks = [n for n, node in scene.objects.items() if node.name == "AnimationStack"]
    layers = _layers(scene)
    found = [(stack, *_curves_of(scene, stack, layers)) for stack in stacks]
    moving = [each for each in found if any(which == 1 for _, which, _ in each[1])]
    if not moving:
        return {}, ()
    active = _active(scene.document)
    named = [each for each in moving if name_of(scene.objects[each[0]]) == active]
    stack, curves, notes = (named or moving)[0]
    if len(moving) > 1:
        name = shown(name_of(scene.objects[stack]))
        notes = (*notes, f"{name!r} is read, of {len(moving)} animations")
    return curves, notes


def _active(document: FbxDocument) -> str:
    """The name of the document's active animation."""
    for node in document.nodes:
        for each in node.all("Document") if node.name == "Documents" else ():
            return str(properties(each).get("ActiveAnimStackName", [""])[0])
    return ""


def _layers(scene: FbxScene) -> dict[int, Curves]:
    """Curves of each AnimationLayer that has any. A curve is read once, however many nodes share
    it.
    """
    known = {model.number for model in scene.models}
    targets: dict[int, list[tuple[int, int]]] = {}
    for child, parent, name in scene.links:
        if name in _MOVING and parent in known:
            targets.setdefault(child, []).append((parent, _MOVING[name]))

    @cache
    def curve(number: int) -> Curve | None:
        node = scene.objects.get(number)
        return curve_of(node, scene.second) if node and node.name == "AnimationCurve" else None

    @cache
    def channels(group: int) -> Curves:
        links = {name: number for number, name in scene.below.get(group, ())}
        read = {axis: curve(links[name]) for name, axis in _AXES.items() if name in links}
        return {
            (model, which, axis): each
            for model, which in targets.get(group, ())
            for axis, each in read.items()
            if each is not None
        }

    found: dict[int, Curves] = {}
    for layer, node in scene.objects.items():
        for group, _ in scene.below.get(layer, ()) if node.name == "AnimationLayer" else ():
            if moved := channels(group):
                found.setdefault(layer, {}).update(moved)
    return found


def _curves_of(
    scene: FbxScene, stack: int, layers: Mapping[int, Curves]
) -> tuple[Curves, tuple[str, ...]]:
    """Curves on the first layer of a stack that has any."""
    own = [
        layer
        for layer in dict.fromkeys(number for number, _ in scene.below.get(stack, ()))
        if layer in layers
    ]
    if not own:
        return {}, ()
    notes = ()
    if len(own) > 1:
        notes = (f"only the first of {len(own)} animation layers is read; bake them",)
    return layers[own[0]], notes
