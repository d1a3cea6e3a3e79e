"""Left and right: which vertex is which one's mirror image, and which joint (the symmetry that S
4.1's priors use).
"""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from habitus.errors import HabitusError
from habitus.mesh.template import Template

_ACROSS = np.array([-1.0, 1.0, 1.0])
_SIDES = (("left", "right"), ("l", "r"))
_MARKS = (  # where a name keeps its side, the surest first
    r"(?i)(left|right)",
    r"(?i)(?:(?<=^)|(?<=[^a-z]))([lr])(?=[^a-z]|$)",
    r"(?:(?<=^)|(?<=[a-z]))([LR])(?=[A-Z])",
    r"(?<=[a-z0-9])([LR])$",
    r"^([lrLR])(?=[a-zA-Z])",
)
_EXPLICIT = re.compile(
    r"(?i)(?:^|[^a-z])(left|right)|(?:Left|Right)|(?i:(?:^|[^a-z])[lr](?=[^a-z]|$))"
)


def find_mirror(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    tolerance: float | None = None,
) -> Int[np.ndarray, " V"]:
    """Each vertex's partner across the plane x = 0, itself on the plane.

    Vertices are paired by place first, within ``tolerance`` (m; half a median edge unless given).
    Only pairs all of whose faces have an image are kept, and spread over the faces: the third
    corner of a face is the partner of the third corner of its image. Where that does not reach all
    (quads may be cut along other diagonals on the other side), pairs are kept half of whose edges
    have an image. Raises HabitusError where vertices are left without a partner.
    """
    if tolerance is None:
        tolerance = 0.5 * float(
            np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1))
        )
    near = _near(vertices, tolerance)
    edges = _edges(faces, len(vertices))
    for doubtful in (_unsure(near, faces), _contradicted(near, edges)):
        partner = np.where(doubtful, -1, near)
        partner[partner[partner] != np.arange(len(partner))] = -1
        partner = _spread(partner, faces)
        alone = (
            (partner < 0)
            | (partner[partner] != np.arange(len(partner)))
            | _contradicted(partner, edges)
        )
        if not alone.any():
            return partner
    raise HabitusError(
        f"{alone.sum()} of {len(alone)} vertices (first {np.flatnonzero(alone)[0]}) have no "
        "partner across x = 0; "
        "expected a symmetric mesh: give its mirror, or go without"
    )


def mirrored_joints(
    joint_names: Sequence[str],
    parents: Sequence[int],
    places: Float[np.ndarray, "J 3"] | None = None,
) -> Int[np.ndarray, " J"]:
    """Each joint's partner on the other side, itself in the middle.

    Names tell, in any spelling (left_knee, L_Knee, knee.l, LeftKnee, lKnee). Where no name has a
    partner, the tree and the ``places`` of the joints (m; the middles of their parts, NaN where
    there is none) do. Raises HabitusError where a name that says left or right has no partner, or
    partners hang on joints that are no partners.
    """
    partner = _by_name(joint_names)
    if np.array_equal(partner, np.arange(len(parents))):
        if places is not None:
            return _by_place(parents, places)
        if len(set(parents)) < len(parents):
            raise HabitusError(
                f"no name of {list(joint_names)} says left or right; give the joints' places as "
                "well"
            )
    for joint, parent in enumerate(parents):
        if parent >= 0 and parents[partner[joint]] != partner[parent]:
            raise HabitusError(
                f"{joint_names[joint]} and {joint_names[partner[joint]]} hang on joints that are "
                "no partners; "
                "expected a tree that is the same on both sides: give its joint_mirror"
            )
    return partner


def with_mirror(template: Template) -> Template:
    """The template with its two maps of left and right found where it has none.

    Raises HabitusError where its mesh or its tree is not symmetric.
    """
    mirror = template.mirror
    joint_mirror = template.joint_mirror
    if mirror is None:
        mirror = find_mirror(template.vertices, template.faces)
    if joint_mirror is None:
        joint_mirror = mirrored_joints(
            template.joint_names, template.parents, part_places(template)
        )
    return replace(template, mirror=mirror, joint_mirror=joint_mirror)


def part_places(template: Template) -> Float[np.ndarray, "J 3"]:
    """The middle (m) of each part; NaN where a joint has no vertices."""
    count = np.bincount(template.part, minlength=template.num_joints).astype(np.float64)
    sums = [
        np.bincount(template.part, column, template.num_joints) for column in template.vertices.T
    ]
    count[count == 0] = np.nan
    return np.stack(sums, 1) / count[:, None]


def _near(vertices: Float[np.ndarray, "V 3"], tolerance: float) -> Int[np.ndarray, " V"]:
    """The nearest vertex to each vertex's image where both agree and it is near enough; else -1."""
    distance, partner = map(np.asarray, KDTree(vertices).query(vertices * _ACROSS))
    agreed = (partner[partner] == np.arange(len(partner))) & (distance <= tolerance)
    return np.where(agreed, partner, -1)


def _keys(first: np.ndarray, second: np.ndarray, count: int) -> np.ndarray:
    return first.astype(np.int64) * count + second


