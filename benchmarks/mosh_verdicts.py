"""Does the verdict part sound fits from wrong ones? Clean captures and spoilt copies of them,
fitted and judged.

    python benchmarks/mosh_verdicts.py [CAPTURE_OR_FOLDER ...] [--captures DJ2 85_02] [--kinds "two
    people" clean]

Every capture is cut to some frames in its middle and fitted as it is, and again after each way of
spoiling it (`habitus_lab.population.spoilt`, a wrong rate, exchanged sides, labels of another set,
and another layout than its own). Goals: no spoilt copy is called good, no clean capture failed. A
spoilt copy that is refused with an error counts as not called good. What no data can tell is marked
as undecidable and counted by itself: one frame over and over, a mirrored space with exchanged
labels, and of people who stand still the order and the rate of frames. JSON holds verdicts, reasons and the numbers they stand on; `--resume` goes on with
what it holds already.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from common import (
    capture_files,
    capture_parser,
    compile_kernels,
    in_words,
    machine,
    write_json,
    written_rows,
)
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.markers.evidence import Evidence, evidence
from habitus.io.captures.read import Capture, read_captures
from habitus.io.layouts.files import match_layout, shipped_layouts
from habitus.markers.checks import other_side
from habitus.markers.matching import LayoutMatch
from habitus_lab.population.spoilt import SPOILINGS

CLEAN = "clean"
WRONG_LAYOUT = "wrong layout"
OTHER_SET = "labels of another set"
RATE = "rate times 4"
SIDES = "sides exchanged"
MIRRORED_SIDES = "mirrored and sides exchanged"
KINDS = (CLEAN, *SPOILINGS, RATE, SIDES, MIRRORED_SIDES, OTHER_SET, WRONG_LAYOUT)
UNDECIDABLE = ("frozen", MIRRORED_SIDES)
"""Kinds that leave a sound capture of something else."""
UNDECIDABLE_AT_REST = ("frames shuffled", RATE, "half of the markers constant")
"""Kinds that change next to nothing where nobody moves."""
REST = 0.05
"""m/s: markers of a clean capture that are slower, at the 95th percentile, are at rest."""
LEVELS = ("good", "doubtful", "failed", "refused")
Z_UP = {"x": [1, 2, 0], "y": [2, 0, 1], "z": [0, 1, 2]}
OTHER_PLACE = 0.05
OTHERS = 0.25  # metres; share of labels that a wrong layout puts elsewhere


def middle(capture: Capture, frames: int) -> Capture:
    """Some frames from a capture's middle."""
    first = max(0, (len(capture) - frames) // 2)
    return capture[first : first + frames]


def spoilt(capture: Capture, kind: str, body: BodyModel) -> tuple[Capture, str] | None:
    """A copy spoilt in one way, and the layout to fit it with; None where no other layout would be
    wrong enough.
    """
    if kind == CLEAN:
        return capture, "auto"
    match = match_layout(capture.labels, capture.markers)
    if kind == WRONG_LAYOUT:
        name = most_wrong_layout(
            capture, dict(zip(match.layout.labels, match.layout.vertices(body), strict=True)), body
        )
        return None if name is None else (capture, name)
    if kind == RATE:
        return replace(capture, rate_hz=4.0 * capture.rate_hz), "auto"
    if kind in (SIDES, MIRRORED_SIDES):
        sign = np.array([-1.0, 1.0, 1.0]) if kind == MIRRORED_SIDES else 1.0
        return sides_exchanged(replace(capture, markers=sign * capture.markers), match), "auto"
    if kind == OTHER_SET:
        others = [x for layout in shipped_layouts() for x in layout.labels]
        labels = [x for x in dict.fromkeys(others) if x not in capture.labels]
        count = len(capture.labels)
        return replace(capture, labels=(*labels, *capture.labels)[:count]), "auto"
    order = Z_UP[capture.up_axis[-1]]
    markers = np.empty((len(capture), len(match.columns), 3))
    markers[..., order] = SPOILINGS[kind](
        capture.markers[:, match.columns][..., order], np.random.default_rng(0)
    )
    return replace(capture, labels=match.matched, markers=markers), "auto"


def sides_exchanged(capture: Capture, match: LayoutMatch) -> Capture:
    """With the labels of left and right markers exchanged."""
    places = {m.place: name for m, name in zip(match.layout.markers, match.matched, strict=True)}
    other = {
        name: places.get(other_side(m).place, name)
        for m, name in zip(match.layout.markers, match.matched, strict=True)
    }
    both = {name: partner for name, partner in other.items() if other.get(partner) == name}
    return replace(capture, labels=tuple(both.get(x, x) for x in capture.labels))


def undecidable(kind: str, speed: float) -> bool:
    """Whether no data can tell a spoilt copy from a sound capture; speed: of the clean capture's
    markers (m/s).
    """
    return kind in UNDECIDABLE or (kind in UNDECIDABLE_AT_REST and speed < REST)


def marker_speed(capture: Capture) -> float:
    """95th percentile (m/s)."""
    moved = np.linalg.norm(np.diff(capture.markers, axis=0), axis=2) * capture.rate_hz
    return float(np.nanpercentile(moved, 95))


def most_wrong_layout(capture: Capture, places: dict[str, int], body: BodyModel) -> str | None:
    """The shipped layout that takes this capture's labels and puts most of them elsewhere."""
    rest = body.rest_vertices(np.zeros(body.num_betas))
    wrong = {}
    for layout in shipped_layouts():
        try:
            other = match_layout(capture.labels, capture.markers, [layout]).layout
        except HabitusError:
            continue
        both = [
            (v, places[x])
            for x, v in zip(other.labels, other.vertices(body), strict=True)
            if x in places
        ]
        far = [np.linalg.norm(rest[a] - rest[b]) > OTHER_PLACE for a, b in both]
        wrong[layout.name] = float(np.mean(far)) if far else 0.0
    name = max(wrong, key=lambda name: wrong[name], default=None)
    return name if name is not None and wrong[name] >= OTHERS else None


def judged(capture: Capture, kinds: Sequence[str], body: BodyModel) -> Iterator[dict]:
    """Verdicts on a capture and on its spoilt copies."""
    for kind in kinds:
        case = spoilt(capture, kind, body)
        if case is None:
            continue
        began = time.perf_counter()
        row = {"capture": capture.name, "kind": kind, "layout": case[1]}
        row["undecidable"] = undecidable(kind, marker_speed(capture))
        try:
            fit = habitus.Mosh(layout=case[1]).fit(case[0], body)
            row |= {
                "level": fit.verdict.level,
                "reasons": fit.verdict.reasons,
                "evidence": numbers(evidence(fit)),
            }
        except HabitusError as error:
            row |= {"level": "refused", "reasons": (str(error),)}
        yield row | {"seconds": time.perf_counter() - began}


def numbers(found: Evidence) -> dict:
    """What of the evidence is a number."""
    plain = {name: value for name, value in vars(found).items() if isinstance(value, int | float)}
    return plain | {"measurements": dict(found.measurements), "recorded": dict(found.recorded)}


def table(rows: list[dict], title: str) -> Table:
    """How many of each kind got which level."""
    shown = Table(title=title)
    for head in ("kind", *LEVELS, "wrong", "undecidable"):
        shown.add_column(head, justify="left" if head == "kind" else "right")
    for kind in KINDS:
        some = [row for row in rows if row["kind"] == kind]
        levels = Counter(row["level"] for row in some)
        undecided = [row for row in some if row["undecidable"]]
        if levels:
            wrong = levels["failed"] + levels["refused"] if kind == CLEAN else levels["good"]
            wrong -= sum(row["level"] == "good" for row in undecided)
            counts = (*(levels[level] for level in LEVELS), wrong, len(undecided))
            shown.add_row(kind, *map(str, counts))
    return shown


def summary(rows: list[dict]) -> dict[str, dict[str, int]]:
    """How many of the clean, of the spoilt, and of the spoilt that no data can tell, got which
    level.
    """
    found = {
        "clean": [row for row in rows if row["kind"] == CLEAN],
        "spoilt": [row for row in rows if row["kind"] != CLEAN and not row["undecidable"]],
        "undecidable": [row for row in rows if row["kind"] != CLEAN and row["undecidable"]],
    }
    return {
        name: {"all": len(some), **Counter(row["level"] for row in some)}
        for name, some in found.items()
    }


def main() -> None:
    """Fit and judge all, print the table, write JSON."""
    arguments = capture_parser(__doc__)
    arguments.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS, metavar="KIND")
    arguments.add_argument("--frames", type=int, default=150)
    arguments.add_argument("--resume", action="store_true", help="keep the rows that --out holds")
    options = arguments.parse_args()
    where = machine()
    body = habitus.load_body("default")
    rows = written_rows(options.out, "rows", frames=options.frames) if options.resume else []
    compile_kernels(body)
    for path in capture_files(options.places, options.captures):
        for capture in read_captures(path):
            done = {row["kind"] for row in rows if row["capture"] == capture.name}
            left = [kind for kind in options.kinds if kind not in done]
            for row in judged(middle(capture, options.frames), left, body):
                rows.append(row)
                print(
                    f"{row['capture']}, {row['kind']}: {row['level']}: {row['reasons'][0]}",
                    flush=True,
                )
            found = {"machine": where, "frames": options.frames, "summary": summary(rows)}
            write_json(options.out, {**found, "rows": rows})
    Console(width=130).print(
        table(rows, f"verdicts on clean and spoilt captures: {in_words(where)}")
    )
    print(f"{options.out}: {len(rows)} rows")


if __name__ == "__main__":
    main()
