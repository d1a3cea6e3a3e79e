"""VRM 1.0: the person at rest as an avatar, for VTubing, VRChat-like worlds and three-vrm.

A .vrm is binary glTF with the extension VRMC_vrm (vrm-c/vrm-specification, VRMC_vrm-1.0): the
humanoid's bones, terms of use, expressions, gaze. It has no motion.
"""

import os
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.errors import HabitusError, shown
from habitus.export.animation import Animation, animate, body_at, one_sided
from habitus.export.faces import with_face
from habitus.export.glb import document_of, write_document
from habitus.export.rigging import Bones, rigged
from habitus.export.rigs import rig_named
from habitus.export.skins import painted

if TYPE_CHECKING:
    from habitus.body.motion import Moving

INFLUENCES = 4
"""Joints a vertex: readers of VRM know one set of JOINTS and WEIGHTS."""
_SIDED = ("upperLeg", "lowerLeg", "foot", "upperArm", "lowerArm", "hand")
REQUIRED = frozenset(
    {
        "hips",
        "spine",
        "head",
        *(f"{side}{bone[0].upper()}{bone[1:]}" for side in ("left", "right") for bone in _SIDED),
    }
)
"""Bones that every VRM humanoid has."""
_BOTH = ("Left", "Right")


def _pair(unit: str, weight: float = 1.0) -> dict[str, float]:
    return {f"{unit}{side}": weight for side in _BOTH}


PRESETS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "happy": _pair("mouthSmile") | _pair("cheekSquint", 0.6),
        "angry": _pair("browDown") | _pair("noseSneer", 0.6) | _pair("mouthFrown", 0.4),
        "sad": {"browInnerUp": 1.0} | _pair("mouthFrown", 0.8) | _pair("eyeSquint", 0.3),
        "relaxed": _pair("mouthSmile", 0.4) | _pair("eyeBlink", 0.3),
        "surprised": {"browInnerUp": 0.8, "jawOpen": 0.4} | _pair("eyeWide"),
        "aa": {"jawOpen": 0.7},
        "ih": {"jawOpen": 0.2} | _pair("mouthStretch", 0.5),
        "ou": {"mouthPucker": 0.9, "jawOpen": 0.1},
        "ee": {"jawOpen": 0.1} | _pair("mouthStretch", 0.8) | _pair("mouthSmile", 0.3),
        "oh": {"mouthFunnel": 0.8, "jawOpen": 0.4},
        "blink": _pair("eyeBlink"),
        "blinkLeft": {"eyeBlinkLeft": 1.0},
        "blinkRight": {"eyeBlinkRight": 1.0},
        "lookUp": _pair("eyeLookUp"),
        "lookDown": _pair("eyeLookDown"),
        "lookLeft": {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0},
        "lookRight": {"eyeLookInLeft": 1.0, "eyeLookOutRight": 1.0},
    }
)
"""VRM's expressions as weights of ARKit's units: chosen by eye."""
_BOUND = ("blink", "lookAt", "mouth")
_OPEN_TERMS = {
    "avatarPermission": "everyone",
    "commercialUsage": "corporation",
    "creditNotation": "unnecessary",
    "allowRedistribution": True,
    "modification": "allowModificationRedistribution",
    "otherLicenseUrl": "https://creativecommons.org/publicdomain/zero/1.0/",
    "copyrightInformation": "The body model is CC0 1.0.",
}
_SHIPPED = frozenset({"neutral", "female", "male", "default"})


def write_vrm(
    fit: "Moving",
    path: str | os.PathLike[str],
    *,
    detail: str = "full",
    skin: str | float | None = None,
    bones: Bones | None = None,
) -> Animation:
    """Write a person at rest as a VRM 1.0 avatar, atomically; what was written comes back.

    Metres, +y up, a T-pose that faces +z with the soles at y = 0. With a body of face units a morph
    target and an expression for each, VRM's presets made of them, and a gaze by eye bones or, where
    the body has none, by expressions. Pose blend shapes are left out: nothing in VRM drives them.
    A vertex follows its four heaviest joints. The terms name CC0 for shipped bodies; for others
    they are VRM's most restrictive. Raises HabitusError for a body without the required bones, for
    another skin, and where the file cannot be written.
    """
    body = body_at(fit, detail)
    _check_bones(body)
    body = _four_influences(body)
    still = BodyMotion(
        body,
        np.asarray(fit.betas, np.float64),
        np.zeros((2, body.num_joints, 3)),
        np.zeros((2, 3)),
        float(fit.rate_hz),
        "+y",
        capture_name=fit.capture_name,
    )
    animation = one_sided(animate(still, correctives="none", body=body))
    if body.face is not None:
        animation = with_face(animation, None)
    animation = rigged(animation, replace(bones or Bones(), rig="vrm"))
    document = document_of(painted(animation, skin), shown(fit.capture_name, 200), moving=False)
    document.extensionsUsed = ["VRMC_vrm"]
    document.extensions = {"VRMC_vrm": _extension(animation, shown(fit.capture_name, 200))}
    write_document(document, path)
    return animation


