"""How much is lost between our body and SMPL's, SMPL-X's and MHR's topologies?

    python benchmarks/topologies.py --meshes FOLDER --mhr mhr_face_mask.ply [--people 6] [--out FILE]

FOLDER: human_man.obj, human_woman.obj (SMPL's mean bodies) and human_neutral.obj (SMPL-X's) of
github odedstein/meshes, CC BY 4.0; mhr_face_mask.ply is MHR's rest mesh (Apache-2.0).

- meshes: each is solved on the neutral body by its map and written in its topology again: distance of all
  of its vertices from where they were, mm, mean and 95 %, and the map's matched ones alone. First
  in the shape space (betas), then with the person's own rest surface.
- planted: a made model of SMPL's form (tests/helpers/planted_model.py: the female body's arrays on
  the map, 10 betas) with random betas and poses. Its vertices go to our body (the neutral one),
  whose surface goes to `--model`. Pose: angle between each joint's rotation and the planted one,
  degrees; vertices: mm from the planted ones; floor: the same where the model is solved for its own
  vertices, without our body between.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import parser, run, show_table

from habitus.body.model import BodyModel
from habitus.body.motion import BodyMotion
from habitus.body.prior import shipped_prior
from habitus.export.topology import topology_vertices
from habitus.fit.known_points import fit_known_points
from habitus.io.models.bodies import load_body, save_body
from habitus.io.topologies import load_topology, read_vertices
from habitus.jobs.topologies import points_of, register_vertices, solve_model
from habitus.observe.simulated_markers import smooth_motion
from habitus.rotations import matrix_from_rotvec, rotvec_from_matrix, up_rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from planted_model import planted_model

MESHES = {
    "SMPL's mean man": ("human_man.obj", "smpl"),
    "SMPL's mean woman": ("human_woman.obj", "smpl"),
    "SMPL-X's neutral person": ("human_neutral.obj", "smplx"),
}
FRAMES = 4


def off(vertices: np.ndarray, others: np.ndarray) -> dict[str, float]:
    """Mean and 95th percentile of distances (mm)."""
    distance = 1e3 * np.linalg.norm(vertices - others, axis=-1)
    return {"mean": float(distance.mean()), "p95": float(np.percentile(distance, 95))}


def mesh_row(name: str, path: Path, topology: str, own: bool) -> dict:
    """One mesh to our body and back."""
    made = register_vertices(path, topology, "neutral", own_surface=own)
    places = load_topology(topology, made.motion.finest_body)
    given = read_vertices(path, places.num_vertices).vertices
    back = topology_vertices(made.motion, places, np.arange(1))
    matched = places.matched
    return {
        "mesh": name,
        "surface": "own" if own else "betas",
        "body": made.motion.body_name,
        "all": off(back, given),
        "matched": off(back[:, matched], given[:, matched]),
    }


def turns(pose: np.ndarray, planted: np.ndarray) -> np.ndarray:
    """Angles (degrees) between rotations (T, J, 3)."""
    between = np.swapaxes(matrix_from_rotvec(planted), -1, -2) @ matrix_from_rotvec(pose)
    return np.degrees(np.linalg.norm(rotvec_from_matrix(between), axis=-1))


def planted_row(model: BodyModel, topology: str, seed: int, own: bool, folder: Path) -> dict:
    """A planted person through our body and back into the model, read from its file."""
    rng = np.random.default_rng(seed)
    prior = shipped_prior().for_joints(model.joint_names)
    spread = np.sqrt(np.diag(prior.covariance))
    pose, trans = smooth_motion(prior.mean, spread, FRAMES, 4.0, rng)
    betas = np.clip(rng.normal(size=model.num_betas), -2, 2)
    vertices = np.asarray(model(np.tile(betas, (FRAMES, 1)), pose, trans).vertices)
    file = folder / f"{topology}.npz"
    np.savez(file, vertices=vertices, rate_hz=np.array(30.0), up_axis=np.array("+y"))
    began = time.perf_counter()
    ours = register_vertices(file, topology, "neutral", own_surface=own)
    registered = time.perf_counter()
    solved = solve_model(ours.motion, folder / f"{model.name}.npz", betas=model.num_betas)
    seconds = registered - began, time.perf_counter() - registered
    places = load_topology(topology, ours.motion.finest_body)
    kept = np.flatnonzero(places.matched)
    face, share = points_of(model, kept)
    floor = fit_known_points(model, face, share, vertices[:, kept])
    names = np.array(model.joint_names)
    hands = np.char.isnumeric(np.array([name[-1] for name in names]))
    hands &= np.char.find(names, "spine") < 0
    eyes = np.char.find(names, "eye") >= 0
    angle = turns(_in_y(solved.motion), pose)
    at_y = _posed(model, solved.motion)
    return {
        "topology": topology,
        "seed": seed,
        "surface": "own" if own else "betas",
        "ours_mm": ours.error_mm,
        "reported_mm": solved.error_mm,
        "vertices": off(at_y[:, kept], vertices[:, kept]),
        "floor": off(
            np.asarray(model(np.tile(floor.betas, (FRAMES, 1)), floor.pose, floor.trans).vertices)[
                :, kept
            ],
            vertices[:, kept],
        ),
        "floor_pose": float(turns(floor.pose, pose)[:, ~hands & ~eyes].mean()),
        "body_joints": float(angle[:, ~hands & ~eyes].mean()),
        "body_joints_p95": float(np.percentile(angle[:, ~hands & ~eyes], 95)),
        "fingers": float(angle[:, hands].mean()),
        "betas": float(np.abs(solved.motion.betas - betas).mean()),
        "seconds": [each / FRAMES for each in seconds],
    }


def _in_y(motion: BodyMotion) -> np.ndarray:
    """The pose in the world with +y up, from one with +z up."""
    turn = up_rotation("+z")
    pose = motion.pose.copy()
    pose[:, 0] = rotvec_from_matrix(turn @ matrix_from_rotvec(pose[:, 0]))
    return pose


def _posed(model: BodyModel, motion: BodyMotion) -> np.ndarray:
    """The vertices (m) of a motion, +y up."""
    betas = np.tile(motion.betas, (motion.num_frames, 1))
    vertices = np.asarray(model(betas, motion.pose, motion.trans).vertices)
    return vertices @ up_rotation("+z").T


def measure(options) -> dict:
    """All rows."""
    meshes = [(name, options.meshes / file, topology) for name, (file, topology) in MESHES.items()]
    meshes.append(("MHR's rest mesh", options.mhr, "mhr"))
    rows = [mesh_row(*mesh, own) for mesh in meshes for own in (False, True)]
    planted = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for topology in ("smpl", "smplx"):
            model = planted_model(topology)
            save_body(model, folder / f"{model.name}.npz")
            model = load_body(folder / f"{model.name}.npz", num_betas=model.num_betas)
            planted += [
                planted_row(model, topology, seed, own, folder)
                for seed in range(options.people)
                for own in (False, True)
            ]
    return {"meshes": rows, "planted": planted}


def show(numbers: dict) -> None:
    """Two tables."""
    show_table(
        "A mesh to our body and back, mm",
        [
            {
                "mesh": row["mesh"],
                "surface": row["surface"],
                "body": row["body"],
                "all": row["all"]["mean"],
                "all 95 %": row["all"]["p95"],
                "matched": row["matched"]["mean"],
                "matched 95 %": row["matched"]["p95"],
            }
            for row in numbers["meshes"]
        ],
    )
    groups = [(topology, surface) for topology in ("smpl", "smplx") for surface in ("betas", "own")]
    show_table(
        "A planted model through our body: means over people",
        [
            _mean_row(
                topology,
                surface,
                [
                    row
                    for row in numbers["planted"]
                    if (row["topology"], row["surface"]) == (topology, surface)
                ],
            )
            for topology, surface in groups
        ],
    )


def _mean_row(topology: str, surface: str, rows: list[dict]) -> dict:
    means = {
        "vertices mm": [row["vertices"]["mean"] for row in rows],
        "95 %": [row["vertices"]["p95"] for row in rows],
        "floor mm": [row["floor"]["mean"] for row in rows],
        "reported mm": [row["reported_mm"]["mean"] for row in rows],
        "body joints °": [row["body_joints"] for row in rows],
        "joints 95 %": [row["body_joints_p95"] for row in rows],
        "fingers °": [row["fingers"] for row in rows],
        "betas": [row["betas"] for row in rows],
        "s/frame": [sum(row["seconds"]) for row in rows],
    }
    named = {key: float(np.mean(values)) for key, values in means.items()}
    return {"topology": topology, "surface": surface, "people": len(rows), **named}


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--meshes", type=Path, required=True)
    arguments.add_argument("--mhr", type=Path, required=True)
    arguments.add_argument("--people", type=int, default=6)
    run(arguments, measure, show)
