"""Does a point of the skin keep its place from pose to pose, on people whom no body of ours made?

    python benchmarks/foreign_people.py FILE.obj ... [--poses 6] [--points 40000] [--out FILE]

Each file is a surface of a person in a topology of its own. It is registered once; its own vertices
are then tied to the surface found (triangle, barycentric coordinates) and carried into poses that
people are scanned in, as that surface bends. To every pose comes flesh of its own, 2 mm (sd) along the
normals, alike over some 8 cm, less on hands, feet and head. Each of these surfaces is scanned and
all of a person's scans are registered together, as `habitus register` does. A vertex of the file
lies somewhere on each registered surface; where it lies, on the template, should not change:
distances (mm) from its place in the first pose, by part of the body. ``truth`` is its distance from
where the first registration had it.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import time
from pathlib import Path

import igl
import numpy as np
from common import parser, run, show_table

import habitus as hb
from habitus.body.model import BodyModel
from habitus.fit.points.scan_result import ScanFit
from habitus.fit.selection.held_out import smooth_field
from habitus.io.scans import read_scan
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.scans import BONY, STANCES, Scanner, scanned, stance

FLESH = 0.002
"""Metres (sd) that a pose's flesh lies off the surface that our body would bend into."""
SIDES = tuple((np.sin(a), h, np.cos(a)) for a in np.arange(6) * np.pi / 3 for h in (-0.3, 0.6))
"""Where the scanner's cameras stand: nothing is seen within folds."""
PARTS = {
    "torso": ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "arms": ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow"),
    "legs": ("left_hip", "right_hip", "left_knee", "right_knee"),
    "head": ("neck", "head"),
    "hands": ("left_wrist", "right_wrist", "left_hand", "right_hand"),
    "feet": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
}


def located(
    points: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The triangle of the surface nearest to each point, and barycentric coordinates there."""
    _, triangle, nearest = igl.point_mesh_squared_distance(points, vertices, faces)
    corners = vertices[faces[triangle]]
    parts = (np.ascontiguousarray(corners[:, k]) for k in range(3))
    return triangle, igl.barycentric_coordinates(np.ascontiguousarray(nearest), *parts)


def at(surface: np.ndarray, faces: np.ndarray, place: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The points of a surface at triangles and barycentric coordinates."""
    triangle, weights = place
    return (surface[faces[triangle]] * weights[..., None]).sum(1)


def in_pose(fit: ScanFit, pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The registered surface (V, 3) in another pose, with flesh of its own."""
    body = fit.body
    rest = fit.rest_vertices.T.ravel()
    surface = np.asarray(body.prepare(fit.betas).moved(rest, pose, np.zeros(3)).vertices)
    bony = [k for k, name in enumerate(body.joint_names) if name.rpartition("_")[2] in BONY]
    off = smooth_field(body.v_template, rng)[:, 0]
    off *= 1.0 - 0.75 * np.asarray(body.skinning_weights)[:, bony].sum(1)
    return surface + FLESH * off[:, None] * vertex_normals(surface, body.faces)


def person_rows(path: Path, options: argparse.Namespace) -> list[dict]:
    """A row for each pose of one person after the first."""
    source = read_scan(path)
    (first,) = hb.register_scans(source)
    body = first.body
    faces = np.asarray(body.faces, np.int64)
    own = source.points @ first.to_body[:3, :3].T + first.to_body[:3, 3]
    tied = located(own, first.vertices, faces)
    rng = np.random.default_rng(options.seed)
    posed, scans = [], []
    for name in list(STANCES)[: options.poses]:
        surface = in_pose(first, stance(name, body.joint_names, rng), rng)
        foreign = at(surface, faces, tied)
        posed.append((name, foreign))
        scanner = Scanner(options.points, sides=SIDES)
        scans.append(scanned(foreign, source.faces, scanner, rng, name))
    began = time.perf_counter()
    fits = hb.register_scans(scans)
    seconds = (time.perf_counter() - began) / len(scans)
    template = body.rest_vertices(np.zeros(body.num_betas))
    parts = strongest(body)
    places = []
    for (_, foreign), fit in zip(posed, fits, strict=True):
        there = foreign @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
        places.append(located(there, fit.vertices, faces))
    rows = []
    for k, ((name, _), fit, place) in enumerate(zip(posed, fits, places, strict=True)):
        slid = 1e3 * np.linalg.norm(
            at(template, faces, place) - at(template, faces, places[0]), axis=1
        )
        off = 1e3 * np.linalg.norm(at(template, faces, place) - at(template, faces, tied), axis=1)
        group = parts[faces[tied[0]][:, 0]]
        row = {"person": path.stem, "pose": name, "verdict": fit.verdict.level}
        for part in PARTS:
            row[f"{part} mean"] = float(slid[group == part].mean()) if k else None
            row[f"{part} 95 %"] = float(np.percentile(slid[group == part], 95)) if k else None
        row |= {"truth mean": float(off.mean()), "truth 95 %": float(np.percentile(off, 95))}
        rows.append(row | {"seconds": seconds, "reasons": list(fit.verdict.reasons)})
    return rows


def strongest(body: BodyModel) -> np.ndarray:
    """The name among `PARTS` of each vertex, by its strongest joint: a finger is the hand's."""
    owner = {joint: part for part, joints in PARTS.items() for joint in joints}
    names: list[str] = []
    for name, parent in zip(body.joint_names, body.parents, strict=True):
        names.append(owner.get(name) or names[parent])
    return np.array(names)[np.asarray(body.skinning_weights).argmax(1)]


def measure(options: argparse.Namespace) -> dict:
    """All people."""
    rows = [row for path in options.files for row in person_rows(path, options)]
    moved = [row for row in rows if row["torso mean"] is not None]
    summary = {
        part: {
            "mean_mm": float(np.mean([row[f"{part} mean"] for row in moved])),
            "p95_mm": float(np.mean([row[f"{part} 95 %"] for row in moved])),
        }
        for part in PARTS
    }
    levels = [row["verdict"] for row in rows]
    verdicts = {level: levels.count(level) for level in ("good", "doubtful", "failed")}
    return {"summary": summary, "verdicts": verdicts, "rows": rows}


def show(found: dict) -> None:
    """Print the tables."""
    hidden = ("reasons",)
    show_table(
        "a skin point carried from pose to pose, mm",
        [{k: v for k, v in row.items() if k not in hidden} for row in found["rows"]],
        1,
    )
    show_table("by part, mm", [{"part": k, **v} for k, v in found["summary"].items()], 1)
    print("verdicts", found["verdicts"])


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("files", nargs="+", type=Path)
    arguments.add_argument("--poses", type=int, default=6, help="of the ten stances")
    arguments.add_argument("--points", type=int, default=40_000)
    arguments.add_argument("--seed", type=int, default=0)
    run(arguments, measure, show)
