"""OpenSim's marker sets (``MarkerSet.xml``, or a whole model, ``.osim``): markers with a body and a
place in its frame.

The places are of a generic skeleton, in metres: x ahead, y up, z to the right of a body that stands
with its arms down and its palms ahead. They are carried to the template by the joints that both
have; markers lie up to some centimetres from where a technician put them.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from habitus.body.model import BodyModel
from habitus.errors import HabitusError, shown
from habitus.io.limits import MAX_PLACED_MARKERS, check_count
from habitus.io.names import plain_name
from habitus.markers.layouts import Marker, MarkerLayout, place_in_words

_PARENTS = (
    "socket_parent_frame",
    "socket_parent_frame_connectee_name",
    "body",
    "frame_name",
    "parent_body",
)
_REACH = 1.0  # metres: no marker is further from its bone
_SPREAD = 0.05
_OFF_SPREAD = 0.006
_FARTHEST = 0.12  # metres: a marker further from the template's skin is no marker on it

# bone: the joints of the template that it lies between (above, below), and their distance in the
# generic skeleton
_LIMBS: Mapping[str, tuple[str, str, float]] = {
    "femur": ("hip", "knee", 0.41),
    "tibia": ("knee", "ankle", 0.40),
    "humerus": ("shoulder", "elbow", 0.29),
    "ulna": ("elbow", "wrist", 0.25),
    "radius": ("elbow", "wrist", 0.25),
    "hand": ("wrist", "hand", 0.09),
}
# bone of the foot: where its origin lies from the ankle in the generic skeleton, z for the right
# side
_FEET = {"talus": (0.0, 0.0, 0.0), "calcn": (-0.049, -0.042, 0.008), "toes": (0.130, -0.044, 0.009)}
_PALM_TURNS = {"ulna": math.pi / 4, "radius": math.pi / 2, "hand": math.pi / 2}
_SIDED = re.compile(r"^(?P<bone>[a-z]+)\d?_(?P<side>[lr])$")


def parse_marker_set(root: Element, name: str, where: str, body: BodyModel) -> MarkerLayout:
    """The layout of a marker set's markers, their places said by ``body``'s landmarks.

    Markers of bones that are not known, or far from the skin (joint centres), are left out with the
    reason. Raises HabitusError where no marker can be placed, or a place is no three numbers.
    """
    markers = {}
    left_out = {}
    elements = list(root.iter("Marker"))
    check_count(len(elements), MAX_PLACED_MARKERS, f"markers in the layout file {where}")
    for element in elements:
        label = plain_name(element.get("name", ""))
        if label and label not in markers:
            marker = _marker(element, label, where, body)
            if isinstance(marker, Marker):
                markers[label] = marker
            else:
                left_out[label] = marker
    if not markers:
        raise HabitusError(
            f"layout file {where}: none of its markers has a place on a bone that is known "
            f"({', '.join(['pelvis', 'torso', 'head', *_LIMBS, *_FEET])}); expected an OpenSim "
            "marker set"
        )
    title = f"OpenSim marker set of {len(markers)} markers"
    return MarkerLayout(
        name, tuple(markers.values()), title, left_out=left_out, num_vertices=len(body.v_template)
    )


def _marker(element: Element, label: str, where: str, body: BodyModel) -> Marker | str:
    bone = next((text for tag in _PARENTS if (text := (element.findtext(tag) or "").strip())), "")
    bone = bone.rsplit("/", 1)[-1]
    location = _location(element.findtext("location"), f"{where}, marker {label}")
    frame = bone_frame(bone, body)
    if frame is None:
        return f"on the bone {shown(bone, 40) or 'that is not named'}, which is not known"
    origin, axes = frame
    vertices = np.asarray(body.v_template, dtype=float)
    distances = np.linalg.norm(vertices - (origin + axes @ location), axis=1)
    vertex = int(np.argmin(distances))
    if distances[vertex] > _FARTHEST:
        return f"{100 * distances[vertex]:.0f} cm from the skin"
    return replace(
        place_in_words(body, vertex),
        label=label,
        place_spread=_SPREAD,
        distance_spread=_OFF_SPREAD,
        distance=0.0125,
    )


def _location(text: str | None, where: str) -> Float[np.ndarray, " 3"]:
    try:
        numbers = [float(part) for part in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(abs(number) < _REACH for number in numbers):
        raise HabitusError(
            f"layout file {where}: location {shown(text or '', 60)!r}; expected three numbers in "
            "metres"
        )
    return np.array(numbers)


def bone_frame(
    bone: str, body: BodyModel
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]] | None:
    """Origin and axes (columns, with the scale) of an OpenSim bone on a body's template; None where
    it is not known.
    """
    joints = dict(
        zip(body.joint_names, np.asarray(body.rest_joints(np.zeros(body.num_betas))), strict=True)
    )
    sided = _SIDED.match(bone.lower())
    if sided is not None:
        side = "left" if sided["side"] == "l" else "right"
        return _of_side(sided["bone"], side, joints)
    upright = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    trunk = {"pelvis", "torso", "head"} & {bone.lower()}
    if not trunk or not {"left_hip", "right_hip", "neck"} <= set(joints):
        return None
    hips = (joints["left_hip"] + joints["right_hip"]) / 2
    height = (joints["neck"] - hips)[1] / _HIPS_TO_NECK
    pelvis = hips + height * (upright @ np.array([0.056, 0.079, 0.0]))
    if bone.lower() == "pelvis":
        return pelvis, height * upright
    if bone.lower() == "torso":
        return pelvis + height * (upright @ np.array([-0.101, 0.082, 0.0])), height * upright
    return joints["neck"], height * upright


_HIPS_TO_NECK = 0.58
"""Metres, in the generic skeleton."""


def _of_side(
    bone: str, side: str, joints: Mapping[str, Float[np.ndarray, " 3"]]
) -> tuple[np.ndarray, np.ndarray] | None:
    names = _LIMBS.get(bone, ("ankle", "knee", 0.40) if bone in _FEET else None)
    if names is None or not {f"{side}_{name}" for name in names[:2]} <= set(joints):
        return None
    top = joints[f"{side}_{names[0]}"]
    bottom = joints[f"{side}_{names[1]}"]
    scale = float(np.linalg.norm(top - bottom)) / names[2]
    if bone in _FEET:
        axes = scale * np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
        return top + axes @ (
            np.array(_FEET[bone]) * [1.0, 1.0, 1.0 if side == "right" else -1.0]
        ), axes
    along = (top - bottom) / np.linalg.norm(top - bottom)
    turn = _PALM_TURNS.get(bone, 0.0)
    ahead = math.cos(turn) * np.array([0.0, 0.0, 1.0]) - math.sin(turn) * np.array([0.0, 1.0, 0.0])
    ahead = ahead - (ahead @ along) * along
    ahead /= np.linalg.norm(ahead)
    return top, scale * np.stack([ahead, along, np.cross(ahead, along)], axis=1)
