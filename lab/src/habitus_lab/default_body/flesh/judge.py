"""What bodies keep of their volume, girth and skin in ten poses, beside the same bodies without
pose blend shapes.

    python -m habitus_lab.default_body.flesh.judge [female male neutral | MODEL.npz ...] [--out
    NUMBERS.json]

Five people of each: the mean, and two standard deviations either way along the first and the second
shape coefficient. Full detail. Columns: change of the signed volume (litres and %), of the union by
rays (what skin that passes through skin hides is lost; % of the limb), pairs of triangles that cut
each other, girth of forearm's end and upper arm (%).
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np

from habitus import load_body
from habitus.body.model import BodyModel
from habitus_lab.default_body.flesh.gates import volume
from habitus_lab.default_body.flesh.poses import mirrored_pose, named
from habitus_lab.default_body.flesh.studio import SKIN, below, dense_weights
from habitus_lab.default_body.form_checks import TWISTS, hull_girth, limb_ring
from habitus_lab.default_body.form_checks import Person as Form
from habitus_lab.default_body.intersections import intersecting_pairs

Degrees = dict[str, tuple[float, float, float]]
ARMS_DOWN: Degrees = {"left_shoulder": (0, 0, -68), "left_collar": (0, 0, -8)}
SITTING: Degrees = {"left_hip": (-90, 0, 0), "left_knee": (90, 0, 0)}
POSES: dict[
    str, tuple[Degrees, bool]
] = {  # degrees of the left side; whether the right side does the same
    "elbow 140": ({"left_elbow": (0, -140, 0)}, False),
    "knee 140": ({"left_knee": (140, 0, 0)}, False),
    "hip 90": ({"left_hip": (-90, 0, 0)}, False),
    "sitting": (SITTING, True),
    "squat": (
        {"left_hip": (-112, 0, 20), "left_knee": (130, 0, 0), "left_ankle": (-24, 0, 0)},
        True,
    ),
    "bend": (
        {"spine1": (30, 0, 0), "spine2": (27, 0, 0), "spine3": (21, 0, 0), "left_hip": (-60, 0, 0)},
        True,
    ),
    "arms down": (ARMS_DOWN, True),
    "arms up": ({"left_shoulder": (0, 0, 60), "left_collar": (0, 0, 25)}, True),
    "wrist 90": ({"left_wrist": (90, 0, 0)}, False),
    "upper arm 90": ({"left_shoulder": (85, 0, 0)}, False),
}
LIMB = {"elbow 140": "left_shoulder", "knee 140": "left_hip"}
PEOPLE: dict[str, dict[int, float]] = {
    "mean": {},
    "1 +2": {0: 2},
    "1 -2": {0: -2},
    "2 +2": {1: 2},
    "2 -2": {1: -2},
}
STEP = 0.002  # m between rays


@dataclass(frozen=True)
class Row:
    """One pose of one person: changes of volume (litres, %), union lost (% of the limb; litres),
    pairs.
    """

    litres: float
    percent: float
    lost: float
    lost_litres: float
    pairs: int


def judge(body: BodyModel) -> dict[str, dict]:
    """Person -> pose -> Row's fields, and the girths under twist."""
    return {name: _person(body, _betas(body, some)) for name, some in PEOPLE.items()}


def _betas(body: BodyModel, some: dict[int, float]) -> np.ndarray:
    betas = np.zeros(body.num_betas)
    for k, value in some.items():
        betas[k] = value
    return betas


def _person(body: BodyModel, betas: np.ndarray) -> dict[str, dict]:
    faces = np.asarray(body.faces)[(np.asarray(body.faces) < SKIN).all(1)]
    rest = np.asarray(body(betas).vertices, float)[:SKIN]
    own = volume(rest, faces), union(rest, faces)
    found: dict[str, dict] = {}
    for name, (degrees, both) in POSES.items():
        pose = named(body.joint_names, degrees)
        pose = np.where(pose == 0, mirrored_pose(pose, body.joint_names), pose) if both else pose
        posed = np.asarray(body(betas, pose).vertices, float)[:SKIN]
        change = volume(posed, faces) - own[0]
        lost = own[1] - union(posed, faces)
        limb = _limb(body, rest, faces, LIMB[name]) if name in LIMB else own[0]
        pairs = len(intersecting_pairs(posed, faces))
        found[name] = vars(
            Row(1e3 * change, 100 * change / own[0], 100 * lost / limb, 1e3 * lost, pairs)
        )
    return found | {"girths": _girths(body, betas)}


def _limb(body: BodyModel, rest: np.ndarray, faces: np.ndarray, top: str) -> float:
    """Volume (m^3) of what hangs from a joint, closed by a cone over its rim."""
    inside = dense_weights(body)[:SKIN, below(body, top)].sum(1) > 0.5
    own = faces[inside[faces].all(1)]
    edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
    twins = {*map(tuple, edges[:, ::-1].tolist())}
    rim = np.unique([edge for edge in edges.tolist() if tuple(edge) not in twins])
    return volume(rest - rest[rim].mean(0), own)


