"""Layouts that are found by fitting a body to captures whose labels nobody has written down
(``--layout discover``).
"""

from collections.abc import Sequence

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.discover.recipe import discover
from habitus.fit.discover.result import Discovery
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout, shipped_layouts
from habitus.markers.layouts import Marker
from habitus.markers.matching import interpreted
from habitus.types import PathLike, Progress

DISCOVER = "discover"
_FRAMES = 2000  # of each capture that are looked at


def asks_to_discover(layout: object) -> bool:
    """Whether a layout that is asked for is to be found by fitting."""
    return isinstance(layout, str) and layout == DISCOVER


def check_layout(layout: PathLike, hold_out: Sequence[str] = (), every: int | None = None) -> None:
    """Raises HabitusError for a layout that is neither there nor to be found, and where markers are
    to be held out that would tell their own places.
    """
    if not asks_to_discover(layout) and str(layout) != "auto":
        load_layout(layout)
    if asks_to_discover(layout) and (hold_out or every is not None):
        raise HabitusError(
            "markers cannot be held out where their places are discovered, since each tells its "
            "own place; "
            "fit again with the layout.toml that was found"
        )


def discovered(
    captures: Sequence[Capture], body: BodyModel | None, progress: Progress
) -> Discovery:
    """The layout of all captures of a person together; labels that known layouts understand as a
    set help.

    Raises HabitusError, naming the captures, where there are too few labels.
    """
    assert body is not None
    labels = tuple(dict.fromkeys(label for capture in captures for label in capture.labels))
    markers = np.concatenate([_some_frames(capture, labels) for capture in captures])
    try:
        known = known_labels(labels, body)
        usual = shipped_layouts()
        return discover(body, prior_of(body), labels, markers, known, usual, progress)
    except HabitusError as error:
        raise HabitusError(f"{', '.join(capture.name for capture in captures)}: {error}") from error


def known_labels(labels: Sequence[str], body: BodyModel) -> dict[str, Marker]:
    """What some labels usually mean, by the layout that explains most of them and where others
    agree; on this body.
    """
    found = interpreted(labels, shipped_layouts()).found
    return {
        labels[column]: marker
        for column, marker in found.items()
        if set(marker.landmarks) <= set(body.landmarks)
    }


def _some_frames(capture: Capture, labels: Sequence[str]) -> np.ndarray:
    """(T, M, 3) evenly chosen frames with a column for each label, NaN where the capture lacks
    it.
    """
    step = max(1, -(-len(capture.markers) // _FRAMES))
    some = np.asarray(capture.markers[::step], dtype=float)
    markers = np.full((len(some), len(labels), 3), np.nan)
    markers[:, [labels.index(label) for label in capture.labels]] = some
    return markers
