"""How near does `habitus register` come to the truth on people who are unlike the body's own?

    python benchmarks/wide_people.py [--scans 60] [--seed 1] [--rows FILE.jsonl] [--out FILE]
                                     [--motions BODY.npz ...]

People of `habitus_lab.population.wide`: shapes of 100 betas, 1.5 times as wide as the survey's with
heavy tails, 3 to 10 mm of skin that no model knows, hair, fists and grips, hands on hips, folded, at the head.
Scans have 2,500 to 200,000 points of .5 mm noise, seen by 12 cameras, holes in 5 %. Errors (mm)
are distances of vertices from where they truly are; ``seen`` counts those of which the scan tells.
``--rows``: a file of one line a person, written as people are measured; those in it are not measured
again. ``--motions``: in poses of these motions (files of `habitus mosh`) instead of the stances of the lab: of
each file those of all upright moments that differ most. ``turned``: an upper arm, forearm, thigh or shank that is turned about its own axis by more than 60
degrees.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import zip_longest
from pathlib import Path

import numpy as np
from common import parser, run, show_table

import habitus as hb
from habitus.body.model import BodyModel
from habitus.fit.points.correspondences import hidden_vertices
from habitus.fit.points.scans import Registrar
from habitus.fit.verdict import PARTS, vertex_parts
from habitus.io.models.bodies import SHIPPED_BETAS
from habitus.jobs.register import made_ready
from habitus.kernels.threads import one_blas_thread
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation
from habitus_lab.population.scans import Scanner, scanned
from habitus_lab.population.wide import WIDE_STANCES, wide_person

SIDES = tuple((np.sin(a), h, np.cos(a)) for a in np.arange(6) * np.pi / 3 for h in (-0.3, 0.6))
POINTS = (2_500, 200_000)
RIGHT = {"mean": 3.0, "p95": 7.0}
"""Millimetres: a right registration of the body (without hands)."""
POSED = 20.0
"""Millimetres, mean: with a larger error a limb is elsewhere."""
LIMBS = {
    f"{side}_{upper}": f"{side}_{lower}"
    for side in ("left", "right")
    for upper, lower in (
        ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"),
    )
}  # fmt: skip
TURNED = 60.0
UPRIGHT = 0.5
"""Cosine between a trunk and upwards from which on somebody stands or crouches upright."""
MOMENTS = 0.1
"""Seconds between poses of a motion."""

Pose = Mapping[str, tuple[float, float, float]]


@cache
def registrar() -> Registrar:
    """The default body, made ready."""
    return made_ready()


@cache
def people_of(sex: str) -> BodyModel:
    """The body that people are drawn from, in all its betas."""
    return hb.load_body(sex, detail="full", joints="smplh", num_betas=SHIPPED_BETAS)


@cache
def poses_of(motions: tuple[Path, ...], count: int) -> list[tuple[str, Pose]]:
    """Poses (name; joint to rotation vector, rad) of motions in turn, of each the most different:
    always the one furthest from those before, by its joints seen from the trunk.
    """
    chosen = []
    for path in motions:
        motion = hb.load_motion(path)
        step = max(1, round(MOMENTS * motion.rate_hz))
        turn = up_rotation(motion.up_axis) @ matrix_from_rotvec(motion.pose[::step, 0])
        upright = turn[:, 1, 1] > UPRIGHT
        if not upright.any():
            continue
        joints = motion.joints(slice(None, None, step))[upright]
        poses = motion.pose[::step][upright].copy()
        poses[:, 0] = rotvec_from_matrix(turn[upright])
        seen = (joints - joints[:, :1]) @ matrix_from_rotvec(motion.pose[::step, 0][upright])
        seen = seen.reshape(len(seen), -1)
        order = [int(np.square(seen - seen.mean(0)).sum(1).argmin())]
        distance = np.full(len(seen), np.inf)
        while len(order) < min(-(-count // len(motions)), len(seen)):
            distance = np.minimum(distance, np.square(seen - seen[order[-1]]).sum(1))
            order.append(int(distance.argmax()))
        names = motion.body.joint_names
        chosen.append(
            [
                (f"{motion.capture_name} {np.flatnonzero(upright)[k] * step}",
                 {name: tuple(turn) for name, turn in zip(names, poses[k], strict=True)})
                for k in order
            ]
        )  # fmt: skip
    return [pose for each in zip_longest(*chosen) for pose in each if pose is not None][:count]


def row_of(k: int, seed: int, poses: Sequence[tuple[str, Pose]] = ()) -> dict:
    """Person k, scanned and registered; in one of some poses, or of the lab's stances."""
    rng = np.random.default_rng([seed, k])
    source = people_of(str(rng.choice(["female", "male"])))
    names = list(WIDE_STANCES)
    stance, angles = poses[k % len(poses)] if poses else (names[k % len(names)], None)
    person = wide_person(source, stance, rng, angles)
    hidden = hidden_vertices(source)
    faces = source.faces if hidden is None else source.faces[~hidden[source.faces].all(1)]
    points = int(np.exp(rng.uniform(*np.log(POINTS))))
    scan = scanned(person.vertices, faces, Scanner(points, holes=0.05, sides=SIDES), rng, str(k))
    began, busy = time.perf_counter(), time.process_time()
    with one_blas_thread():
        (fit,) = registrar().register([scan])
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    true = person.vertices @ fit.to_body[:3, :3].T + fit.to_body[:3, 3]
    body = fit.body
    true = true[body.full_vertices]
    apart = 1e3 * np.linalg.norm(fit.vertices - true, axis=1)
    seen = ~hidden_vertices(body)
    hands = vertex_parts(body) == PARTS.index("hands")
    left = np.array([name.startswith("left_") for name in body.joint_names])[body.strongest_joint]
    row = {
        "seed": seed,
        "person": k,
        "stance": person.stance,
        "hands": " ".join(person.hands),
        "points": points,
        "verdict": fit.verdict.level,
        "mean": float(apart[seen & ~hands].mean()),
        "p95": float(np.percentile(apart[seen & ~hands], 95)),
        "left hand": float(apart[seen & hands & left].mean()),
        "right hand": float(apart[seen & hands & ~left].mean()),
        "turned": sorted(turned(body, true, fit.vertices)),
        "seconds": seconds,
        "CPU seconds": busy,
    }
    return row | {"reasons": list(fit.verdict.reasons)}


