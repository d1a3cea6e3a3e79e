"""Simulate flesh in motion: what dynamic blend shapes are learned from.

    python tools/default_body/flesh/shake.py --out FOLDER --motions FIT/body.npz ... [--threads N | --cluster ADDRESS]

A soft, an average and a muscular person of each sex go through every piece of the motions (a stout, a middling and a
lean one of the people that `run.py` poses, with other stiffness). Files FOLDER/<person>/<piece>.npz, written whole or
not at all: start the command again to go on. A file has vertices (T, V, 3) of the full mesh in the world, faces, poses,
trans, betas, rate, the person's rest, and `least`: the least J in each frame.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if __package__ in (None, ""):
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from default_body.flesh.motions import RATE, SETTLE, Piece, pieces
from default_body.flesh.people import Shape, people
from default_body.flesh.person import Person, make_person
from default_body.flesh.studio import open_studio
from habitus import load_body
from habitus.errors import HabitusError
from habitus.io.files import atomic_write
from habitus.parallel.choose import open_workers
from habitus.population.flesh.assembly_kernels import determinants
from habitus.population.flesh.dynamics import Matter, Swing, swing

SEXES = ("female", "male")
MATTER = {  # shear modulus (Pa): relaxed fat and muscle lie about 2 to 10 kPa, tense muscle above; a choice
    "soft": Matter(shear=8e3),
    "average": Matter(shear=15e3),
    "muscular": Matter(shear=30e3, damping=0.008),
}
RANK = {"soft": 0.95, "average": 0.5, "muscular": 0.15}  # share of people who are leaner


@dataclass(frozen=True, eq=False)
class Shake:
    """One file to be made."""

    folder: Path
    sex: str
    build: str
    shape: Shape
    piece: Piece

    @property
    def path(self) -> Path:
        """Where it lies."""
        return self.folder / f"{self.sex}_{self.build}" / f"{self.piece.name}.npz"


def shake(_: None, task: Shake) -> str:
    """Do a task unless its file is there; gives a line about it."""
    if task.path.exists():
        return f"{task.path}: there already"
    begin = time.thread_time()
    studio = open_studio(task.sex, task.folder)
    try:
        person = make_person(studio, *task.shape.rest(studio.body))
    except HabitusError as error:
        return f"{task.shape.name}: {error}"
    vertices, least = _moved(person, task.piece, MATTER[task.build])
    task.path.parent.mkdir(parents=True, exist_ok=True)
    kept = slice(SETTLE, SETTLE + len(vertices))
    with atomic_write(task.path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            vertices=vertices,
            faces=studio.body.faces,
            poses=task.piece.poses[kept],
            trans=task.piece.trans[kept],
            betas=task.shape.betas,
            rate=np.array(RATE),
            rest=person.rest.astype(np.float32),
            least=least,
        )
    each = (time.thread_time() - begin) / (len(vertices) + SETTLE)
    return (
        f"{task.sex} {task.build} {task.piece.name}: {len(vertices)} frames, {each:.2f} s each, J >= {least.min():.2f}"
    )


def _moved(person: Person, piece: Piece, matter: Matter) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, V, 3) of the frames that are kept, and the least J in each."""
    flesh, found, least = person.flesh, [], []
    det = np.empty(len(flesh.tets))
    for t, nodes in enumerate(swing(flesh, person, piece.poses, piece.trans, RATE, Swing(matter))):
        if t >= SETTLE:
            local = nodes - piece.trans[t]
            determinants(local, flesh.tets, flesh.inverse, det)
            least.append(det.min())
            found.append((person.surface(piece.poses[t], local) + piece.trans[t]).astype(np.float32))
    return np.stack(found), np.array(least)


def tasks(options: argparse.Namespace) -> list[Shake]:
    """All files; people in turn, so that what is done early is of everybody."""
    found = []
    for sex in SEXES:
        body = load_body(sex, detail="full", joints="smplx")
        some = people(body, sex, options.people, options.seed)
        lean = sorted((shape for shape in some[1:] if shape.age is None), key=lambda shape: shape.stoutness)
        for build, rank in RANK.items():
            shape = lean[round(rank * (len(lean) - 1))]
            for path in options.motions:
                found += [(k, Shake(options.out, sex, build, shape, one)) for k, one in enumerate(pieces(path, 55))]
    return [task for _, task in sorted(found, key=lambda row: row[0]) if not task.path.exists()]


def main() -> None:
    """Simulate what is missing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder with the cages that run.py meshed, and results")
    parser.add_argument("--motions", nargs="+", type=Path, required=True, help="fitted motions")
    parser.add_argument("--people", type=int, default=20, help="of each sex, of whom three are taken")
    parser.add_argument("--threads", type=int, help="all cores if left out")
    parser.add_argument("--cluster", help="address of a Dask scheduler, tcp://host:8786 say, which you trust")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    todo = tasks(options)
    print(f"{len(todo)} files to make", flush=True)
    with open_workers(options.threads if options.cluster is None else options.cluster) as workers:
        for line in workers.map(shake, None, todo):
            print(line, flush=True)


if __name__ == "__main__":
    main()
