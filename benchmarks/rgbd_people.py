"""How near does `habitus rgbd` come to people that no body model made, under the noise of real
sensors? (T 4.6.1)

    python benchmarks/rgbd_people.py --people people.npz --count 40 --out rgbd.json

Each person is seen in two views 45 degrees apart and fitted, nothing being told of pose, place,
turn and sex; the table holds surfaces, measurements beside "guess the mean" and the best body of
the person's sex ("registered scan"), convergence, time. --wide: people of
`habitus_lab.population.wide`, unlike the body's own. --women, --men: people about surfaces that
no body of ours made, varied along the neutral body's betas across the direction of sex, with skin
of their own as --wide has it. people.npz comes from
`lab/src/habitus_lab/default_body/new_people.py`; without it people are bodies of the model with 4 mm of smooth
skin off it, which is easier. --cases measures what is lost without colour, without the empty room,
with one view, with the neutral body and without the steps with colour, at a third of the
resolution, with forearms folded before the belly, and a start that is a metre and 30 degrees off in
place of ours; rows are kept in the file as they are made, so that a run that was stopped goes on.
"""

import argparse
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from common import in_words, machine, parser, write_json, written_rows
from scipy.optimize import lsq_linear

from habitus.body.model import BodyModel
from habitus.fit.offsets import along_normals
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_settings import RgbdSettings
from habitus.fit.points.depth_start import arm_poses
from habitus.fit.points.prepared_views import PreparedView, segment
from habitus.io.meshes import read_mesh
from habitus.io.models.bodies import load_body
from habitus.io.topologies import topology_of
from habitus.jobs.topologies import register_vertices
from habitus.mesh.normals import vertex_normals
from habitus.observe.camera import RgbdCapture
from habitus_lab.population.rgbd_people import Scene, planted_rest, rgbd_scene
from habitus_lab.population.wide import wide_betas, wide_offsets, wide_rest

MEASURES = {
    "height_m": 1.0,
    "waist_circumference_m": 1.2,
    "chest_circumference_m": 1.5,
    "hip_circumference_m": 1.5,
    "arm_length_m": 1.2,
}
"""What is reported, and the RMSE (cm) that is wanted."""
LOST = 0.05
"""Metres of mean vertex distance beyond which a fit has not come home."""
CASES = (
    "full",
    "no-colour",
    "no-background",
    "one-view",
    "depth-only",
    "neutral",
    "no-steps",
    "third",
    "folded",
    "far-start",
)


def main() -> None:
    """Fit everybody, print the table, write it."""
    options = _options()
    body = load_body("default")
    people = _people(body, options)
    foreign = [path.name for path in (*options.women, *options.men)]
    named = options.people.name if options.people else ("wide" if options.wide else "planted")
    named = " ".join(foreign) or named
    settings = {
        "people_file": named,
        "seed": options.seed,
    }
    rows = written_rows(options.out, "rows", **settings)
    done = {(row["person"], row["sensor"], row["case"]) for row in rows}
    info = machine()
    for k in range(options.count):
        for sensor in options.sensors:
            for case in options.cases:
                if (k, sensor, case) not in done:
                    rows.append(_row(body, people[k], k, sensor, case, options))
                    print(_line(rows[-1]), flush=True)
                    write_json_quietly(options.out, {**settings, "machine": info, "rows": rows})
    tables = {
        f"{sensor} {case}": _table(rows, sensor, case)
        for sensor in options.sensors
        for case in options.cases
    }
    for name, table in tables.items():
        print(f"\n{name}: {in_words(info)}")
        for what, value in table.items():
            print(f"  {what:28} {value}")
    write_json(options.out, {**settings, "machine": info, "rows": rows, "tables": tables})


def write_json_quietly(path: Path, content: dict[str, Any]) -> None:
    """The rows so far; nan, of what could not be measured, as null."""
    import json

    content = json.loads(json.dumps(content), parse_constant=lambda _: None)
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


@dataclass(frozen=True, eq=False)
class Person:
    """At rest without hair (m), whether a woman, and hair (m) if it is no flat cap."""

    rest: np.ndarray
    female: bool
    hair: np.ndarray | None = None


def _people(body: BodyModel, options: argparse.Namespace) -> list[Person]:
    """Everybody."""
    if options.people is not None:
        with np.load(options.people) as file:
            rests = file["vertices"][: options.count].astype(float)
            return [Person(*row) for row in zip(rests, map(bool, file["female"]), strict=False)]
    rngs = [np.random.default_rng([options.seed, k]) for k in range(options.count)]
    sexes = [_loaded(("female", "male")[k % 2]) for k in range(options.count)]
    if options.women or options.men:
        files = [*options.women, *options.men]
        bases = [registered_file(path) for path in files]
        own = [k % len(files) for k in range(options.count)]
        return [
            Person(foreign_rest(body, bases[j], rng), j < len(options.women))
            for j, rng in zip(own, rngs, strict=True)
        ]
    if options.wide:
        made = [wide_rest(each, rng) for each, rng in zip(sexes, rngs, strict=True)]
        return [Person(rest, k % 2 == 0, hair) for k, (rest, hair) in enumerate(made)]
    return [
        Person(planted_rest(each, rng), k % 2 == 0)
        for k, (each, rng) in enumerate(zip(sexes, rngs, strict=True))
    ]


