"""Where do labels sit that no layout knows? Real captures with their labels replaced by neutral
names.

    python benchmarks/discover.py [--captures 85_02 testsample …] [--labelling FOLDER] [--seconds]

Each capture is fitted with its true layout and, its labels renamed m00, m01, …, with
`layout="discover"`. The table says both errors, how far the places found are from the true ones on
the template (the fits' latent markers, both carried to the mean body), the share of markers on the
right side of the body, how many are within 5 cm and what the confidences promised, what the
discovery said was not decided, and seconds of CPU. A capture of labels that no layout knows
(KneeltoProne01, beside MarkerSet.xml) is fitted by discovery and with the marker set. JSON holds
every marker.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import CAPTURES, compile_kernels, in_words, machine, parser, write_json, written_rows
from rich.console import Console
from rich.table import Table

import habitus
from habitus.body.model import BodyModel
from habitus.errors import HabitusError
from habitus.fit.markers.result import MarkerFit
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import match_layout
from habitus.observe.markers import predict_markers

NAMES = (
    "85_02",
    "HDM_mm_01-02_03_120",
    "testsample",
    "HC030A05",
    "HC042A13",
    "kinematics_tennis_serve",
    "RoboStatic",
)
LABELLED = CAPTURES.parent / "labelling"
CLEAR = 0.03
NEAR = 0.05  # metres: off the middle of the body; a place that is right


def neutral(capture: Capture) -> tuple[Capture, dict[str, str]]:
    """The markers that the true layout knows, renamed, and the names they had."""
    match = match_layout(capture.labels, capture.markers)
    names = {f"m{k:02d}": label for k, label in enumerate(match.matched)}
    markers = np.asarray(capture.markers)[:, match.columns]
    return replace(capture, labels=tuple(names), markers=markers), names


def fitted(capture: Capture | Path, body: BodyModel, layout: str) -> tuple[MarkerFit, float]:
    """A fit and the CPU seconds it took."""
    began = time.process_time()
    return habitus.mosh(capture, body=body, layout=layout)[0], time.process_time() - began


def errors(fit: MarkerFit) -> dict[str, float]:
    """Means of both stages and the 95th percentile of the first, mm."""
    posed = 1e3 * fit.errors("pose")
    soft = 1e3 * fit.errors("soft_tissue")
    return {
        "pose_mm": float(np.nanmean(posed)),
        "soft_tissue_mm": float(np.nanmean(soft)),
        "p95_mm": float(np.nanpercentile(posed, 95)),
    }


def on_template(fit: MarkerFit) -> dict[str, np.ndarray]:
    """Each label's latent marker, carried to the mean body."""
    places = predict_markers(np.asarray(fit.body.v_template, dtype=float), fit.attachment)
    return dict(zip(fit.labels, places, strict=True))


def row(name: str, path: Path, body: BodyModel) -> dict:
    """Both fits of a capture, and how far apart they put the markers."""
    capture = habitus.read_capture(path)
    renamed, names = neutral(capture)
    true, _ = fitted(capture, body, "auto")
    found, seconds = fitted(renamed, body, "discover")
    here = on_template(found)
    there = on_template(true)
    pairs = [(new, old) for new, old in names.items() if new in here and old in there]
    apart = np.array([np.linalg.norm(here[new] - there[old]) for new, old in pairs])
    across = np.array([(here[new][0], there[old][0]) for new, old in pairs])
    sided = (np.abs(across) > CLEAR).all(axis=1)
    return {
        "capture": name,
        "markers": len(names),
        "placed": len(pairs),
        "true": errors(true),
        "found": errors(found),
        "places_mm": {
            "mean": 1e3 * float(apart.mean()),
            "median": 1e3 * float(np.median(apart)),
            "p90": 1e3 * float(np.percentile(apart, 90)),
            "per_marker": {old: 1e3 * float(x) for (_, old), x in zip(pairs, apart, strict=True)},
        },
        "right_side": float(np.mean(np.sign(across[sided, 0]) == np.sign(across[sided, 1]))),
        "within_5_cm": float(np.mean(apart < NEAR)),
        "promised": found.layout_confidence,
        "doubts": list(found.doubts),
        "verdict": str(found.verdict),
        "cpu_seconds": seconds,
    }


