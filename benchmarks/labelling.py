"""Labelling captures whose labels were taken away: F1 per capture, by a layout and by a labelled
capture.

    python benchmarks/labelling.py [--captures 85_02 …] [--frames 1000] [--ways set like] [--out
    FOLDER]

The protocol of the field (Ghorbani and Black, SOMA, 2021): in each frame up to 5 points are hidden
and up to 3 ghosts drawn from a Gaussian over the body, anew each time, and the order of the points
is shuffled: no trajectory is left. "broken" hides 50 stretches of 5 to 60 frames as well, and adds
two ghosts that last for 60 to 400 frames.

Ways: "set" knows which labels there are and where a layout puts them by their names alone; "like"
has been given a labelled capture of the same person, or where there is none the last 40 % of the
same one, of which it labels the first 60 %. Truth is the file's labels, put right where the
geometry shows that the file exchanges them, in some frames or throughout (`layout check`: a left
LWRA behind its LWRB, a right one ahead); ``--as-filed`` takes what it exchanges throughout as it
is. Where a layout has several markers at one place (clusters), no way but "like" can tell them
apart: "alike" counts such labels as right for each other, and tells how many there are.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from common import machine, parser, write_json

from habitus.body.prior import prior_of
from habitus.fit.labels.clouds import Clouds
from habitus.fit.labels.recipe import label_points
from habitus.fit.labels.settings import LABELS
from habitus.io.captures.read import Capture, read_captures
from habitus.io.layouts.files import match_layout
from habitus.io.models.bodies import load_body
from habitus.jobs.label import known_person
from habitus.jobs.options import MIN_CONFIDENCE
from habitus.jobs.subjects import person_of

MOCAP = Path(__file__).resolve().parents[2] / "shared" / "mocap"
LIKE = {
    "85_02": "85_12",
    "85_12": "85_02",
    "HC030A05": "HC030A22",
    "HC030A22": "HC030A05",
    "HC042A13": "HC042A40",
    "HC042A40": "HC042A13",
    "testsample": "testsample2",
    "testsample2": "testsample",
    "anat_pose_ECH": "right_hip",
    "right_hip": "anat_pose_ECH",
    "right_knee": "anat_pose_ECH",
}
WRONG_IN_FILE = {"nick_freeform_001": ("LIWR", "LOHAND", 200)}
"""Labels that the file exchanges up to a frame: there LIWR keeps the distances that LOHAND has
afterwards (37 mm to LIHAND, 297 mm to LELB; LIWR has 68 and 250).
"""


@dataclass(frozen=True)
class Score:
    """Of one capture, one way and one protocol."""

    capture: str
    way: str
    protocol: str
    frames: int
    markers: int
    f1: float
    precision: float
    recall: float
    accuracy: float
    alike_f1: float
    alike_labels: int
    sure_and_wrong: float
    cpu_seconds: float


def main() -> None:
    """Measure and print; write JSON after each capture."""
    arguments = parser(__doc__, out=True)
    arguments.add_argument(
        "--captures",
        nargs="*",
        default=sorted(p.stem for p in MOCAP.iterdir() if p.suffix != ".md"),
    )
    arguments.add_argument("--frames", type=int, default=1000)
    arguments.add_argument("--ways", nargs="*", default=["set", "like"])
    arguments.add_argument("--protocols", nargs="*", default=["points", "broken"])
    arguments.add_argument("--as-filed", action="store_true")
    options = arguments.parse_args()
    found: list[Score] = []
    for name in options.captures:
        for way in options.ways:
            for score in measure(
                name, way, options.protocols, options.frames, not options.as_filed
            ):
                found.append(score)
                print(
                    f"{name:26} {way:5} {score.protocol:7} F1 {score.f1:.4f}  alike "
                    f"{score.alike_f1:.4f} "
                    f"({score.alike_labels:2})  precision {score.precision:.4f}  "
                    f"sure and wrong {score.sure_and_wrong:.4f}"
                    f"  {score.cpu_seconds:5.1f} s for {score.frames} frames of {score.markers}",
                    flush=True,
                )
                write_json(
                    options.out,
                    {"machine": machine(), "scores": [asdict(s) for s in found]},
                )


def measure(
    name: str, way: str, protocols: list[str], most: int, relabelled: bool
) -> Iterator[Score]:
    """A capture's scores."""
    whole = read(name, relabelled)
    body = load_body("default")
    prior = prior_of(body)
    cut = len(whole)
    if way == "set":
        layout = match_layout(whole.labels).layout
        known = None
        names = layout.labels
        truth = corrected(whole)
    else:
        cut = len(whole) if name in LIKE else int(0.6 * len(whole))
        other = read(LIKE[name], relabelled) if name in LIKE else whole[cut:]
        layout, known, names = known_person(body, person_of([other], "auto"), LABELS.fit)
        truth = corrected(whole)
    columns = [truth[0].index(each) if each in truth[0] else None for each in names]
    markers = truth[1][: min(most, cut)]
    to_truth = np.array([-2 if column is None else column for column in columns])
    alike = places(layout, len(truth[0]), to_truth)
    for protocol in protocols:
        broken = {"breaks": 50, "lasting": 2} if protocol == "broken" else {}
        clouds, true = spoilt(markers, whole.rate_hz, whole.up_axis, **broken)
        began = time.process_time()
        result = label_points(body, prior, layout, clouds, known)
        seconds = time.process_time() - began
        label = np.where(
            (result.label >= 0) & (result.confidence >= MIN_CONFIDENCE), to_truth[result.label], -1
        )
        right = (label == true) & (true >= 0)
        near = right | ((label >= 0) & (true >= 0) & (alike[label] == alike[true]))
        wrong = (label >= 0) & ~right & (result.confidence > 0.9)
        said = max(1, int((label != -1).sum()))
        there = max(1, int((true >= 0).sum()))
        yield Score(
            name,
            way,
            protocol,
            len(clouds),
            markers.shape[1],
            2.0 * right.sum() / (said + there),
            right.sum() / said,
            right.sum() / there,
            float((label == true).mean()),
            2.0 * near.sum() / (said + there),
            int((np.bincount(alike[alike >= 0]) > 1) @ np.bincount(alike[alike >= 0])),
            wrong.sum() / said,
            seconds,
        )


