"""What is measured of a person who stands with hanging arms and heels together, as surveys take it.

The body's own function brings it there from rest: collar bones and arms are lowered, legs are drawn
together.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from habitus.body.prepared import PreparedBody
from habitus.body.tapes import Ring

HANGING = np.deg2rad(83.0)
"""Of the arms below the level."""
COLLAR = 0.15
"""Of the arms' way that the collar bones go along."""
HEEL = 0.052
"""Metres from the midline to an ankle's centre where heels touch, of a body 1.75 m tall."""
STANDING_TAPES = ("chest", "hip")
_SHOULDER = 0.14  # metres around a shoulder's centre within which it is broadest
_MARKS = ("left_acromion", "right_acromion")


@dataclass(frozen=True, eq=False)
class Standing:
    """Which vertices are posed, and what is read off them: marks by name, shoulders, hips, tapes of
    chest and hip.

    All but ``vertices`` count in these. ``prepared`` is the body function of these vertices.
    """

    pose: Mapping[str, tuple[float, float, float]]
    vertices: Int[np.ndarray, " N"]
    prepared: PreparedBody
    marks: Mapping[str, int]
    shoulders: slice
    hips: slice
    tapes: Mapping[str, Ring]

    def measure(
        self,
        vertices: Float[np.ndarray, "N V 3"],
        joints: Float[np.ndarray, "N J 3"],
        sole: np.ndarray,
    ) -> dict[str, np.ndarray]:
        """Shoulders, chest and hips (m) of rest surfaces whose soles are at ``sole`` (N,)."""
        posed = self.prepared.carried(vertices[:, self.vertices], joints, self.pose)
        at = {name: posed[:, k] for name, k in self.marks.items()}
        found = {}
        if len(at) == len(_MARKS):
            found["shoulder_height_m"] = (
                0.5 * (at["left_acromion"] + at["right_acromion"])[:, 1] - sole
            )
            found["biacromial_breadth_m"] = np.linalg.norm(
                at["left_acromion"] - at["right_acromion"], axis=-1
            )
        for name, ring in self.tapes.items():
            found[f"{name}_circumference_m"] = ring.length(posed)
            found[f"{name}_breadth_m"] = ring.extent(posed, np.array([1.0, 0.0, 0.0]))
            found[f"{name}_depth_m"] = ring.extent(posed, np.array([0.0, 0.0, 1.0]))
        for name, part in (("shoulder_breadth_m", self.shoulders), ("hip_breadth_m", self.hips)):
            if part.stop > part.start:
                found[name] = np.ptp(posed[:, part, 0], axis=-1)
        return found


def stand(
    body: Any,
    places: Mapping[str, np.ndarray],
    arms: np.ndarray,
    upper_arms: np.ndarray,
    tapes: Mapping[str, Ring],
) -> Standing | None:
    """How this body stands; None where it lacks the joints.

    places: joints and landmarks of the template. arms (V,): which vertices are arms; upper_arms
    (V,): which are carried by the shoulders. tapes: those at rest that are read standing.
    """
    names = {
        f"{side}{joint}"
        for side in ("left_", "right_")
        for joint in ("collar", "shoulder", "elbow", "hip")
    }
    if not names | {"left_ankle", "right_ankle"} <= set(body.joint_names):
        return None
    marks = {name: body.landmarks[name] for name in _MARKS if name in body.landmarks}
    shoulders = _shoulders(body.v_template, places, upper_arms)
    hips = _hips(body.v_template, places, arms)
    parts = [
        np.array([*marks.values()], int),
        shoulders,
        hips,
        *(ring.edges.ravel() for ring in tapes.values()),
    ]
    ends = np.cumsum([len(part) for part in parts])
    moved = {
        name: Ring(start + np.arange(ring.edges.size).reshape(-1, 2), ring.share, ring.axes)
        for (name, ring), start in zip(tapes.items(), ends[2:], strict=False)
    }
    pose = _arms_down(places) | _heels_together(places, float(np.ptp(body.v_template[:, 1])))
    local = dict(zip(marks, range(len(marks)), strict=True))
    vertices = np.concatenate(parts)
    return Standing(
        pose,
        vertices,
        body.prepare((), vertices),
        local,
        slice(*ends[:2]),
        slice(*ends[1:3]),
        moved,
    )


def _arms_down(places: Mapping[str, np.ndarray]) -> dict[str, tuple[float, float, float]]:
    """Turns about z that let the arms of the template hang."""
    pose = {}
    for side, sign in (("left_", -1.0), ("right_", 1.0)):
        way = places[f"{side}elbow"] - places[f"{side}shoulder"]
        turn = HANGING + float(np.arctan2(way[1], abs(way[0])))
        pose |= {f"{side}collar": (0.0, 0.0, sign * COLLAR * turn)}
        pose |= {f"{side}shoulder": (0.0, 0.0, sign * (1 - COLLAR) * turn)}
    return pose


def _heels_together(
    places: Mapping[str, np.ndarray], height: float
) -> dict[str, tuple[float, float, float]]:
    """Turns about z that bring the ankles to each other, and the soles back to the floor."""
    pose = {}
    for side, sign in (("left_", 1.0), ("right_", -1.0)):
        hip = places[f"{side}hip"]
        ankle = places[f"{side}ankle"]
        down = hip[1] - ankle[1]
        now = sign * (ankle[0] - hip[0])
        aim = HEEL * height / 1.75 - sign * hip[0]
        turn = sign * float(np.arctan2(aim, down) - np.arctan2(now, down))
        pose |= {f"{side}hip": (0.0, 0.0, turn), f"{side}ankle": (0.0, 0.0, -turn)}
    return pose


def _shoulders(
    template: np.ndarray, places: Mapping[str, np.ndarray], upper_arms: np.ndarray
) -> np.ndarray:
    """Vertices of both deltoids."""
    found = np.zeros(len(template), bool)
    for side in ("left_", "right_"):
        start = places[f"{side}shoulder"]
        end = places[f"{side}elbow"]
        beyond = (template - start) @ (end - start) > 0
        found |= upper_arms & beyond & (np.linalg.norm(template - start, axis=1) < _SHOULDER)
    return np.flatnonzero(found)


def _hips(template: np.ndarray, places: Mapping[str, np.ndarray], arms: np.ndarray) -> np.ndarray:
    """Vertices of the flanks between the navel's height and a third of the way down the thighs."""
    hip = places["left_hip"]
    knee = places["left_knee"]
    thigh = hip[1] - knee[1]
    level = (template[:, 1] < hip[1] + 0.3 * thigh) & (template[:, 1] > hip[1] - 0.4 * thigh)
    return np.flatnonzero(level & ~arms & (np.abs(template[:, 0]) > abs(hip[0])))
