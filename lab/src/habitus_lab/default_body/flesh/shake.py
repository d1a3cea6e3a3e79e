"""Simulate flesh in motion: what dynamic blend shapes are learned from.

    pip install pytetwild==0.2.3            # build-time only: meshes the two cages, once
    python -m habitus_lab.default_body.flesh.shake --out FOLDER --motions FIT/body.npz ... [--threads N | --cluster ADDRESS]

Six people of each sex, from soft to muscular (from stout to lean of the people that `run.py`
poses), go through every piece of the motions, every other one through its mirror image. Files
FOLDER/<person>/<piece>.npz, which `habitus train-dynamics` reads, are written whole or not at all:
start the command again to go on. Each has surfaces in motion (`vertices`) and at rest in the same
poses (`still_vertices`) of the skin that is simulated (`vertex_ids`), the motion and the person;
and of each frame the least J of a tetrahedron (`least`) and how far the flesh is from rest
(`farthest`, m).
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.errors import HabitusError
from habitus.files import atomic_write
from habitus.parallel.workers import open_workers
from habitus_lab.default_body.flesh.meshing import COARSE
from habitus_lab.default_body.flesh.motions import RATE, SETTLE, Piece, pieces
from habitus_lab.default_body.flesh.people import Shape, people
from habitus_lab.default_body.flesh.person import Person, make_person
from habitus_lab.default_body.flesh.studio import open_studio
from habitus_lab.population.flesh.assembly_kernels import determinants
from habitus_lab.population.flesh.dynamics import Matter, Swing, at_rest, stills, swing

SEXES = ("female", "male")
RANKS = {
    "soft": 0.95,
    "average": 0.5,
    "muscular": 0.1,
    "plump": 0.8,
    "trim": 0.65,
    "firm": 0.3,
}  # share who are leaner
BLOCK = 3  # people of each sex that are finished before the next
SOFTEST = 4e3
FIRMEST = 16e3  # Pa, shear modulus of the stoutest and of the leanest; see docs/dynamics.md
FELT = 0.2
# m: longest edge of the skin that feels contact (it is not refined); a third of it looks for it
EVERY = 3


@dataclass(frozen=True, eq=False)
class Shake:
    """One file to be made."""

    folder: Path
    sex: str
    build: str
    shape: Shape
    piece: Piece

    @property
    def person(self) -> str:
        """Who moves."""
        return f"{self.sex}_{self.build}"

    @property
    def path(self) -> Path:
        """Where it lies."""
        return self.folder / self.person / f"{self.piece.name}.npz"


def matter(build: str) -> Matter:
    """The flesh of a build: the leaner, the firmer, in even steps of the modulus' logarithm."""
    share = (RANKS["soft"] - RANKS[build]) / (RANKS["soft"] - RANKS["muscular"])
    return Matter(shear=SOFTEST * (FIRMEST / SOFTEST) ** share)


def shake(_: None, task: Shake) -> str:
    """Do a task unless its file is there; gives a line about it."""
    if task.path.exists():
        return f"{task.path}: there already"
    begin = time.thread_time()
    try:
        person = _person(task.folder, task.sex, task.shape)
    except HabitusError as error:
        return f"{task.shape.name}: {error}"
    found = _moved(person, task.piece, Swing(matter(task.build)))
    frames = len(found["vertices"])
    own = slice(SETTLE, SETTLE + frames)
    words = {"subject": [task.person] * frames, "sex": [task.sex] * frames}
    words["name"] = [f"{task.person}-{task.piece.name}:{t}" for t in range(frames)]
    ids = np.flatnonzero(person.moving)
    found |= {key: np.array(value) for key, value in words.items()}
    found |= {
        "pose": task.piece.poses[own],
        "trans": task.piece.trans[own],
        "betas": task.shape.betas,
    }
    found |= {
        "rate_hz": np.array(RATE),
        "vertex_ids": ids,
        "faces": _faces(person.studio.faces, ids),
    }
    task.path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(task.path) as temporary, temporary.open("wb") as file:
        np.savez(file, **found)
    each = (time.thread_time() - begin) / (frames + SETTLE)
    return (
        f"{task.person} {task.piece.name}: {frames} frames, {each:.3f} s each, J >= "
        f"{found['least'].min():.2f}, "
        f"{1e3 * found['farthest'].max():.0f} mm"
    )


