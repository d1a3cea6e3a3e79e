"""Which of the shipped layouts points without names belong to: the one whose markers they lie on
best.
"""

import numpy as np

from habitus.body.model import BodyModel
from habitus.body.shipped_prior import prior_of
from habitus.errors import HabitusError
from habitus.fit.labels.clouds import Clouds, telling_frames
from habitus.fit.labels.recipe import misfit
from habitus.io.layouts.files import shipped_layouts
from habitus.markers.layouts import MarkerLayout

FRAMES = 4
UNLIKE = (0.6, 1.5)
CLEAR = 0.10


def choose_layout(body: BodyModel, clouds: Clouds) -> tuple[MarkerLayout, float]:
    """The shipped layout, with or without its extras, that a few frames fit best; and how sure that
    is, 0..1.

    Raises HabitusError where none has nearly as many markers as there are points.
    """
    frames = telling_frames(clouds, FRAMES)
    count = float(np.median(np.diff(clouds.start)[frames])) if len(frames) else 0.0
    candidates = [each for layout in shipped_layouts() for each in forms(layout)]
    candidates = [
        each for each in candidates if UNLIKE[0] < len(each) / max(count, 1.0) < UNLIKE[1]
    ]
    if not candidates:
        raise HabitusError(
            f"no shipped layout has nearly {count:.0f} markers; give the layout of these points, "
            "or a labelled capture "
            "of the same person (--like)"
        )
    costs = np.array([misfit(body, prior_of(body), each, clouds, frames) for each in candidates])
    best = int(np.argmin(costs))
    rivals = [
        cost
        for cost, each in zip(costs, candidates, strict=True)
        if each.name != candidates[best].name
    ]
    clear = 1.0 if not rivals else min(1.0, (min(rivals) / costs[best] - 1.0) / CLEAR)
    return candidates[best], round(float(clear), 3)


def forms(layout: MarkerLayout) -> list[MarkerLayout]:
    """The layout with its extras, and without where it has any."""
    core = tuple(marker.label for marker in layout.markers if not marker.optional)
    return [layout] if len(core) in (0, len(layout)) else [layout, layout.restricted_to(core)]
