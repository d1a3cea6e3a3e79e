"""Does the prior over placements predict markers of people from whom it learned nothing?

    python benchmarks/mosh_placements.py [FOLDER] [--captures 85_02 85_12] [--seen FILE.json]
    [--plain FILE.json]

Leave one person out: for each person a prior is learned from the others alone, and every marker of
their captures is held out, one in five at a time (MoSh 8.1). It is predicted at the landmark of the
layout's file, at the prior's mean for all people, and where the prior expects it given where the
person's other markers were found. In the last two kept markers begin at the prior's means.
``--seen`` is what `tools/placements/learn.py --seen` wrote; without it, that is measured first.
``--plain``: `mosh_accuracy.py`'s JSON made without a prior, for the numbers at the landmarks.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from common import CAPTURES, ROOT, compile_kernels, in_words, machine, parser, write_json
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.fit.markers.hold_out import merged
from habitus.fit.markers.recipe import fit_markers
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.placements import learned
from habitus.io.layouts.files import list_layouts, plain_layout
from habitus.jobs.mosh import errors_of
from habitus.jobs.subjects import leave_out, person_of
from habitus.markers.layouts import MarkerLayout
from habitus.markers.placements import PlacementPrior

sys.path.insert(0, str(ROOT / "tools" / "placements"))
from learn import EVERY, read_seen, seen_of
from people import PEOPLE

WAYS = {
    "landmark": "at the landmark",
    "mean": "at the prior's mean",
    "expected": "given the person's others",
}


def held_out_mm(
    body: BodyModel,
    path: Path,
    layouts: Sequence[MarkerLayout],
    priors: Mapping[str, PlacementPrior],
) -> dict[str, dict[str, float]]:
    """Of each prior over all samples ("") and of each marker the mean held-out error of the pose
    stage.
    """
    who = person_of([habitus.read_capture(path)], tuple(layouts))
    parts = {way: [] for way in priors}
    for k in range(EVERY):
        kept, held = leave_out(who, who.layout.labels[k::EVERY])
        fit = fit_markers(
            body, prior_of(body), kept.layout, kept.recordings, MoshSettings(soft_tissue=False)
        )[0]
        for way, prior in priors.items():
            parts[way].append(errors_of(fit, held, 0, prior))
    found = {}
    for way, each in parts.items():
        held = merged(each)
        found[way] = {"": 1e3 * float(np.nanmean(held.pose))}
        found[way] |= {
            label: 1e3 * float(np.nanmean(held.pose[:, k])) for k, label in enumerate(held.labels)
        }
    return found


def table_of(rows: dict[str, dict], title: str) -> Table:
    """A row a capture, their mean, and the mean of people."""
    table = Table(title=title, caption="mean held-out error of the pose stage, mm")
    for head in ("capture", "person", *WAYS.values()):
        table.add_column(head, justify="left" if head in ("capture", "person") else "right")
    numbers = {name: np.array([row[way][""] for way in WAYS]) for name, row in rows.items()}
    for name, each in numbers.items():
        table.add_row(name, rows[name]["person"], *(f"{mm:.1f}" for mm in each))
    people = {rows[name]["person"] for name in rows}
    of_people = [
        np.mean([numbers[n] for n in rows if rows[n]["person"] == p], axis=0)
        for p in sorted(people)
    ]
    for name, means in (
        ("mean of captures", list(numbers.values())),
        ("mean of people", of_people),
    ):
        mean = np.mean(means, axis=0)
        table.add_row(name, "", *(f"{mm:.1f} ({100 * (mm / mean[0] - 1):+.1f} %)" for mm in mean))
    return table


def main() -> None:
    """Learn, hold out, print, write JSON."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("folder", nargs="?", type=Path, default=CAPTURES)
    arguments.add_argument("--captures", nargs="+", default=(), metavar="NAME")
    arguments.add_argument("--seen", type=Path)
    arguments.add_argument("--plain", type=Path)
    options = arguments.parse_args()
    where = machine()
    body = habitus.load_body("default")
    compile_kernels(body)
    everything = (
        read_seen(options.seen.read_text()) if options.seen else seen_of(options.folder, body)
    )
    plain = [plain_layout(name) for name in list_layouts()]
    rows = {}
    known = json.loads(options.plain.read_text())["rows"] if options.plain else []
    before = {row["capture"]: {"landmark": {"": row["held_out_pose_mm"]}} for row in known}
    for name, files in PEOPLE.items():
        prior = learned([one for one in everything if one.person != name], body)
        told = [prior.applied(layout) for layout in plain]
        for path in (options.folder / file for file in files):
            if not path.exists() or (options.captures and path.stem not in options.captures):
                continue
            nothing = PlacementPrior()
            row = before.get(path.stem) or held_out_mm(body, path, plain, {"landmark": nothing})
            row |= held_out_mm(body, path, told, {"mean": nothing, "expected": prior})
            rows[path.stem] = {"person": name} | row
            told_mm = ", ".join(f"{words} {row[way]['']:.1f}" for way, words in WAYS.items())
            print(f"{path.stem}: {told_mm} mm", flush=True)
            write_json(options.out, {"machine": where, "captures": rows})
    if rows:
        Console(width=120).print(
            table_of(rows, f"held-out markers, the person left out of the prior: {in_words(where)}")
        )


if __name__ == "__main__":
    main()
