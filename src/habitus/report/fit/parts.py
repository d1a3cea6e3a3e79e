"""Parts of the body in the report: those that are guessed, and where the tapes of its measurements
lie.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from habitus.fit.markers.solution import GUESSED
from habitus.report.fit.blob import Blob

if TYPE_CHECKING:
    from habitus.fit.markers.result import MarkerFit

_SHARE = (0.75, 1.5)  # of GUESSED: where the colour begins, and where it is full
_WORDS = {
    "pelvis": "pelvis",
    "hip": "thigh",
    "knee": "lower leg",
    "ankle": "foot",
    "foot": "toes",
    "spine1": "belly",
    "spine2": "waist",
    "spine3": "chest",
    "collar": "shoulder",
    "shoulder": "upper arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hand": "fingers",
}


def add_guessed(fit: "MarkerFit", blob: Blob) -> bool:
    """Pack how much of a guess each joint's segment is over time, 0 to 255; gives whether any is
    one anywhere.
    """
    edges, spread = fit.guessed
    low, high = (share * GUESSED for share in _SHARE)
    blob.add("guessed", np.round(255 * np.clip((spread - low) / (high - low), 0, 1)).astype("u1"))
    blob.add("guessedFrames", edges.astype("u4"))
    return bool((spread > GUESSED).any())


def guessed_parts(fit: "MarkerFit") -> list[tuple[str, float]]:
    """The parts that are guessed in half of the capture or more, in words, and how well they are
    known (m).
    """
    typical = np.median(fit.guessed.spread, axis=0)
    return [
        (_part(name), float(known))
        for name, known, guess in zip(
            fit.body.joint_names, typical, fit.guessed.joints(), strict=True
        )
        if guess
    ]


def _part(joint: str) -> str:
    side, _, rest = joint.partition("_")
    if side in ("left", "right") and rest:
        return f"{side} {_WORDS.get(rest, rest)}".replace("_", " ")
    return _WORDS.get(joint, joint).replace("_", " ")


def add_tapes(fit: "MarkerFit", rest: np.ndarray, blob: Blob) -> list[dict[str, Any]]:
    """Pack where tapes touch the body at rest (V, 3); gives name and number of points of each, in
    their order.

    Nothing for a body on which nobody lays tapes.
    """
    kit = fit.body.measuring_kit
    laid = (
        [(tape.name, ring.tape(rest)) for tape in kit.tapes for ring in tape.rings] if kit else []
    )
    blob.add(
        "tapes", np.concatenate([points for _, points in laid] or [np.zeros((0, 3))]).astype("f4")
    )
    return [{"name": f"{name}_circumference_m", "points": len(points)} for name, points in laid]
