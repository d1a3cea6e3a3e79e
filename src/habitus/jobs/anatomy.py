"""Joint angles of any body in motion, by a convention; of a marker fit with the person's own
landmarks, where markers sit on them.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from habitus.body.anatomical_angles import (
    AngleTable,
    anatomical_angles,
    without_segments,
)
from habitus.body.anatomy import SACRUM, SIDES, Anatomy
from habitus.body.motion import Moving
from habitus.errors import HabitusError
from habitus.export.mot import coordinates
from habitus.fit.markers.result import MarkerFit
from habitus.io.layouts.files import load_layout, match_layout

FROM_MARKERS = (
    ("left_asis", "right_asis"),
    ("left_psis", "right_psis"),
    (SACRUM,),
    *((f"{side}_{joint}_{end}",)
      for side in SIDES for joint in ("knee", "ankle") for end in ("lateral", "medial")),
)  # fmt: skip
"""Landmarks for which markers are taken, all of a set or none; elsewhere the template's agree
better with laboratories' angles."""
SACRAL = ("sacrum", "l5")
"""A marker between these stands for the middle of the posterior spines."""
PLACES = ("pelvis_tx", "pelvis_ty", "pelvis_tz")
VALIDATED = ("pelvis", "hip_flexion", "hip_adduction", "knee", "ankle", "elbow")
"""How names of OpenSim's coordinates begin that agree with its inverse kinematics."""


def anatomy_of(moving: Moving) -> Anatomy:
    """The landmarks of a motion's person. Raises HabitusError for a body without landmarks."""
    markers = _markers_on_landmarks(moving) if isinstance(moving, MarkerFit) else {}
    return Anatomy.of(moving.body, moving.betas, markers)


def angles(moving: Moving, convention: str = "isb") -> AngleTable:
    """Joint angles (degrees) by a convention: "isb" (Wu et al. 2002, 2005), "pig" (Plug-in Gait) or
    "opensim" (coordinates of Rajagopal's model, without its places).

    Angles of segments without markers are marked as not validated, and all angles of fits to other
    sensors: none were compared. Raises HabitusError for an unknown convention, and for a body
    without SMPL's joints or without landmarks.
    """
    if convention != "opensim":
        table = anatomical_angles(moving, anatomy_of(moving), convention)
    else:
        columns = {n: own for n, own in coordinates(moving).items() if n not in PLACES}
        validated = np.array([name.startswith(VALIDATED) for name in columns])
        values = np.column_stack(list(columns.values()))
        table = AngleTable(convention, moving.rate_hz, tuple(columns), values, validated, {})
    if not isinstance(moving, MarkerFit):
        return replace(table, validated=np.zeros(len(table.names), bool))
    names = moving.body.joint_names
    return without_segments(table, [names[k] for k in np.flatnonzero(moving.guessed.joints())])


def _markers_on_landmarks(fit: MarkerFit) -> Mapping[str, tuple[str, np.ndarray]]:
    """By landmark the label and the place at rest of the marker on it; markers under suspicion are
    left out, and so are all where the layout is not known by its name.
    """
    try:
        match = match_layout(fit.labels, layouts=[load_layout(fit.layout_name)])
    except HabitusError:
        return {}
    doubted = {suspect.label for suspect in fit.suspects if not suspect.corrected}
    found: dict[str, tuple[str, np.ndarray]] = {}
    for marker in match.layout.markers:
        sacral = marker.between is not None and marker.between[:2] == SACRAL
        landmark = SACRUM if sacral else marker.landmark
        if landmark is None or marker.label not in fit.labels or marker.label in doubted:
            continue
        place = np.asarray(fit.latent_markers[fit.labels.index(marker.label)], np.float64)
        found.setdefault(landmark, (marker.label, place))
    whole = [names for names in FROM_MARKERS if set(names) <= set(found)]
    return {name: found[name] for names in whole for name in names}
