"""The evaluation of MoSh (M 8, Figs 6, 8, 10): errors against the number of markers, soft tissue,
consistency, gender.

    python benchmarks/mosh_paper.py [FOLDER] [--people 4] [--out mosh_paper.json] [--figures FOLDER]

Synthetic people are drawn from the women's and the men's bodies, which the neutral body that is
fitted does not span, with 4 mm of skin that no body knows, markers put on 10 mm off, skin that
slips 5 mm under them as joints turn, and a millimetre of noise. Of 89 markers 67 are fitted, or the
47, 25, 10 or 5 of them that are missed least (M 7), and the 22 others are held out, as in the
paper. The shape's error is the mean distance of the true surface from the found one, its pose
fitted to the true one (M Fig 6 left). Of each real capture (in FOLDER) a fifth of the markers is
held out and as many of the others fitted as the counts say, both chosen at random; held-out markers
are predicted at the layout's place, as in the paper, and where the prior over placements expects
them. Then two trials of one person found apart, and the sex of synthetic people. About 5 minutes of
one idle core.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import CAPTURES, compile_kernels, in_words, machine, parser, write_json
from mosh_accuracy import PAIRS, apart
from mosh_paper_figures import draw
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.gender import said_of
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of, shipped_prior
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.surface_fit import Fit
from habitus.fit.markers.hold_out import HeldMarkers, expected_offsets, held_out_errors
from habitus.fit.markers.recipe import Recording, fit_markers
from habitus.fit.markers.result import MarkerFit
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.selection.held_out import smooth_field
from habitus.fit.selection.problem import SELECTION
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_placements
from habitus.jobs.selection import Selection, select_markers
from habitus.jobs.subjects import leave_out, person_of
from habitus.markers.placements import PlacementPrior
from habitus.observe.markers import attach, triangle_bases
from habitus.observe.simulated_markers import misplace, smooth_motion
from habitus.results.save import fit_female_probability

COUNTS = (5, 10, 25, 47, 67)
MARKERS = 89
FRAMES = 90
RATE = 30.0
PLACEMENT = 0.010
SLIP = 0.005
NOISE = 0.001
REAL = (
    "85_02",
    "HDM_mm_01-02_03_120",
    "HC042A13",
    "testsample",
    "static_rotated",
    "nick_freeform_001",
)
LONGEST = 240
"""Frames of a real capture: it is thinned to that."""


def synthetic(
    model: BodyModel, selection: Selection, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A person of a body: markers (T, 89, 3) of all candidates, the surface at rest (V, 3), metres,
    and the betas.
    """
    layout = selection.pool.layout
    prior = shipped_prior().for_joints(model.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), FRAMES, RATE, rng)
    betas = np.clip(rng.normal(size=model.num_betas), -2.5, 2.5)
    rest = model.rest_vertices(betas)
    latent = misplace(model, betas, layout.vertices(model), layout.distances(), PLACEMENT, rng)
    flesh = SELECTION.flesh * smooth_field(np.concatenate([rest, latent]), rng)
    at = attach(latent, rest, model.faces)
    coefficients = attach(
        latent + flesh[len(rest) :], rest, model.faces, triangles=at.triangles
    ).coefficients
    turned = pose[:, 1:].reshape(FRAMES, -1)
    turned = (turned - turned.mean(axis=0)) / np.sqrt(turned.shape[1])
    along = np.einsum("tn,nmc->tmc", turned, rng.normal(size=(turned.shape[1], len(layout), 2)))
    slip = np.concatenate([np.zeros((FRAMES, len(layout), 1)), SLIP * along / along.std()], axis=2)
    used, corners = np.unique(at.triangles, return_inverse=True)
    bases = triangle_bases(
        model(betas, pose, trans, vertices=used).vertices, corners.reshape(-1, 3)
    )
    markers = bases.origin + (bases.basis @ (coefficients + slip)[..., None])[..., 0]
    return markers + rng.normal(scale=NOISE, size=markers.shape), rest + flesh[: len(rest)], betas


