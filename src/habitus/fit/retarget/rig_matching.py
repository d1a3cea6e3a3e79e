"""Which joint of somebody else's skeleton is which of a body's: by names in use, or by the tree.

Joints between pelvis and chest are spine1, spine2, ..., those between chest and head neck, neck2,
..., however many there are. By the tree alone a person is two equal limbs at the pelvis, and two
more, with a head between them, at the chest above it; the two longest bones of a limb are thigh and
shank, or upper arm and forearm. Sides follow from where the feet point.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from habitus.body.rig import Rig
from habitus.errors import HabitusError, listed
from habitus.fit.retarget.rig_names import REQUIRED, TABLES, plain_name

ALIKE = 0.05
"""Share by which the lengths of a left and a right limb differ at most, found by the tree."""


@dataclass(frozen=True)
class RigMatch:
    """Numbers of a rig's joints by our names; ``how`` says which table, or that the tree decided.

    ``sided`` is False where left and right are not yet distinguished. ``unmatched`` lists joints
    without a counterpart, except ends of bones.
    """

    joints: Mapping[str, int]
    how: str
    unmatched: tuple[str, ...]
    sided: bool = True


def match_rig(rig: Rig) -> RigMatch:
    """The joints of a person in a rig. Raises HabitusError where there is none."""
    limbs, how = _by_names(rig)
    if limbs is None:
        limbs, how = _by_tree(rig), "the tree of its joints"
    joints = {**limbs, **_trunk(rig, limbs)}
    used = set(joints.values())
    unmatched = tuple(
        name for k, name in enumerate(rig.names) if k not in used and not rig.ends[k] and name
    )
    return RigMatch(joints, how, unmatched, how != "the tree of its joints")


def _by_names(rig: Rig) -> tuple[dict[str, int] | None, str]:
    """Limbs by the table that knows most joints, or by what the file says itself."""
    if not [part for part in REQUIRED if part not in dict(rig.roles)]:
        return dict(rig.roles), "the file's own list of bones"
    plain = [plain_name(name) for name in rig.names]
    exact = [name.strip().lower() for name in rig.names]
    best: dict[str, int] = {}
    chosen = ""
    for table in TABLES:
        known = table.names()
        found: dict[str, int] = {}
        for k, name in enumerate(plain):
            part = known.get(name)
            if part is not None and not rig.ends[k] and _first(found, part, exact, k):
                found[part] = k
        complete = all(part in found for part in REQUIRED)
        if complete and _hangs_together(rig, found) and len(found) > len(best):
            best, chosen = found, table.name
    return (best, chosen) if best else (None, "")


def _first(found: Mapping[str, int], part: str, exact: list[str], k: int) -> bool:
    """Of two joints whose plain names are alike the one with the shorter name counts."""
    return part not in found or len(exact[k]) < len(exact[found[part]])


def _hangs_together(rig: Rig, found: Mapping[str, int]) -> bool:
    """Whether knees are below hips, ankles below knees, elbows below shoulders."""
    chains = (("hip", "knee", "ankle", "foot"), ("collar", "shoulder", "elbow", "wrist"))
    return all(
        rig.path(found[below], found[above])
        for side in ("left", "right")
        for chain in chains
        for above, below in pairwise(
            [f"{side}_{part}" for part in chain if f"{side}_{part}" in found]
        )
    )


def _common(rig: Rig, *joints: int) -> int:
    """The nearest joint above or at all of these; -1 for none."""
    ways = [rig.path(joint) for joint in joints]
    same = [way[0] for way in zip(*ways, strict=False) if len(set(way)) == 1]
    return same[-1] if same else -1


def _trunk(rig: Rig, limbs: Mapping[str, int]) -> dict[str, int]:
    """Pelvis, spine, neck and head, by the tree between the limbs."""
    hips = _common(rig, limbs["left_hip"], limbs["right_hip"])
    chest = _common(rig, limbs["left_shoulder"], limbs["right_shoulder"])
    taken = set(limbs.values()) - {limbs.get("pelvis", -1)}
    below = _common(rig, hips, chest) if min(hips, chest) >= 0 else -1
    if below < 0 or {hips, chest} & taken:
        raise HabitusError("its limbs hang on no common trunk; expected a person's skeleton")
    pelvis = limbs.get("pelvis", hips)
    found = {"pelvis": pelvis if rig.path(limbs["left_hip"], pelvis) else hips}
    spine = [k for k in rig.path(chest, below) if k != found["pelvis"]]
    found |= {f"spine{k + 1}": joint for k, joint in enumerate(spine)}
    head = limbs.get("head", -1)
    neck = rig.path(head, chest)[:-1] if head >= 0 and chest != head else ()
    return found | {"neck" if k == 0 else f"neck{k + 1}": joint for k, joint in enumerate(neck)}


def _by_tree(rig: Rig) -> dict[str, int]:
    """Limbs of a skeleton whose names say nothing, sides arbitrary. Raises HabitusError."""
    pairs = [(joint, pair) for joint in range(rig.num_joints) for pair in _mirrored(rig, joint)]
    for hips, legs in pairs:
        for chest, arms in pairs:
            if chest not in (*legs, *arms) and _above(rig, chest, hips, legs):
                found = {}
                for side, leg, arm in zip(("left", "right"), legs, arms, strict=True):
                    found |= {f"{side}_{part}": k for part, k in _leg(rig, leg).items()}
                    found |= {f"{side}_{part}": k for part, k in _arm(rig, arm).items()}
                head = _head(rig, chest, arms)
                found |= {"head": head} if head is not None else {}
                if all(part in found for part in REQUIRED):
                    return found
    names = [name for name in rig.names if name]
    raise HabitusError(
        "no person's skeleton: no names in use, nor two legs, a spine and two arms; its joints: "
        f"{listed(names, 12)}"
    )


def _above(rig: Rig, chest: int, hips: int, legs: tuple[int, int]) -> bool:
    """Whether a joint hangs on the hips otherwise than by the legs."""
    way = rig.path(chest, hips)
    return bool(way) and way[0] not in legs


def _limb(rig: Rig, start: int) -> tuple[int, ...]:
    """The joints of a limb: from its first one to the farthest below it."""
    best: tuple[int, ...] = (start,)
    length = -1.0
    waiting: list[tuple[tuple[int, ...], float]] = [((start,), 0.0)]
    while waiting:
        way, far = waiting.pop()
        if far > length:
            best, length = way, far
        for child in rig.children(way[-1]):
            bone = float(np.linalg.norm(rig.places[child] - rig.places[way[-1]]))
            waiting.append(((*way, child), far + bone))
    return best


def _lengths(rig: Rig, way: tuple[int, ...]) -> np.ndarray:
    return np.linalg.norm(np.diff(rig.places[list(way)], axis=0), axis=1)


def _mirrored(rig: Rig, joint: int) -> list[tuple[int, int]]:
    """Pairs of limbs of three bones at least that hang on a joint and are alike."""
    limbs = [way for child in rig.children(joint) if len(way := _limb(rig, child)) >= 3]
    sums = {way: float(_lengths(rig, way).sum()) for way in limbs}
    return [
        (one[0], other[0])
        for k, one in enumerate(limbs)
        for other in limbs[k + 1 :]
        if len(one) == len(other)
        and sums[one] > 0.0
        and np.abs(_lengths(rig, one) - _lengths(rig, other)).sum() < ALIKE * sums[one]
        and np.linalg.norm(rig.places[one[0]] - rig.places[other[0]]) > 0.02 * sums[one]
    ]


def _two_bones(rig: Rig, start: int) -> tuple[tuple[int, ...], int] | None:
    """A limb and where in it its two longest bones begin, one after the other."""
    way = _limb(rig, start)
    lengths = _lengths(rig, way)
    if len(lengths) < 2:
        return None
    k = int(np.argmax(np.minimum(lengths[:-1], lengths[1:])))
    return way, k


def _leg(rig: Rig, start: int) -> dict[str, int]:
    found = _two_bones(rig, start)
    if found is None:
        return {}
    way, k = found
    parts = dict(zip(("hip", "knee", "ankle", "foot"), way[k : k + 4], strict=False))
    return {part: joint for part, joint in parts.items() if part != "foot" or not rig.ends[joint]}


def _arm(rig: Rig, start: int) -> dict[str, int]:
    found = _two_bones(rig, start)
    if found is None:
        return {}
    way, k = found
    parts = dict(zip(("shoulder", "elbow", "wrist"), way[k : k + 3], strict=False))
    if rig.ends[way[min(k + 2, len(way) - 1)]]:
        parts.pop("wrist", None)
    return ({"collar": way[k - 1]} if k else {}) | parts


def _head(rig: Rig, chest: int, arms: tuple[int, int]) -> int | None:
    """The last joint before the end of what hangs on the chest between the arms."""
    ways = [_limb(rig, child) for child in rig.children(chest) if child not in arms]
    ways = [tuple(k for k in way if not rig.ends[k]) for way in ways]
    ways = [way for way in ways if way]
    return max(ways, key=lambda way: float(_lengths(rig, way).sum()))[-1] if ways else None


def swapped(match: RigMatch) -> RigMatch:
    """The match with left and right exchanged."""
    other = {"left": "right", "right": "left"}
    joints = {}
    for name, joint in match.joints.items():
        side, _, part = name.partition("_")
        joints[f"{other[side]}_{part}" if side in other else name] = joint
    return RigMatch(joints, match.how, match.unmatched, True)