def _check_bones(body: BodyModel) -> None:
    table = rig_named("vrm").bones
    missing = REQUIRED - {table.get(name, name) for name in body.joint_names}
    if missing:
        raise HabitusError(
            f"{body.called} has no joints for VRM's {', '.join(sorted(missing))}; expected a body "
            "with the joints of the SMPL family"
        )


def _four_influences(body: BodyModel) -> BodyModel:
    """The body with the heaviest four joints of each vertex."""
    if body.skinning_index.shape[1] <= INFLUENCES:
        return body
    order = np.argsort(-body.skinning_value, axis=1, kind="stable")[:, :INFLUENCES]
    value = np.take_along_axis(body.skinning_value, order, axis=1)
    value = value / value.sum(axis=1, keepdims=True)
    index = np.take_along_axis(body.skinning_index, order, axis=1)
    return replace(body, skinning_index=index, skinning_value=value)


def _extension(animation: Animation, name: str) -> dict[str, Any]:
    bones = set(rig_named("vrm").bones.values())
    nodes = {each: k for k, each in enumerate(animation.skeleton.names) if each in bones}
    meshed = len(animation.skeleton.names)
    terms = _OPEN_TERMS if animation.body.name in _SHIPPED else {}
    extension: dict[str, Any] = {
        "specVersion": "1.0",
        "meta": {
            "name": name or "person",
            "authors": ["made with habitus"],
            "licenseUrl": "https://vrm.dev/licenses/1.0/",
            **terms,
        },
        "humanoid": {"humanBones": {bone: {"node": node} for bone, node in nodes.items()}},
        "firstPerson": {"meshAnnotations": [{"node": meshed, "type": "auto"}]},
    }
    units = {each: k for k, each in enumerate(animation.morph_names)}
    if animation.body.face is not None:
        presets = {each: _expression(meshed, units, parts) for each, parts in PRESETS.items()}
        custom = {each: _expression(meshed, units, {each: 1.0}) for each in units}
        extension["expressions"] = {"preset": presets, "custom": custom}
        extension["lookAt"] = _gaze(animation, "leftEye" in nodes)
    return extension


def _expression(node: int, units: Mapping[str, int], parts: Mapping[str, float]) -> dict[str, Any]:
    binds = [
        {"node": node, "index": units[unit], "weight": weight}
        for unit, weight in parts.items()
        if unit in units
    ]
    return {"morphTargetBinds": binds, "isBinary": False} | {
        f"override{each[0].upper()}{each[1:]}": "none" for each in _BOUND
    }


def _gaze(animation: Animation, by_bones: bool) -> dict[str, Any]:
    """From where the person looks, in the head bone's axes, and how far eyes turn (degrees) or
    expressions go.
    """
    lids = [animation.morph_names.index(f"eyeBlink{side}") for side in _BOTH]
    moved = np.linalg.norm(animation.morphs[lids], axis=-1).sum(axis=0)
    eyes = np.average(animation.rest_vertices, axis=0, weights=moved)
    head = animation.skeleton.rest[animation.skeleton.names.index("head")]
    offset = head[:3, :3].T @ (eyes - head[:3, 3])
    reach = {"inputMaxValue": 90.0, "outputScale": 10.0 if by_bones else 1.0}
    ranges = ("HorizontalInner", "HorizontalOuter", "VerticalDown", "VerticalUp")
    return {
        "offsetFromHeadBone": [float(f"{value:.6g}") for value in offset],
        "type": "bone" if by_bones else "expression",
        **{f"rangeMap{each}": dict(reach) for each in ranges},
    }
