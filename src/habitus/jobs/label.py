"""From points without names to a labelled capture: for ``habitus label``, ``habitus.label`` and
``mosh --label``.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from habitus.body.model import BodyModel
from habitus.body.prior import prior_of
from habitus.errors import HabitusError, listed
from habitus.export.trc import write_trc
from habitus.files import write_text
from habitus.fit.labels.clouds import Clouds, packed, telling_frames, tracklets
from habitus.fit.labels.people import only, people_on_ground
from habitus.fit.labels.recipe import Known, Named, label_people, label_points, misfit
from habitus.fit.labels.settings import LABELS, LabelSettings
from habitus.fit.markers.settings import MoshSettings
from habitus.fit.markers.subject import fit_subject
from habitus.io.captures.c3d_relabel import write_relabelled
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture, read_captures
from habitus.io.captures.unlabelled import UnlabelledCapture, read_unlabelled
from habitus.io.layouts.files import load_layout, shipped_layouts
from habitus.jobs.bodies import loaded
from habitus.jobs.options import LabelOptions, takes
from habitus.jobs.subjects import Person, person_of
from habitus.markers.layouts import MarkerLayout
from habitus.types import PathLike


@dataclass(frozen=True)
class LabelledCapture:
    """A capture whose points have names where these are likely.

    labels (M,) and markers (T, M, 3), metres, NaN where no point has the label; confidence (T, M),
    0..1, NaN there; others (T, K, 3): the points that were left without a name. ``report`` is what
    is written as JSON: of each label and of each piece of a trajectory, what it is called and how
    sure that is.
    """

    source: UnlabelledCapture
    labels: tuple[str, ...]
    markers: Float[np.ndarray, "T M 3"]
    confidence: Float[np.ndarray, "T M"]
    others: Float[np.ndarray, "T K 3"]
    report: dict[str, Any]

    @property
    def summary(self) -> str:
        """How much was labelled and how much is uncertain, in one line."""
        return self.report["summary"]

    def capture(self) -> Capture:
        """The labelled markers alone, as `habitus.mosh` takes them."""
        seen = np.isfinite(self.markers[..., 0]).any(axis=0)
        labels = tuple(self.labels[k] for k in np.flatnonzero(seen))
        source = self.source
        return Capture(
            source.name,
            labels,
            np.ascontiguousarray(self.markers[:, seen]),
            source.rate_hz,
            source.up_axis,
            warnings=(*source.warnings, self.summary),
            format=source.format,
            unit=source.unit,
        )

    def save(self, path: PathLike, source: PathLike | None = None) -> None:
        """Write a C3D or TRC file, and the report beside it as ``<name>.labels.json``.

        source: the C3D file that was labelled, of which all else is kept. Points without a name are
        ``*1``, ``*2``, … Raises HabitusError for another ending.
        """
        out = Path(path)
        _check_path(out)
        plain = self.capture()
        count = self.others.shape[1]
        names = (*plain.labels, *(f"*{k + 1}" for k in range(count)))
        points = np.concatenate([plain.markers, self.others], axis=1)
        if out.suffix.lower() == ".trc":
            write_trc(replace(plain, labels=names, markers=points), out)
        elif source is not None and Path(source).suffix.lower() == ".c3d":
            write_relabelled(source, self.source, names, points, out)
        else:
            write_c3d(replace(plain, labels=names, markers=points), out)
        write_text(out.with_suffix(".labels.json"), json.dumps(self.report, indent=1) + "\n")


@takes(LabelOptions)
def label(
    capture: PathLike | Capture, out: PathLike | None = None, *, options: LabelOptions
) -> LabelledCapture:
    """Label the points of a capture, whatever they were called; ``out`` receives the result.

    Raises HabitusError with one clear line on bad input.
    """
    people = options.people
    _check_people(people, options.like)
    if not 0.0 <= options.min_confidence <= 1.0:
        raise HabitusError(
            f"min_confidence = {options.min_confidence:g}; expected a confidence of 0 to 1"
        )
    if out is not None:
        _check_path(Path(out))
    source = (
        _anonymous(capture)
        if isinstance(capture, Capture)
        else read_unlabelled(capture, options.fps)
    )
    model = loaded(options.body)
    clouds = Clouds.of(source.points, source.rate_hz, source.up_axis)
    settings = options.settings or LABELS
    first = clouds
    if people > 1:
        pieces = tracklets(clouds, settings.tracklets)
        first = only(clouds, people_on_ground(clouds, pieces, people, settings.people) == 0)
    chosen, known, names, how = _reference(model, first, options.layout, options.like, settings)
    if people == 1:
        named: Named = label_points(model, prior_of(model), chosen, clouds, known, settings)
    else:
        named = label_people(model, prior_of(model), chosen, clouds, people, settings)
        names = tuple(f"person{k + 1}:{name}" for k in range(people) for name in names)
    notes = _alike(chosen) if options.like is None else ()
    source = replace(source, warnings=(*source.warnings, *notes))
    result = _labelled(source, clouds, names, named, options.min_confidence, settings, how)
    if out is not None:
        result.save(out, None if isinstance(capture, Capture) else capture)
    return result


def _check_people(people: int, like: object) -> None:
    if people < 1:
        raise HabitusError(f"people = {people}; expected how many are in the capture")
    if people > 1 and like is not None:
        raise HabitusError("--like supports one person, but the capture has several; use --layout")


def _check_path(out: Path) -> None:
    if out.suffix.lower() not in (".c3d", ".trc"):
        raise HabitusError(
            f"cannot write a labelled capture to {out}: expected a name that ends in .c3d or .trc"
        )


def _anonymous(capture: Capture) -> UnlabelledCapture:
    columns = tuple(range(len(capture.labels)))
    return UnlabelledCapture(
        capture.name,
        capture.markers,
        columns,
        capture.rate_hz,
        capture.up_axis,
        capture.unit,
        capture.format,
    )


def _reference(
    body: BodyModel,
    clouds: Clouds,
    layout: PathLike,
    like: PathLike | Capture | None,
    settings: LabelSettings,
) -> tuple[MarkerLayout, Known | None, tuple[str, ...], dict[str, Any]]:
    """The layout, the person where one is known, the labels in the layout's order, and where all
    that comes from.
    """
    if like is None:
        if os.fspath(layout) == "auto":
            chosen, confidence = choose_layout(body, clouds, settings)
            return (
                chosen,
                None,
                chosen.labels,
                {"layout": chosen.name, "layout_confidence": confidence},
            )
        chosen = load_layout(layout)
        return chosen, None, chosen.labels, {"layout": chosen.name}
    capture = like if isinstance(like, Capture) else read_captures(like)[0]
    whole = person_of([capture], layout)
    return *known_person(body, whole, settings.fit), {
        "layout": whole.layout.name,
        "like": capture.name,
    }


def known_person(
    body: BodyModel, whole: Person, settings: MoshSettings
) -> tuple[MarkerLayout, Known, tuple[str, ...]]:
    """A person whose shape and marker placements come from labelled captures, and what the markers
    are called there.
    """
    prior = prior_of(body).for_joints(body.joint_names)
    recording = whole.recordings[0]
    seen = np.isfinite(recording.observed[..., 0]).any(axis=0)
    markers = whole.layout.markers
    layout = replace(whole.layout, markers=tuple(markers[k] for k in np.flatnonzero(seen)))
    recording = replace(recording, observed=np.ascontiguousarray(recording.observed[:, seen]))
    subject = fit_subject(body, prior, layout, [recording], settings)
    names = list(layout.labels)
    for i, j in subject.exchanged:
        names[i], names[j] = names[j], names[i]
    shape = subject.shape
    return layout, Known(shape.betas, shape.attachment, shape.pose), tuple(names)


def _alike(layout: MarkerLayout) -> tuple[str, ...]:
    """A sentence about markers that a layout has at one place."""
    groups: dict[tuple[str, float], list[str]] = {}
    for marker in layout.markers:
        groups.setdefault((marker.place, round(marker.distance, 3)), []).append(marker.label)
    several = [", ".join(labels) for labels in groups.values() if len(labels) > 1]
    if not several:
        return ()
    return (
        f"{layout.name} has several markers at one place ({listed(several, 4, '; ')}): each is "
        "followed throughout, "
        "but which is called what is drawn by lot; give a labelled capture of the same person "
        "with --like",
    )


def _labelled(
    source: UnlabelledCapture,
    clouds: Clouds,
    names: tuple[str, ...],
    labels: Named,
    sure: float,
    settings: LabelSettings,
    how: dict[str, Any],
) -> LabelledCapture:
    """Points under their names, those less sure than asked for without."""
    named = np.where(labels.confidence >= sure, labels.label, -1)
    markers = clouds.labelled(named, len(names))
    confidence = np.full(markers.shape[:2], np.nan)
    confidence[clouds.frame[named >= 0], named[named >= 0]] = labels.confidence[named >= 0]
    others = packed(clouds, labels.tracklet, named < 0)
    report = _report(source, clouds, names, labels, named, settings.doubtful, how)
    return LabelledCapture(source, names, markers, confidence, others, report)


def _report(
    source: UnlabelledCapture,
    clouds: Clouds,
    names: tuple[str, ...],
    labels: Named,
    named: np.ndarray,
    doubtful_below: float,
    how: dict[str, Any],
) -> dict[str, Any]:
    known: Bool[np.ndarray, " P"] = named >= 0
    doubtful = known & (labels.confidence < doubtful_below)
    frames = np.bincount(named[known], minlength=len(names))
    count = max(1, len(named))
    worst = sorted(
        {str(names[i]) for i in np.unique(named[doubtful]) if np.mean(doubtful[named == i]) > 0.5}
    )
    absent = [name for name, seen in zip(names, frames, strict=True) if not seen]
    said = f"{known.mean():.1%} of {count} points labelled, {doubtful.sum() / count:.1%} doubtful"
    said += f" ({listed(worst, 6)})" if worst else ""
    said += f", {1.0 - known.mean():.1%} left without a label"
    said += f"; no point is {listed(absent, 6)}" if absent else ""
    return {
        "capture": source.name,
        **how,
        "frames": len(clouds),
        "points": len(named),
        "summary": said,
        "warnings": list(source.warnings),
        "convergence": labels.convergence._asdict(),
        "labels": {
            name: {
                "frames": int(frames[i]),
                "confidence": round(float(labels.confidence[named == i].mean()), 3)
                if frames[i]
                else None,
                "label_margin": round(float(labels.sure[i]), 3),
            }
            for i, name in enumerate(names)
        },
        "tracklets": _pieces(clouds, names, labels, named),
    }


def _pieces(
    clouds: Clouds, names: Sequence[str], labels: Named, named: np.ndarray
) -> list[dict[str, Any]]:
    """Each run of a tracklet under one label: its frames, label and confidence."""
    order = np.lexsort((clouds.frame, named, labels.tracklet))
    keys = np.stack([labels.tracklet[order], named[order]])
    first = np.flatnonzero((np.diff(keys, axis=1, prepend=-2) != 0).any(axis=0))
    last = np.append(first[1:], len(order)) - 1
    means = (
        np.add.reduceat(labels.confidence[order], first) / (last - first + 1) if len(order) else []
    )
    return [
        {
            "tracklet": int(keys[0, a]),
            "first_frame": int(clouds.frame[order[a]]),
            "last_frame": int(clouds.frame[order[b]]),
            "points": int(b - a + 1),
            "label": names[keys[1, a]] if keys[1, a] >= 0 else None,
            "confidence": round(float(mean), 3),
        }
        for a, b, mean in zip(first, last, means, strict=True)
    ]


def choose_layout(
    body: BodyModel, clouds: Clouds, settings: LabelSettings = LABELS
) -> tuple[MarkerLayout, float]:
    """The shipped layout, with or without its extras, that a few frames fit best; and how sure that
    is, 0..1.

    Raises HabitusError where none has nearly as many markers as there are points.
    """
    frames = telling_frames(clouds, settings.layout_frames)
    count = float(np.median(np.diff(clouds.start)[frames])) if len(frames) else 0.0
    candidates = [each for layout in shipped_layouts() for each in forms(layout)]
    candidates = [
        each
        for each in candidates
        if settings.layout_size[0] < len(each) / max(count, 1.0) < settings.layout_size[1]
    ]
    if not candidates:
        raise HabitusError(
            f"no shipped layout has nearly {count:.0f} markers; give the layout of these points, "
            "or a labelled capture "
            "of the same person (--like)"
        )
    costs = np.array(
        [misfit(body, prior_of(body), each, clouds, frames, settings) for each in candidates]
    )
    best = int(np.argmin(costs))
    rivals = [
        cost
        for cost, each in zip(costs, candidates, strict=True)
        if each.name != candidates[best].name
    ]
    clear = (
        1.0 if not rivals else min(1.0, (min(rivals) / costs[best] - 1.0) / settings.layout_margin)
    )
    return candidates[best], round(float(clear), 3)


def forms(layout: MarkerLayout) -> list[MarkerLayout]:
    """The layout with its extras, and without where it has any."""
    core = tuple(marker.label for marker in layout.markers if not marker.optional)
    return [layout] if len(core) in (0, len(layout)) else [layout, layout.restricted_to(core)]