def shape_error(body: BodyModel, betas: np.ndarray, surface: np.ndarray) -> float:
    """Mean distance (mm) of a surface's vertices from those of a shape whose pose is fitted to
    it.
    """
    rest = np.zeros((body.num_joints, 3))
    start = Fit(betas, rest, (surface - body(betas, rest).vertices).mean(axis=0), surface)
    found = PosableBody(body).fit(surface, num_betas=len(betas), betas=betas, start=start)
    return 1e3 * float(np.linalg.norm(found.vertices - surface, axis=1).mean())


def errors_mm(fit: MarkerFit, held: HeldMarkers, prior: PlacementPrior) -> dict[str, float | None]:
    """Observed and held-out errors of both stages; held out at the layout's place and where a prior
    expects them.
    """
    at_place = held_out_errors(fit, held.layout, held.observed[0])
    expected = held_out_errors(
        fit, held.layout, held.observed[0], expected_offsets(fit, held, prior)
    )
    observed = {"pose": fit.predicted_pose_stage, "soft_tissue": fit.predicted_soft_tissue}
    found: dict[str, float | None] = {}
    for stage, predicted in observed.items():
        away = np.linalg.norm(predicted - fit.observed_markers, axis=2)
        found[f"observed_{stage}"] = 1e3 * float(np.nanmean(away))
        found[f"held_out_{stage}"] = 1e3 * float(np.nanmean(getattr(at_place, stage)))
        found[f"expected_{stage}"] = 1e3 * float(np.nanmean(getattr(expected, stage)))
    away = 1e3 * np.nanmean(
        at_place.soft_tissue if at_place.soft_tissue is not None else at_place.pose, axis=0
    )
    return found | {"held_out_sd": float(np.nanstd(away))}


def of_synthetic(body: BodyModel, count: int, seed: int) -> Iterator[dict]:
    """Each synthetic person fitted to each number of markers."""
    chosen = select_markers(
        pool=MARKERS,
        start="mosh-67",
        people=8,
        min_markers=min(COUNTS),
        keep=(),
        body=body,
        seed=seed,
    )
    first = set(chosen.layout(max(COUNTS)).labels)
    held = chosen.pool.layout.restricted_to(
        tuple(x for x in chosen.pool.layout.labels if x not in first)
    )
    sexes = [("female", habitus.load_body("female")), ("male", habitus.load_body("male"))]
    for k in range(count):
        sex, model = sexes[k % 2]
        markers, surface, _ = synthetic(model, chosen, np.random.default_rng(100 + k))
        column = {label: i for i, label in enumerate(chosen.pool.layout.labels)}
        for number in COUNTS:
            layout = chosen.layout(number)
            recording = Recording(
                f"{sex} {k}", markers[:, [column[x] for x in layout.labels]], RATE, "+y"
            )
            fit = fit_markers(body, prior_of(body), layout, [recording], MoshSettings())[0]
            gone = HeldMarkers(held, (markers[:, [column[x] for x in held.labels]],), layout)
            row = errors_mm(fit, gone, PlacementPrior()) | {
                "shape": shape_error(body, fit.betas, surface)
            }
            told = fit_female_probability(fit)
            yield {
                "person": recording.name,
                "sex": sex,
                "markers": len(layout),
                "female": told,
            } | row