def registered_file(path: Path) -> np.ndarray:
    """(V, 3) a mesh of SMPL's or MHR's topology on ours, at rest."""
    topology = topology_of(len(read_mesh(path)[0]))
    motion = register_vertices(path, topology, "neutral", own_surface=True).motion
    return np.asarray(motion.body.v_template)


def foreign_rest(body: BodyModel, base: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(V, 3) a random person about a surface at rest, of the same sex."""
    betas = wide_betas(body, rng)
    assert body.female_direction is not None
    direction = body.female_direction[0]
    betas -= direction * (direction @ betas) / (direction @ direction)
    rest = base + body.rest_vertices(betas) - body.v_template
    return rest + wide_offsets(body, rng)[0][:, None] * vertex_normals(rest, body.faces)


def _row(
    body: BodyModel,
    person: Person,
    k: int,
    sensor: str,
    case: str,
    options: argparse.Namespace,
) -> dict[str, Any]:
    rest, female = person.rest, person.female
    rng = np.random.default_rng([options.seed, k, 17])
    arms = (45.0, 45.0, 10.0)[k % 3]
    more: dict[str, Any] = {"folded": {"arms": 68.0, "folded": True}, "third": {"scale": 1 / 3}}
    stance = {"arms": arms} | more.get(case, {})
    scene = rgbd_scene(body, rest, rng, sensor=sensor, hair=person.hair, **stance)
    capture, kept = _as_case(scene, case)
    bodies = (
        body
        if case == "neutral"
        else {name: _loaded(name) for name in ("neutral", "female", "male")}
    )
    settings = RgbdSettings(colour_levels=()) if case == "no-steps" else RgbdSettings()
    start = _far(body, scene, rng) if case == "far-start" else None
    began = time.perf_counter()
    worked = time.process_time()
    fit = fit_views(capture, bodies, settings, start=start)
    seconds = time.perf_counter() - began
    cpu = time.process_time() - worked
    surfaces = fit.vertices()
    found = []
    for place, (sight, surface) in enumerate(zip(fit.prepared_views, surfaces, strict=True)):
        true = scene.surfaces[kept[place]] @ sight.turn.T + sight.shift
        found.append(float(np.linalg.norm(surface - true, axis=1).mean()))
    best = registered(body if case == "neutral" else _loaded("female" if female else "male"), rest)
    betas = fit.body.rest_vertices(fit.betas)
    assert fit.skin is not None
    skin = along_normals(betas, fit.skin, fit.body)
    measured, by_betas, true, ideal = (
        _measures(fit.body, one) for one in (skin, betas, rest, best)
    )
    return {
        "person": k,
        "female": female,
        "body": fit.body_name,
        "body_costs": dict(fit.body_costs),
        "sensor": sensor,
        "case": case,
        "vertex_mm": [1e3 * value for value in found],
        "measured": measured,
        "measured_betas": by_betas,
        "true": true,
        "registered": ideal,
        "verdict": fit.verdict.level,
        "reasons": list(fit.verdict.reasons),
        "seconds": seconds,
        "cpu_seconds": cpu,
        "stage_seconds": {name: float(value) for name, value in fit.stage_seconds.items()},
        "views": [{**vars(view), "ends": dict(view.ends)} for view in fit.evidence.views],
        "betas_max": fit.evidence.beta_max,
    }


@cache
def _loaded(name: str) -> BodyModel:
    return load_body(name)


def _far(body: BodyModel, scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """An A-pose 30 degrees off the truth of each view; where it stands is not told: the mask says
    it.
    """
    poses = []
    for view, surface in zip(scene.capture.views, scene.surfaces, strict=True):
        sight = PreparedView.of(view, segment(view))
        pose = next(arm_poses(body, ((45.0, 0.0, 0.0),)))
        way = _turn(body.rest_vertices(body.people_mean), surface @ sight.turn.T + sight.shift)
        pose[0] = [0.0, way + np.deg2rad(30.0) * rng.choice([-1.0, 1.0]), 0.0]
        poses.append(pose)
    return np.stack(poses)


def _turn(stands: np.ndarray, true: np.ndarray) -> float:
    """The turn about the upright that takes one surface nearest to another."""
    a, b = (points - points.mean(0) for points in (stands, true))
    return float(
        np.arctan2(
            (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum(),
            (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]).sum(),
        )
    )


def _as_case(scene: Scene, case: str) -> tuple[RgbdCapture, list[int]]:
    """The capture of a case, and which views it has."""
    capture = scene.capture
    kept = list(range(len(capture.views)))
    if case == "one-view":
        return replace(capture, views=capture.views[:1]), kept[:1]
    without = {
        "no-colour": ("colour",),
        "no-background": ("background",),
        "depth-only": ("colour", "background"),
    }
    return capture.without(*without.get(case, ())), kept


def registered(body: BodyModel, rest: np.ndarray) -> np.ndarray:
    """The body of the model nearest to a person at rest: what a perfect scan, perfectly registered,
    would give.
    """
    basis = body.shapedirs.reshape(-1, body.num_betas)
    offset = (rest - body.v_template).reshape(-1)
    shift = np.tile(np.eye(3), (len(rest), 1))
    found = lsq_linear(np.column_stack([basis, shift]), offset).x
    return body.rest_vertices(found[: body.num_betas])


def _measures(body: BodyModel, rest: np.ndarray) -> dict[str, float]:
    found = body.measure_rest(rest)
    arm = found["upper_arm_length_m"] + found["forearm_length_m"] + found["hand_length_m"]
    return {name: float(found.get(name, arm)) for name in MEASURES}


def _table(rows: list[dict[str, Any]], sensor: str, case: str) -> dict[str, Any]:
    """Numbers of one sensor and case."""
    some = [row for row in rows if row["sensor"] == sensor and row["case"] == case]
    if not some:
        return {}
    vertex = np.array([np.mean(row["vertex_mm"]) for row in some])
    table: dict[str, Any] = {
        "people": len(some),
        "vertex_mm median, p90, worst": [
            round(float(v), 1) for v in (*np.percentile(vertex, (50, 90)), vertex.max())
        ],
        "sex right, open, wrong": [
            sum(row["body"] == ("female" if row["female"] else "male") for row in some),
            sum(row["body"] == "neutral" for row in some),
            sum(row["body"] == ("male" if row["female"] else "female") for row in some),
        ],
        "came home": int((np.array([max(row["vertex_mm"]) for row in some]) < 1e3 * LOST).sum()),
        "verdicts": {
            level: sum(row["verdict"] == level for row in some)
            for level in ("good", "doubtful", "failed")
        },
        "seconds median, worst": [
            round(float(v), 1) for v in np.percentile([r["seconds"] for r in some], (50, 100))
        ],
        "cpu seconds median": round(float(np.median([row["cpu_seconds"] for row in some])), 1),
    }
    for name, wanted in MEASURES.items():
        kinds = ("measured", "true", "registered", "measured_betas")
        found, true, scan, betas = (np.array([r[what][name] for r in some]) for what in kinds)
        spread = true.std()
        table[f"{name.removesuffix('_m')} cm"] = {
            "rmse": round(float(100 * np.sqrt(np.mean((found - true) ** 2))), 2),
            "bias": round(float(100 * np.mean(found - true)), 2),
            "wanted": wanted,
            "betas alone": round(float(100 * np.sqrt(np.mean((betas - true) ** 2))), 2),
            "guess the mean": round(float(100 * spread), 2),
            "registered scan": round(float(100 * np.sqrt(np.mean((scan - true) ** 2))), 2),
            "explained %": round(
                float(100 * (1 - np.mean((found - true) ** 2) / max(spread**2, 1e-12))), 1
            ),
            "explained by scan %": round(
                float(100 * (1 - np.mean((scan - true) ** 2) / max(spread**2, 1e-12))), 1
            ),
        }
    return table


def _line(row: dict[str, Any]) -> str:
    off = {
        name.split("_")[0]: f"{100 * (row['measured'][name] - row['true'][name]):+.1f}"
        for name in MEASURES
    }
    vertex = "/".join(f"{value:.1f}" for value in row["vertex_mm"])
    return (
        f"{row['person']:3} {row['sensor']} {row['case']}: {vertex} mm, cm off {off}, "
        f"{row['verdict']}, " + (f"{row['seconds']:.1f} s ({row['cpu_seconds']:.1f} cpu)")
    )


def _options() -> argparse.Namespace:
    arguments = parser(__doc__, out=True)
    arguments.add_argument(
        "--people", type=Path, help="people.npz of lab/src/habitus_lab/default_body/new_people.py"
    )
    arguments.add_argument("--wide", action="store_true", help="people unlike the body's own")
    arguments.add_argument("--women", type=Path, nargs="+", default=[], help="meshes: see above")
    arguments.add_argument("--men", type=Path, nargs="+", default=[])
    arguments.add_argument("--count", type=int, default=40)
    arguments.add_argument("--sensors", nargs="+", default=["kinect-v1", "azure-kinect"])
    arguments.add_argument("--cases", nargs="+", choices=CASES, default=["full"])
    arguments.add_argument("--seed", type=int, default=0)
    return arguments.parse_args()


if __name__ == "__main__":
    main()
