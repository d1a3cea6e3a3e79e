"""Simulate flesh: registrations of people in poses, from which pose blend shapes are learned.

    pip install pytetwild==0.2.3            # build-time only: meshes the two cages, once
    python -m habitus_lab.default_body.flesh.run --out FOLDER [--motions fit.npz ...] [--threads N | --cluster ADDRESS]

Every session of a person is a file FOLDER/<person>/<session>.npz, written whole or not at all:
start the command again to go on. `--gather FOLDER` writes what passes the gates as registrations
that `habitus train` reads, a folder a sex, each person with the mirror image, and prints the table.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from habitus import load_body
from habitus.parallel.workers import open_workers
from habitus_lab.default_body.flesh.gather import gather, table
from habitus_lab.default_body.flesh.people import FIRST_END, ends, people
from habitus_lab.default_body.flesh.poses import (
    ROUNDS,
    SEXES,
    Session,
    further_sessions,
    rounds_of_sessions,
    shrug_sessions,
)
from habitus_lab.default_body.flesh.simulate import Task, Workshop, simulate
from habitus_lab.default_body.flesh.studio import open_studio
from habitus_lab.population.poses import motion_poses

BLOCK = 6  # people of each sex that are finished before the next
TOGETHER = 3  # poses of real motions that one session holds


def tasks(options: argparse.Namespace) -> list[Task]:
    """All files: a block of people goes through every unit once, then again with real motions, then
    comes the next.

    One person of each sex in turn; the first ones are spread over all already.
    """
    found: list[tuple[int, int, int, Task]] = []
    for sex in options.sexes:
        body = load_body(sex, detail="full", joints="smplx")
        for k, shape in enumerate(people(body, sex, options.people, options.seed)):
            given = (options.seed, k, sex, body.joint_names)
            if options.shrugs:
                last = shrug_sessions(*given)
                found += [(k // BLOCK, 0, k, Task(sex, shape, one)) for one in last]
                continue
            rounds = [] if options.further else list(rounds_of_sessions(*given))
            for turn, all_of in enumerate([*rounds, further_sessions(*given)]):
                found += [(k // BLOCK, turn, k, Task(sex, shape, one)) for one in all_of]
            rng = np.random.default_rng([options.seed, k, SEXES.index(sex), ROUNDS])
            moments = _from_motions(options, rng, len(body.joint_names))
            found += [(k // BLOCK, 1, k, Task(sex, shape, one)) for one in moments]
        for k, shape in enumerate([] if options.shrugs else ends(body, sex), start=FIRST_END):
            last = further_sessions(options.seed, k, sex, body.joint_names)
            found += [(k // BLOCK, 1, k, Task(sex, shape, one)) for one in last]
    return [row[-1] for row in sorted(found, key=lambda row: row[:3])]


def _from_motions(
    options: argparse.Namespace, rng: np.random.Generator, joints: int
) -> list[Session]:
    if not options.motions:
        return []
    poses = motion_poses(options.motions, options.moments, joints)
    chosen = poses[rng.permutation(len(poses))[: options.moments_each]]
    return [
        Session(f"motion{k:02d}", part, tuple(f"motion{k:02d}_{n}" for n in range(len(part))))
        for k, part in enumerate(np.array_split(chosen, max(1, len(chosen) // TOGETHER)))
    ]


def main() -> None:
    """Simulate what is missing, or gather what is there."""
    options = _options()
    if options.gather is not None:
        print(table(gather(options.out, options.gather)))
        return
    for sex in options.sexes:
        open_studio(sex, options.out)
    todo = [task for task in tasks(options) if not task.path(options.out).exists()]
    print(f"{len(todo)} files to make", flush=True)
    with open_workers(options.threads if options.cluster is None else options.cluster) as workers:
        for line in workers.map(simulate, Workshop(options.out), todo):
            print(line, flush=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of cages and results")
    parser.add_argument("--sexes", nargs="+", choices=SEXES, default=SEXES)
    parser.add_argument("--people", type=int, default=20, help="of each sex")
    parser.add_argument(
        "--further", action="store_true", help="only the further round: folds and rare axes"
    )
    parser.add_argument("--shrugs", action="store_true", help="only the round for collars")
    parser.add_argument(
        "--motions", nargs="*", type=Path, default=[], help="fitted motions (npz with `poses`)"
    )
    parser.add_argument(
        "--moments", type=int, default=60, help="far-apart poses taken from the motions"
    )
    parser.add_argument(
        "--moments-each", type=int, default=12, help="of them, drawn for each person"
    )
    parser.add_argument("--threads", type=int, help="all cores if left out")
    parser.add_argument(
        "--cluster", help="address of a Dask scheduler, tcp://host:8786 say, which you trust"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--gather", type=Path, help="write what passes into this folder, and print the table"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