def turned(body: BodyModel, true: np.ndarray, found: np.ndarray) -> set[str]:
    """Limbs whose skin is turned about their own axis."""
    owner = np.asarray(body.skinning_weights).argmax(1)
    far = set()
    for upper in LIMBS:
        rows = owner == body.joint_names.index(upper)
        one, other = (each[rows] - each[rows].mean(0) for each in (true, found))
        u, _, v = np.linalg.svd(one.T @ other)
        turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
        if angle > TURNED:
            far.add(upper)
    return far


def row_kept(k: int, seed: int, path: Path | None, poses: Sequence[tuple[str, Pose]] = ()) -> dict:
    """Person k's row from a file, or measured and added to it."""
    if path is not None and path.exists():
        for line in path.read_text().splitlines():
            row = json.loads(line)
            if (row["seed"], row["person"]) == (seed, k):
                return row
    row = row_of(k, seed, poses)
    if path is not None:
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")
    return row


def measure(options: argparse.Namespace) -> dict:
    """All people."""
    poses = poses_of(tuple(options.motions), options.scans) if options.motions else ()
    rows = [row_kept(k, options.seed, options.rows, poses) for k in range(options.scans)]
    right = [all(row[name] <= most for name, most in RIGHT.items()) for row in rows]
    good = [row["verdict"] == "good" for row in rows]
    hands = np.array([row[f"{side} hand"] for row in rows for side in ("left", "right")])
    summary = {
        "people": len(rows),
        "right": sum(right),
        "good of the right": sum(g for g, r in zip(good, right, strict=True) if r),
        "good of the wrong": sum(g for g, r in zip(good, right, strict=True) if not r),
        "failed of the right": sum(
            row["verdict"] == "failed" for row, r in zip(rows, right, strict=True) if r
        ),
        "poses found": sum(row["mean"] < POSED for row in rows),
        "turned limbs": sum(len(row["turned"]) for row in rows),
        "mean mm, median of people": float(np.median([row["mean"] for row in rows])),
        "p95 mm, median of people": float(np.median([row["p95"] for row in rows])),
        "hands within 8 mm": float((hands <= 8.0).mean()),
        "hands mm, median": float(np.median(hands)),
        "seconds, median": float(np.median([row["seconds"] for row in rows])),
        "CPU seconds, median": float(np.median([row["CPU seconds"] for row in rows])),
    }
    return {"summary": summary, "rows": rows}


def show(found: dict) -> None:
    """Print the tables."""
    rows = [{k: v for k, v in row.items() if k not in ("reasons", "seed")} for row in found["rows"]]
    show_table("people unlike the body's own, mm", rows, 1)
    show_table("summary", [found["summary"]], 2)


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--scans", type=int, default=60)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--rows", type=Path)
    arguments.add_argument("--motions", type=Path, nargs="+", default=())
    run(arguments, measure, show)
