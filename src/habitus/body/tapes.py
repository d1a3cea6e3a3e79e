"""Where tapes, calipers and yardsticks go on a body, as data, and how they are laid on its
template.

Places come from landmarks where a body has them, and from joints otherwise.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from habitus.body.rings import Ring, cut

_UP = (0.0, 1.0, 0.0)
_NECK = (0.0, 1.0, 0.45)
ARMS = ("collar", "shoulder", "elbow", "wrist", "hand", "index", "middle", "pinky", "ring", "thumb")
SIDES = ("left_", "right_")
_MIDLINE = 1e-4  # metres


@dataclass(frozen=True)
class Span:
    """An extent of a tape's ring along a direction; ``midline``: of those of its points in the
    plane of symmetry.
    """

    name: str
    direction: tuple[float, float, float]
    midline: bool = False


@dataclass(frozen=True)
class Tape:
    """A plane between two places (landmarks, or joints ``otherwise``) at a share of the way, across
    a direction.

    ``across`` is a direction, two places that it leads between, or None: the way itself. ``spans``
    are what is measured besides on the same ring.
    """

    name: str
    start: str
    end: str
    share: float = 0.5
    across: tuple[float, float, float] | tuple[str, str] | None = None
    otherwise: tuple[str, str, float] | None = None
    spans: tuple[Span, ...] = ()


def _trunk(name: str, midline: bool = False) -> tuple[Span, ...]:
    return Span(f"{name}_breadth_m", (1.0, 0.0, 0.0)), Span(
        f"{name}_depth_m", (0.0, 0.0, 1.0), midline
    )


TRUNK = (
    Tape(
        "chest", "left_breast", "right_breast", 0.5, _UP, ("spine2", "spine3", 0.7), _trunk("chest")
    ),
    Tape(
        "natural_waist", "left_waist_side", "right_waist_side", 0.5, _UP, ("spine1", "spine2", 0.6)
    ),
    Tape(
        "waist",
        "navel",
        "waist_back",
        0.0,
        _UP,
        ("spine1", "spine2", 0.1),
        _trunk("waist", midline=True),
    ),
    Tape(
        "hip",
        "left_buttock",
        "right_buttock",
        0.5,
        _UP,
        ("left_hip", "right_hip", 0.5),
        _trunk("hip"),
    ),
)
HEAD = (
    Tape("neck", "neck", "head", 0.25, _NECK),
    Tape("head", "glabella", "head_back", 0.5, _UP),
)
LIMBS = (
    Tape("thigh", "left_hip", "left_knee", 0.25),
    Tape("knee", "left_patella", "left_knee", 0.0, _UP, ("left_knee", "left_knee", 0.0)),
    Tape("calf", "left_knee", "left_ankle", 0.3, _UP),
    Tape("ankle", "left_knee", "left_ankle", 0.78, _UP),
    Tape("upper_arm", "left_shoulder", "left_elbow", 0.6),
    Tape("forearm", "left_elbow", "left_wrist", 0.22),
    Tape("wrist", "left_elbow", "left_wrist", 0.97),
    Tape(
        "hand", "left_hand_radial", "left_hand_ulnar", 0.5, ("left_wrist", "left_middle_tip"),
        spans=(Span("hand_breadth_m", (0.0, 0.0, 1.0)),),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class LaidTape:
    """A tape on a body's template: one ring, or one a side; ``spans`` with the rings whose extents
    they are.
    """

    name: str
    rings: tuple[Ring, ...]
    spans: tuple[tuple[Span, tuple[Ring, ...]], ...]


def lay_tapes(
    vertices: np.ndarray, faces: np.ndarray, places: Mapping[str, np.ndarray], arms: np.ndarray
) -> tuple[LaidTape, ...]:
    """The tapes that a template (V, 3) has places for; those of the trunk pass by the vertices
    ``arms`` (V,).
    """
    trunk = faces[~arms[faces].any(1)]
    groups = (
        (TRUNK, trunk, True, ("",)),
        (HEAD, faces, False, ("",)),
        (LIMBS, faces, False, SIDES),
    )
    laid = []
    for tapes, skin, whole, sides in groups:
        for tape in tapes:
            planes = [plane for side in sides if (plane := _plane(tape, side, places)) is not None]
            rings = [
                ring for plane in planes if (ring := cut(vertices, skin, *plane, whole)) is not None
            ]
            if rings:
                spans = tuple((span, _spanned(span, rings, vertices)) for span in tape.spans)
                laid.append(LaidTape(tape.name, tuple(rings), spans))
    return tuple(laid)


def _spanned(span: Span, rings: list[Ring], vertices: np.ndarray) -> tuple[Ring, ...]:
    """What of a tape's rings a span is taken of; whole rings where too little of them lies in the
    midline.
    """
    return tuple(
        ring.middle(vertices, _MIDLINE) or ring if span.midline else ring for ring in rings
    )


def _plane(
    tape: Tape, side: str, places: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray] | None:
    """A place and a normal, on one side of the body; None where the body does not have the
    places.
    """
    if tape.otherwise is not None and not {tape.start, tape.end} <= places.keys():
        start, end, share = tape.otherwise
        tape = replace(tape, start=start, end=end, share=share)
    named = [end for end in tape.across or () if isinstance(end, str)]
    wanted = [tape.start, tape.end, *named]
    names = [name.replace("left_", side) if side else name for name in wanted]
    if not set(names) <= places.keys():
        return None
    start, end, *way = (places[name] for name in names)
    place = start + tape.share * (end - start)
    if named:
        return place, way[1] - way[0]
    return place, end - start if tape.across is None else np.array(tape.across)