def thinned(path: Path) -> Capture:
    """A capture's every n-th frame."""
    capture = habitus.read_capture(path)
    step = max(1, -(-len(capture) // LONGEST))
    return replace(
        capture, markers=np.array(capture.markers)[::step], rate_hz=capture.rate_hz / step
    )


def of_real(body: BodyModel, folder: Path, names: Sequence[str], seed: int) -> Iterator[dict]:
    """Each real capture: a fifth of its markers held out, some of the others fitted."""
    prior = load_placements()
    for path in (folder / f"{name}.c3d" for name in names):
        if not path.exists():
            print(f"{path}: not there; left out")
            continue
        whole = person_of([thinned(path)], "auto")
        rng = np.random.default_rng(seed)
        labels = [str(label) for label in rng.permutation(whole.layout.labels)]
        kept, held = leave_out(whole, labels[: len(labels) // 5])
        rest = labels[len(labels) // 5 :]
        for number in [*(count for count in COUNTS if count < len(rest)), len(rest)]:
            layout = kept.layout.restricted_to(tuple(rest[:number]))
            columns = [kept.layout.labels.index(label) for label in layout.labels]
            recording = replace(
                kept.recordings[0], observed=kept.recordings[0].observed[:, columns]
            )
            fit = fit_markers(body, prior_of(body), layout, [recording], MoshSettings())[0]
            yield {"capture": path.stem, "markers": number, "all": number == len(rest)} | errors_mm(
                fit, held, prior
            )


def of_pairs(body: BodyModel, folder: Path) -> Iterator[dict]:
    """Two trials of one person found apart: how far the shapes are from each other, and from other
    people's.
    """
    fits: dict[str, MarkerFit] = {}
    for name in [name for pair in PAIRS for name in pair]:
        if (folder / f"{name}.c3d").exists():
            one = person_of([thinned(folder / f"{name}.c3d")], "auto")
            settings = MoshSettings(soft_tissue=False)
            fits[name] = fit_markers(body, prior_of(body), one.layout, one.recordings, settings)[0]
    for first, second in PAIRS:
        if {first, second} <= set(fits):
            others = [
                apart(fits[first], fits[name])
                for pair in PAIRS
                if first not in pair
                for name in pair[:1]
            ]
            yield {
                "first": first,
                "second": second,
                "same_mm": apart(fits[first], fits[second]),
                "others_mm": float(np.mean(others)),
                "female": [fit_female_probability(fits[name]) for name in (first, second)],
            }


def table_of(rows: list[dict], heads: Sequence[str], title: str) -> Table:
    """Rows of words and numbers."""
    table = Table(title=title)
    for head in heads:
        table.add_column(head.replace("_", " "), justify="right")
    for row in rows:
        values = [row[head] for head in heads]
        table.add_row(
            *(f"{value:.2f}" if isinstance(value, float) else str(value) for value in values)
        )
    return table


def by_count(rows: list[dict], keys: Sequence[str]) -> list[dict]:
    """Means over people or captures, a row a number of markers."""
    found = []
    for count in sorted({row["markers"] for row in rows}):
        same = [row for row in rows if row["markers"] == count]
        found.append(
            {"markers": count, "n": len(same)}
            | {key: float(np.mean([r[key] for r in same])) for key in keys}
        )
    return found


def sexes(rows: list[dict]) -> dict[str, float]:
    """Of the fits to all markers: how many sexes are said, how many rightly."""
    most = [row for row in rows if row["markers"] == max(COUNTS)]
    said = [(row["sex"], said_of(row["female"])) for row in most]
    return {
        "people": len(said),
        "said": sum(s in ("female", "male") for _, s in said),
        "right": sum(a == b for a, b in said),
    }


def main() -> None:
    """Measure, print, write JSON, draw."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("folder", nargs="?", type=Path, default=CAPTURES)
    arguments.add_argument("--people", type=int, default=4)
    arguments.add_argument("--captures", nargs="+", default=REAL)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--figures", type=Path, help="folder for the figures")
    options = arguments.parse_args()
    where = machine()
    body = habitus.load_body("default")
    console = Console(width=130)
    compile_kernels(body)
    found: dict = {"machine": where, "synthetic": [], "real": [], "pairs": []}
    parts = {
        "synthetic": of_synthetic(body, options.people, options.seed),
        "real": of_real(body, options.folder, options.captures, options.seed),
        "pairs": of_pairs(body, options.folder),
    }
    for part, rows in parts.items():
        for row in rows:
            found[part].append(row)
            write_json(options.out, found)
    found["sexes"] = sexes(found["synthetic"])
    write_json(options.out, found)
    keys = ("observed_pose", "observed_soft_tissue", "held_out_pose", "held_out_soft_tissue")
    told = by_count(found["synthetic"], (*keys, "shape"))
    console.print(
        table_of(told, ("markers", "n", *keys, "shape"), f"synthetic people, mm: {in_words(where)}")
    )
    keys = (*keys, "expected_pose", "expected_soft_tissue")
    console.print(table_of(found["real"], ("capture", "markers", *keys), "real captures, mm"))
    console.print(
        table_of(
            found["pairs"], ("first", "second", "same_mm", "others_mm"), "shapes of one person, mm"
        )
    )
    console.print(found["sexes"])
    if options.figures:
        draw(found, options.figures)


if __name__ == "__main__":
    main()