def _third_corners(faces: Int[np.ndarray, "F 3"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """The directed edges of all faces as sorted keys, and the corner across each."""
    edges = np.concatenate([_keys(faces[:, i], faces[:, (i + 1) % 3], count) for i in range(3)])
    order = np.argsort(edges, kind="stable")
    return edges[order], np.concatenate([faces[:, (i + 2) % 3] for i in range(3)])[order]


def _across(
    keys: tuple[np.ndarray, np.ndarray], first: np.ndarray, second: np.ndarray, count: int
) -> Int[np.ndarray, " n"]:
    """The third corner of the face with the directed edge from ``first`` to ``second``; -1 where
    there is no face.
    """
    wanted = _keys(first, second, count)
    place = np.searchsorted(keys[0], wanted).clip(max=len(keys[0]) - 1)
    return np.where(keys[0][place] == wanted, keys[1][place], -1)


def _edges(faces: Int[np.ndarray, "F 3"], count: int) -> Int[np.ndarray, " E"]:
    """Both directions of every edge once, as sorted keys."""
    both = np.concatenate([faces[:, [i, j]] for i in range(3) for j in range(3) if i != j])
    return np.unique(_keys(both[:, 0], both[:, 1], count))


def _unsure(
    partner: Int[np.ndarray, " V"], faces: Int[np.ndarray, "F 3"]
) -> Bool[np.ndarray, " V"]:
    """The vertices with a face about them that has no mirror image."""
    corners = _third_corners(faces, len(partner))
    a, b, c = partner[faces].T
    missing = (a < 0) | (b < 0) | (c < 0) | (_across(corners, b, a, len(partner)) != c)
    return (partner < 0) | np.isin(np.arange(len(partner)), faces[missing])


def _contradicted(
    partner: Int[np.ndarray, " V"], edges: Int[np.ndarray, " E"]
) -> Bool[np.ndarray, " V"]:
    """Vertices of whose edges, as far as both ends have partners, fewer than half have a mirror
    image.
    """
    first = edges // len(partner)
    second = edges % len(partner)
    known = (partner[first] >= 0) & (partner[second] >= 0)
    first = first[known]
    second = second[known]
    kept = np.isin(_keys(partner[first], partner[second], len(partner)), edges)
    total = np.bincount(first, minlength=len(partner))
    good = np.bincount(first, kept, len(partner))
    return 2 * good < total


def _spread(partner: Int[np.ndarray, " V"], faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " V"]:
    """Partners handed on from face to face: mirroring turns a face's sense round."""
    partner, count = partner.copy(), len(partner)
    keys = _third_corners(faces, count)
    corners = np.concatenate([np.roll(faces, turn, axis=1) for turn in range(3)])
    while True:
        a, b, c = corners[
            (partner[corners[:, :2]] >= 0).all(axis=1) & (partner[corners[:, 2]] < 0)
        ].T
        image = _across(keys, partner[b], partner[a], count)
        new = (image >= 0) & (partner[image] < 0)
        if not new.any():
            return partner
        partner[c[new]] = image[new]
        partner[image[new]] = c[new]


def _by_name(names: Sequence[str]) -> Int[np.ndarray, " J"]:
    place = {name: joint for joint, name in enumerate(names)}
    partner = np.arange(len(names))
    for joint, name in enumerate(names):
        partners = [place[other] for other in _other_side(name) if other in place]
        if partners:
            partner[joint] = partners[0]
    off = [names[joint] for joint in range(len(names)) if partner[partner[joint]] != joint]
    off += [
        name
        for joint, name in enumerate(names)
        if partner[joint] == joint and _EXPLICIT.search(name)
    ]
    if off and not np.array_equal(partner, np.arange(len(names))):
        raise HabitusError(
            f"joint {off[0]!r} has no partner of its own on the other side; give its joint_mirror"
        )
    return partner


def _other_side(name: str) -> list[str]:
    """What a joint's partner may be called."""
    others = []
    for mark in _MARKS:
        match = re.search(mark, name)
        if match:
            others.append(name[: match.start(1)] + _swapped(match.group(1)) + name[match.end(1) :])
    return others


def _swapped(side: str) -> str:
    for left, right in _SIDES:
        for one, other in ((left, right), (right, left)):
            if side.lower() == one:
                return (
                    other.upper()
                    if side.isupper()
                    else other.title()
                    if side[0].isupper()
                    else other
                )
    return side


def _by_place(parents: Sequence[int], places: Float[np.ndarray, "J 3"]) -> Int[np.ndarray, " J"]:
    """From the root down: the children of a joint are paired with the children of its partner,
    nearest images first.
    """
    children = [
        [joint for joint, parent in enumerate(parents) if parent == above]
        for above in range(len(parents))
    ]
    partner = np.zeros(len(parents), dtype=np.int64)
    for joint in range(len(parents)):  # parents come first
        below = children[joint]
        across = children[partner[joint]]
        if len(below) != len(across):
            raise HabitusError(
                f"joint {joint} has {len(below)} children, its partner {partner[joint]} has "
                f"{len(across)}; "
                "expected a tree that is the same on both sides: give its joint_mirror"
            )
        gap = np.linalg.norm(places[below][:, None] * _ACROSS - places[across], axis=-1)
        rows, columns = linear_sum_assignment(np.where(np.isnan(gap), 0.0, gap))
        partner[np.array(below, dtype=int)[rows]] = np.array(across, dtype=int)[columns]
    return partner