def read(name: str, relabelled: bool) -> Capture:
    """A capture of the shared ones, the person with most markers; labels that it exchanges
    throughout put right.
    """
    capture = read_captures(next(path for path in MOCAP.iterdir() if path.stem == name))[0]
    if not relabelled:
        return capture
    meant = {marker.label: marker.place for marker in match_layout(capture.labels).layout.markers}
    found = match_layout(capture.labels, capture.markers)
    owner = {place: label for label, place in meant.items()}
    where = {m.label: owner.get(m.place) for m in found.layout.markers if m.place != meant[m.label]}
    right = {label: other for label, other in where.items() if other and where.get(other) == label}
    filed = {
        label: capture.labels[column]
        for label, column in zip(found.layout.labels, found.columns, strict=True)
    }
    names = {filed[label]: filed[other] for label, other in right.items()}
    return replace(capture, labels=tuple(names.get(label, label) for label in capture.labels))


def corrected(capture: Capture) -> tuple[tuple[str, ...], np.ndarray]:
    """Labels and markers, put back where the file is known to exchange them."""
    match = match_layout(capture.labels, capture.markers)
    labels = match.layout.labels
    markers = match.select(capture.markers)
    if capture.name in WRONG_IN_FILE:
        first, second, frames = WRONG_IN_FILE[capture.name]
        i = labels.index(first)
        j = labels.index(second)
        markers[:frames, [i, j]] = markers[:frames, [j, i]]
    return labels, markers


def places(layout, count: int, to_truth: np.ndarray) -> np.ndarray:
    """(count,) which true labels share a place in the layout: a number each."""
    where = [(m.place, round(m.distance, 3)) for m in layout.markers]
    group = -1 - np.arange(count)
    numbers = {place: k for k, place in enumerate(dict.fromkeys(where))}
    for place, column in zip(where, to_truth, strict=True):
        if column >= 0:
            group[column] = numbers[place]
    return group


def spoilt(
    markers: np.ndarray,
    rate_hz: float,
    up_axis: str,
    breaks: int = 0,
    lasting: int = 0,
    seed: int = 0,
) -> tuple[Clouds, np.ndarray]:
    """Clouds, and the true label of each point, -1 for ghosts."""
    rng, (frames, count) = np.random.default_rng(seed), markers.shape[:2]
    seen = markers.copy()
    ghosts = np.full((frames, 3 + lasting, 3), np.nan)
    for _ in range(breaks):
        first = rng.integers(frames)
        length = rng.integers(5, 61)
        seen[first : first + length, rng.integers(count)] = np.nan
    for k in range(lasting):
        first = rng.integers(frames)
        length = rng.integers(60, 400)
        stretch = markers[first : first + length]
        begin = rng.multivariate_normal(np.nanmean(stretch, axis=(0, 1)), spread(stretch[0]))
        ghosts[first : first + length, 3 + k] = begin + np.cumsum(
            rng.normal(0.0, 5e-4, (len(stretch), 3)), axis=0
        )
    for t in range(frames):
        seen[t, rng.choice(count, rng.integers(6), replace=False)] = np.nan
        drawn = rng.integers(4)
        if np.isfinite(markers[t, :, 0]).sum() > 4:
            ghosts[t, :drawn] = rng.multivariate_normal(
                np.nanmean(markers[t], axis=0), spread(markers[t]), drawn
            )
    both = np.concatenate([seen, ghosts], axis=1)
    label = np.append(np.arange(count), np.full(3 + lasting, -1))
    order = np.array([rng.permutation(len(label)) for _ in range(frames)])
    both = np.take_along_axis(both, order[..., None], axis=1)
    return Clouds.of(both, rate_hz, up_axis), label[order][np.isfinite(both).all(axis=2)]


def spread(points: np.ndarray) -> np.ndarray:
    """Covariance of a frame's points."""
    return np.cov(points[np.isfinite(points[:, 0])].T)


if __name__ == "__main__":
    main()
