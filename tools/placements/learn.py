"""Learns where people put markers, and writes the prior over placements that comes with the
layouts.

    python tools/placements/learn.py [FOLDER] [--out src/habitus/assets/placements.toml]

FOLDER holds the captures that `people.py` names; those that are not there are named and left out.
Of each person every marker is held out once, one in five at a time: the shape stage finds body and
twelve poses from the others, and tells where the marker sat, from the landmark of the layout's
file. `habitus.fit.placements` makes a mean and a spread of all people's offsets. Nothing that was
learned before plays a part. About 3 minutes of one idle core.
"""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from people import PEOPLE
from threadpoolctl import threadpool_limits

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.files import write_text
from habitus.fit.markers.hold_out import HeldMarkers
from habitus.fit.markers.recordings import Recording, spread_frames
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.shape import ShapeFit
from habitus.fit.markers.subject import fit_subject
from habitus.fit.placements import Seen, learned, offsets_at_rest, seen
from habitus.io.captures.read import Capture, read_capture
from habitus.io.layouts.files import list_layouts, placements_text, plain_layout
from habitus.io.models.bodies import load_body
from habitus.jobs.subjects import Person, leave_out, person_of
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.placements import PlacementPrior
from habitus.observe.markers import default_markers

ROOT = Path(__file__).resolve().parents[2]
EVERY = 5
FRAMES = 12
LONGEST = 300
HEAD = """Where people put markers: written by tools/placements/learn.py, do not edit.

A table a place (left and right are one; x away from the middle, y up, z ahead), a line for any label there and for each
that was seen. shift: along the skin from the landmark; off: more distance from the skin; spread: of one person's marker
about it, standard deviation; all in metres. people: how many told it."""


def read_people(folder: Path) -> dict[str, list[Capture]]:
    """Each person's captures, thinned to `LONGEST` frames."""
    found: dict[str, list[Capture]] = {}
    for name, files in PEOPLE.items():
        for path in (folder / file for file in files):
            if path.exists():
                found.setdefault(name, []).append(thinned(read_capture(path)))
            else:
                print(f"{path}: not there; left out")
    return found


def thinned(capture: Capture) -> Capture:
    """The same with every n-th frame alone."""
    step = max(1, -(-len(capture.markers) // LONGEST))
    return replace(
        capture, markers=np.array(capture.markers)[::step], rate_hz=capture.rate_hz / step
    )


def markers_of(
    body: BodyModel, name: str, captures: Sequence[Capture], layouts: Sequence[MarkerLayout]
) -> list[Seen]:
    """Where one person's markers sat, from the places of ``layouts``."""
    whole = person_of(captures, tuple(layouts))
    found = []
    keys = {marker.label: marker for layout in reversed(layouts) for marker in layout.markers}
    own = next(layout for layout in layouts if layout.name == whole.layout.name)
    every = replace(
        own, markers=tuple((keys | {marker.label: marker for marker in own.markers}).values())
    )
    chosen = spread_frames(np.concatenate([r.observed for r in whole.recordings]), FRAMES, 0)
    for k in range(EVERY):
        found += _fold(body, name, whole, k, chosen, every)
    return found


def _fold(
    body: BodyModel, name: str, whole: Person, k: int, chosen: np.ndarray, every: MarkerLayout
) -> list[Seen]:
    kept, held = leave_out(whole, whole.layout.labels[k::EVERY])
    poses = Recording(name, np.concatenate([r.observed for r in kept.recordings])[chosen], 1.0)
    told = np.isfinite(poses.observed[..., 0]).any(axis=0)
    layout = replace(
        kept.layout, markers=tuple(m for m, t in zip(kept.layout.markers, told, strict=True) if t)
    )
    settings = MoshSettings(frames=len(chosen), frame_choice="random")
    prior = prior_of(body).for_joints(body.joint_names)
    with threadpool_limits(1, user_api="blas"):
        shape = fit_subject(
            body, prior, layout, [replace(poses, observed=poses.observed[:, told])], settings
        ).shape
    observed = np.concatenate(held.observed)[chosen]
    offsets = offsets_at_rest(body, shape.betas, shape.pose, shape.trans, held.layout, observed)
    return seen(name, held.layout, offsets, every, _twins(body, shape, layout, held))


def _twins(body: BodyModel, shape: ShapeFit, layout: MarkerLayout, held: HeldMarkers) -> np.ndarray:
    """Where the shape stage found each held-out marker's twin, from its place, mirrored: (H, 3),
    zeros without one.
    """
    assert held.others is not None
    known = held.others.restricted_to(
        tuple(label for label in layout.labels if label in held.others.labels)
    )
    start = default_markers(body, shape.betas, known.vertices(body), known.distances())
    found = shape.latent_markers[[layout.labels.index(label) for label in known.labels]]
    return PlacementPrior(alike=(1.0, 1.0)).expected(known, found - start, held.layout)


def seen_of(folder: Path, body: BodyModel) -> list[Seen]:
    """Where all people's markers sat, from the landmarks that the layouts' files name."""
    layouts = [plain_layout(name) for name in list_layouts()]
    everything = []
    for name, captures in read_people(folder).items():
        new = markers_of(body, name, captures, layouts)
        everything += new
        off = 1e3 * np.linalg.norm([one.offset for one in new], axis=1).mean()
        print(f"{name}: {len(new)} markers, {off:.1f} mm off", flush=True)
    return everything


def seen_text(everything: Sequence[Seen]) -> str:
    """What was seen as JSON."""
    return json.dumps([asdict(one) for one in everything], indent=0)


def read_seen(text: str) -> list[Seen]:
    """What was seen, from its JSON."""

    def tuples(fields: dict) -> dict:
        return {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in fields.items()
        }

    return [
        Seen(**tuples(one) | {"marker": Marker(**tuples(one["marker"]))})
        for one in json.loads(text)
    ]


def main() -> None:
    """Read, fit, learn, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT.parent / "shared" / "mocap")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "src" / "habitus" / "assets" / "placements.toml"
    )
    parser.add_argument("--body", default="default")
    parser.add_argument(
        "--seen", type=Path, metavar="FILE.json", help="where each marker sat, for the benchmark"
    )
    options = parser.parse_args()
    body = load_body(options.body)
    everything = seen_of(options.folder, body)
    if options.seen:
        write_text(options.seen, seen_text(everything))
    write_text(options.out, placements_text(learned(everything, body), HEAD))
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
