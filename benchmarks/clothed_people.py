"""How near does `habitus register` come to the skin of people in clothes?

    python benchmarks/clothed_people.py [--scans 12] [--seed 1] [--clothes none loose] [--out FILE]

People of our own bodies, 4 mm of skin off them, in the outfits of `habitus_lab.population.clothed`
(T-shirt, jacket, shorts, trousers, skirt; 5 to 60 mm of ease), standing or stepping; scans of
40,000 points, seen by 12 cameras. Errors (mm) are distances of vertices from the skin, hands left
out; girths (cm) are those of the surface at rest less the skin's. Each scan is registered with every
one of ``--clothes``.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import time

import numpy as np
from common import parser, run, show_table
from foreign_people import SIDES

import habitus as hb
from habitus.fit.points.correspondences import hidden_vertices
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.verdict import PARTS, vertex_parts
from habitus.mesh.normals import vertex_normals
from habitus_lab.population.clothed import OUTFITS, clothed
from habitus_lab.population.scans import Scanner, scanned, stance
from habitus_lab.population.wide import is_bony

STANCES = ("A", "elbows bent", "step")
SKIN = 0.004
GIRTHS = ("chest_circumference_m", "waist_circumference_m", "hip_circumference_m")


def rows_of(k: int, options: argparse.Namespace) -> list[dict]:
    """Person k, scanned once and registered in each way."""
    rng = np.random.default_rng([options.seed, k])
    body = hb.load_body(("female", "male")[int(rng.integers(2))], detail="full")
    still = body.skinning_weights[:, [is_bony(name) for name in body.joint_names]].sum(1)
    off = SKIN * smooth_field(body.v_template, rng)[:, 0] * (1.0 - 0.75 * still)
    betas = np.clip(rng.normal(size=body.num_betas), -2.5, 2.5)
    pose = stance(STANCES[k % len(STANCES)], body.joint_names, rng)
    skin = np.asarray(body(betas, pose).vertices)
    skin = skin + off[:, None] * vertex_normals(skin, body.faces)
    rest = body.rest_vertices(betas)
    rest = rest + off[:, None] * vertex_normals(rest, body.faces)
    hidden = hidden_vertices(body)
    faces = body.faces if hidden is None else body.faces[~hidden[body.faces].all(1)]
    outfit = OUTFITS[k % len(OUTFITS)]
    person = clothed(body, skin, faces, outfit, rng)
    scan = scanned(
        person.vertices, person.faces, Scanner(40_000, holes=0.02, sides=SIDES), rng, str(k)
    )
    true_girths = body.measure_rest(rest)
    rows = []
    for clothes in options.clothes:
        began = time.process_time()
        (fit,) = hb.register_scans(scan, clothes=clothes)
        busy = time.process_time() - began
        true = (skin @ fit.to_body[:3, :3].T + fit.to_body[:3, 3])[fit.body.full_vertices]
        apart = 1e3 * np.linalg.norm(fit.vertices - true, axis=1)
        outwards = ((fit.vertices - true) * vertex_normals(true, fit.body.faces)).sum(1)
        covered = person.covered[fit.body.full_vertices] > 0.5
        counted = ~hidden_vertices(fit.body)
        counted &= vertex_parts(fit.body) != PARTS.index("hands")
        row = {
            "person": k,
            "outfit": " ".join(outfit),
            "clothes": clothes,
            "verdict": fit.verdict.level,
            "mean": float(apart[counted].mean()),
            "p95": float(np.percentile(apart[counted], 95)),
            "outwards under cloth": float(1e3 * outwards[counted & covered].mean()),
        }
        for name in GIRTHS:
            row[name.split("_")[0]] = 100.0 * (fit.measurements[name] - true_girths[name])
        row["height"] = 100.0 * (fit.measurements["height_m"] - true_girths["height_m"])
        rows.append(row | {"CPU seconds": busy, "reasons": list(fit.verdict.reasons)})
    return rows


def measure(options: argparse.Namespace) -> dict:
    """All people."""
    rows = [row for k in range(options.scans) for row in rows_of(k, options)]
    summary = {}
    for clothes in options.clothes:
        own = [row for row in rows if row["clothes"] == clothes]
        levels = [row["verdict"] for row in own]
        found: dict[str, float] = {"people": len(own)}
        for name in ("mean", "p95", "outwards under cloth", "CPU seconds"):
            found[name] = float(np.median([row[name] for row in own]))
        for name in ("chest", "waist", "hip", "height"):
            found[f"{name} rmse cm"] = float(np.sqrt(np.mean([row[name] ** 2 for row in own])))
            found[f"{name} bias cm"] = float(np.mean([row[name] for row in own]))
        summary[clothes] = found | {
            level: levels.count(level) for level in ("good", "doubtful", "failed")
        }
    return {"summary": summary, "rows": rows}


def show(found: dict) -> None:
    """Print the tables."""
    rows = [{k: v for k, v in row.items() if k != "reasons"} for row in found["rows"]]
    show_table("people in clothes, mm and cm", rows, 1)
    show_table("medians", [{"clothes": k, **v} for k, v in found["summary"].items()], 1)


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--scans", type=int, default=12)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--clothes", nargs="+", default=["none", "loose"])
    run(arguments, measure, show)