def lab_set(folder: Path, body: BodyModel) -> list[dict]:
    """The lab's own set: by discovery, and with the file that says where its markers sit."""
    rows = []
    for layout in ("discover", str(folder / "MarkerSet.xml")):
        fit, seconds = fitted(folder / "KneeltoProne01.c3d", body, layout)
        across = {
            label: place[0] for label, place in on_template(fit).items() if abs(place[0]) > CLEAR
        }
        told = [
            np.sign(x) == (1.0 if label[0] == "L" else -1.0)
            for label, x in across.items()
            if label[0] in "LR"
        ]
        rows.append(
            {
                "capture": "KneeltoProne01",
                "layout": Path(layout).name,
                **errors(fit),
                "right_side": float(np.mean(told)),
                "doubts": list(fit.doubts),
                "verdict": str(fit.verdict),
                "cpu_seconds": seconds,
            }
        )
    return rows


def table(rows: list[dict], title: str) -> Table:
    """One row a capture."""
    shown = Table(title=title, caption="mm; places: from the true layout's fit, on the mean body")
    heads = "capture|markers|error\ntrue|error\nfound|soft\ntrue|soft\nfound|places\nmean|median|p90|right\nside|"
    for head in (heads + "<5 cm|promised|CPU s|said").split("|"):
        shown.add_column(head, justify="left" if head in ("capture", "said") else "right")
    for r in rows:
        both = [
            r[which][key] for key in ("pose_mm", "soft_tissue_mm") for which in ("true", "found")
        ]
        places = [r["places_mm"][key] for key in ("mean", "median", "p90")]
        shares = [f"{r['right_side']:.0%}", f"{r['within_5_cm']:.0%}", f"{r['promised']:.0%}"]
        said = " ".join(r["doubts"]) or "–"
        numbers = [*(f"{x:.1f}" for x in (*both, *places)), *shares, f"{r['cpu_seconds']:.0f}"]
        shown.add_row(r["capture"], f"{r['placed']}/{r['markers']}", *numbers, said)
    return shown


def main() -> None:
    """Fit all that is not in the JSON yet, print the table, write JSON after every capture."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument("--captures", nargs="+", default=NAMES, metavar="NAME")
    arguments.add_argument("--labelling", type=Path, default=LABELLED, metavar="FOLDER")
    options = arguments.parse_args()
    where = machine()
    body = habitus.load_body("default")
    compile_kernels(body)
    rows = written_rows(options.out, "rows")
    own = written_rows(options.out, "lab_set")
    for name in options.captures:
        path = CAPTURES / f"{name}.c3d"
        if not path.exists() or name in {r["capture"] for r in rows}:
            print(f"{name}: {'done before' if path.exists() else 'not there; left out'}")
            continue
        try:
            rows.append(row(name, path, body))
        except HabitusError as error:
            print(f"{name}: {error}")
        write_json(options.out, {"machine": where, "rows": rows, "lab_set": own})
    if not own and (options.labelling / "KneeltoProne01.c3d").exists():
        own = lab_set(options.labelling, body)
        write_json(options.out, {"machine": where, "rows": rows, "lab_set": own})
    Console(width=190).print(table(rows, f"renamed captures: {in_words(where)}"))
    for r in own:
        print(
            f"{r['capture']} with {r['layout']}: {r['pose_mm']:.1f} mm, p95 {r['p95_mm']:.1f}, "
            "soft tissue "
            f"{r['soft_tissue_mm']:.1f}, right side {r['right_side']:.0%}; {r['verdict']}"
        )


if __name__ == "__main__":
    main()