@lru_cache(maxsize=len(RANKS))
def _person(folder: Path, sex: str, shape: Shape) -> Person:
    studio = open_studio(sex, folder, COARSE)
    return make_person(studio, *shape.rest(studio.body), FELT, EVERY)


def _moved(person: Person, piece: Piece, way: Swing) -> dict[str, np.ndarray]:
    """Of the frames that are kept: vertices (T, V, 3) in motion and at rest, the least J and the
    longest way.
    """
    flesh = person.flesh
    smooth = person.smooth[person.moving]
    start = at_rest(flesh, person, piece.poses[0], way)
    moving = swing(flesh, person, piece.poses, piece.trans, RATE, way, start)
    resting = stills(flesh, person, piece.poses, way, start)
    found: dict[str, list] = {"vertices": [], "still_vertices": [], "least": [], "farthest": []}
    det = np.empty(len(flesh.tets))
    for t, (nodes, still) in enumerate(zip(moving, resting, strict=True)):
        if t < SETTLE:
            continue
        determinants(nodes, flesh.tets, flesh.inverse, det)
        here = smooth @ nodes
        rest = smooth @ still
        found["vertices"].append((here + piece.trans[t]).astype(np.float32))
        found["still_vertices"].append((rest + piece.trans[t]).astype(np.float32))
        found["least"].append(det.min())
        found["farthest"].append(np.linalg.norm(here - rest, axis=1).max())
    return {key: np.array(values) for key, values in found.items()}


def _faces(faces: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Those between the vertices, numbered as these are."""
    place = np.full(faces.max() + 1, -1)
    place[ids] = np.arange(len(ids))
    found = place[faces]
    return found[(found >= 0).all(1)]


def tasks(options: argparse.Namespace) -> list[Shake]:
    """All files; lively pieces first, people in turn, so that what is done early is of
    everybody.
    """
    found = []
    for sex in options.sexes:
        body = load_body(sex, detail="full", joints="smplx")
        some = people(body, sex, options.people, options.seed)
        lean = sorted(
            (shape for shape in some[1:] if shape.age is None), key=lambda shape: shape.stoutness
        )
        for n, (build, rank) in enumerate(RANKS.items()):
            shape = lean[round(rank * (len(lean) - 1))]
            parts = [
                one
                for path in options.motions
                for one in pieces(path, body.joint_names, n % 2 == 1)
            ]
            parts.sort(key=lambda one: -one.vigour)
            found += [
                (n // BLOCK, k, Shake(options.out, sex, build, shape, one))
                for k, one in enumerate(parts)
            ]
    return [task for *_, task in sorted(found, key=lambda row: row[:2]) if not task.path.exists()]


def main() -> None:
    """Simulate what is missing."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of cages and results; not that of run.py"
    )
    parser.add_argument("--motions", nargs="+", type=Path, required=True, help="fitted motions")
    parser.add_argument("--sexes", nargs="+", choices=SEXES, default=SEXES)
    parser.add_argument("--people", type=int, default=20, help="of each sex, of whom six are taken")
    parser.add_argument("--threads", type=int, help="all cores if left out")
    parser.add_argument(
        "--cluster", help="address of a Dask scheduler, tcp://host:8786 say, which you trust"
    )
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for sex in options.sexes:
        open_studio(sex, options.out, COARSE)
    todo = tasks(options)
    print(f"{len(todo)} files to make", flush=True)
    with open_workers(options.threads if options.cluster is None else options.cluster) as workers:
        for line in workers.map(shake, None, todo):
            print(line, flush=True)


if __name__ == "__main__":
    main()