def _girths(body: BodyModel, betas: np.ndarray) -> dict[str, float]:
    """Least girth (% of that at rest) at +-90 degrees of twist: near the wrist, and in the middle
    of the upper arm.
    """
    form = Form(body, betas)
    found = {}
    for driver, share in (("left_wrist", 0.9), ("left_shoulder", 0.5)):
        upper, lower, _, _, reach = TWISTS[driver]
        start = form.joint(upper)
        end = form.joint(lower)
        axis = (end - start) / np.linalg.norm(end - start)
        ring = limb_ring(form, start + share * (end - start), axis, reach)
        rest = hull_girth(form.vertices, ring, axis)
        turned = (form.posed({driver: tuple(sign * 90 * axis)})[0] for sign in (-1, 1))
        found[driver] = min(100 * hull_girth(v, ring, axis) / rest for v in turned)
    return found


def union(vertices: np.ndarray, faces: np.ndarray, step: float = STEP) -> float:
    """Volume (m^3) of what the skin encloses at least once, by rays along x every `step` metres."""
    low = vertices.min(0)
    high = vertices.max(0)
    start = low[1:] + step * np.array([0.4142, 0.7321])
    size = ((high[1:] - start) / step).astype(np.int64) + 2
    cells, where, sign = _crossings(vertices[faces], start, step, size)
    order = np.lexsort((where, cells))
    return _enclosed(cells[order], where[order], sign[order]) * step**2


@numba.njit
def _crossings(corners, start, step, size):
    """Of every ray (y, z) and triangle that meet: the ray's number, x, and +1 where it enters, -1
    where it leaves.
    """
    cells = []
    where = []
    sign = []
    for f in range(len(corners)):
        a = corners[f, 0]
        b = corners[f, 1]
        c = corners[f, 2]
        area = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
        if abs(area) < 1e-16:
            continue
        first = np.empty(2, np.int64)
        last = np.empty(2, np.int64)
        for k in range(2):
            low = min(a[k + 1], b[k + 1], c[k + 1])
            high = max(a[k + 1], b[k + 1], c[k + 1])
            first[k] = max(0, int(np.ceil((low - start[k]) / step)))
            last[k] = min(size[k] - 1, int(np.floor((high - start[k]) / step)))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                y = start[0] + i * step
                z = start[1] + j * step
                u = ((y - a[1]) * (c[2] - a[2]) - (z - a[2]) * (c[1] - a[1])) / area
                v = ((b[1] - a[1]) * (z - a[2]) - (b[2] - a[2]) * (y - a[1])) / area
                if u >= 0 and v >= 0 and u + v <= 1:
                    cells.append(i * size[1] + j)
                    where.append(a[0] + u * (b[0] - a[0]) + v * (c[0] - a[0]))
                    sign.append(-1 if area > 0 else 1)
    return np.array(cells), np.array(where), np.array(sign)


@numba.njit
def _enclosed(cells, where, sign):
    total = 0.0
    depth = 0
    for k in range(len(cells)):
        if k and cells[k] != cells[k - 1]:
            depth = 0
        elif k and depth > 0:
            total += where[k] - where[k - 1]
        depth += sign[k]
    return total


def table(found: dict[str, dict]) -> str:
    """Lines of Markdown: a pose a line, the mean person and the worst of all."""
    lines = [
        "| pose | volume, L (%) | worst | union lost, % | worst | pairs | worst |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in POSES:
        rows = [person[name] for person in found.values()]
        mean = found["mean"][name]
        far = max((row["percent"] for row in rows), key=abs)
        lost = max(row["lost"] for row in rows)
        pairs = max(row["pairs"] for row in rows)
        lines.append(
            f"| {name} | {mean['litres']:+.2f} ({mean['percent']:+.2f}) | {far:+.2f} % "
            f"| {mean['lost']:.2f} | {lost:.2f} | {mean['pairs']} | {pairs} |"
        )
    for joint in ("left_wrist", "left_shoulder"):
        all_of = [person["girths"][joint] for person in found.values()]
        lines.append(
            f"girth at {joint} twisted by 90: {found['mean']['girths'][joint]:.1f} %, least "
            f"{min(all_of):.1f}"
        )
    return "\n".join(lines)


def main() -> None:
    """Judge, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bodies", nargs="*", default=["female", "male", "neutral"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    numbers = {}
    for name in options.bodies:
        numbers[name] = judge(load_body(name, detail="full", joints="smplx"))
        print(f"{name}\n{table(numbers[name])}\n", flush=True)
    if options.out:
        options.out.write_text(json.dumps(numbers, indent=1))


if __name__ == "__main__":
    main()
