"""A user's generic OpenSim model scaled to the person of marker fits, solved for each of their
captures, and checked on those that nothing was taken from (extra `opensim`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from habitus.body.anatomy import SACRUM, SIDES, Anatomy
from habitus.body.motion import BodyMotion
from habitus.body.segments import owners
from habitus.errors import HabitusError
from habitus.export.opensim_engine import (
    ROUGH,
    coordinate_names,
    inverse_dynamics,
    joint_centres,
    load_model,
    marker_bodies,
    read_table,
    rotational,
    save_model,
    track,
    with_markers,
)
from habitus.export.opensim_scaling import (
    ENDS,
    LANDMARKS,
    REFINEMENTS,
    TO_OPENSIM,
    Scaling,
    carriers,
    placed,
    scale_to,
)
from habitus.export.opensim_setup import MODEL, mot_text, write_opensim
from habitus.files import write_text
from habitus.fit.markers.result import MarkerFit
from habitus.fit.verdict import Bound, Range
from habitus.gait.analysis import GRAVITY
from habitus.gait.contacts import Contact, ForcePlate
from habitus.io.layouts.files import load_layout, match_layout
from habitus.io.limits import MAX_XML_BYTES, read_text_file, read_xml
from habitus.jobs.anatomy import SACRAL, anatomy_of
from habitus.markers.layouts import Marker, MarkerLayout
from habitus.markers.placements import is_free, sideless
from habitus.observe.markers import attach, default_markers
from habitus.observe.simulated_markers import carried_markers
from habitus.results.save import finite, write_json
from habitus.rotations import up_rotation
from habitus.types import PathLike

Places = Mapping[str, tuple[str, Float[np.ndarray, "3"]]]
"""By label a marker's body and its place (m) in the body's axes."""
KINEMATICS = "inverse_kinematics.mot"
DYNAMICS = "inverse_dynamics.sto"
CHECK = "check.json"
MARKERS = "marker_set.xml"
SCALES = "scale_factors.xml"
RMS_MM = Bound(10.0, 20.0)
"""Of markers in inverse kinematics: an expert's model with markers placed by hand is at 10.5 in the
benchmark, and above 20 OpenSim's guide calls a solution poor."""
LANDMARKS_MM = Bound(30.0, 60.0)
"""RMS of landmarks between the posed model and the person: its marker set is on other places."""
FACTORS = Range(0.75, 1.3)
"""Of bodies, against the median: beyond, a marker of the model is not where its label says."""
ARM = ("collar", "shoulder", "elbow", "wrist")
"""How names of the joints end that move an arm."""
PLACING_FRAMES = 120
"""Frames, at most, on which markers are placed: evenly over a trial, more change nothing."""


@dataclass(frozen=True, eq=False)
class ScaledModel:
    """A generic model scaled to a person, with the fits' markers on it. labels: of the markers, in
    order; source: the generic model's file name; mass: kg; placed_on: the capture that the markers
    were placed on, in frames before ``placed_until``; left_out: labels of the fits without a place;
    fit_joints_mm: the fit's own distances.
    """

    model: Any
    scaling: Scaling
    labels: tuple[str, ...]
    source: str
    mass: float
    placed_on: str
    placed_until: int
    left_out: tuple[str, ...]
    fit_joints_mm: Mapping[str, float]

    def joints_mm(self) -> dict[str, float]:
        """Distances between the model's joints (mm)."""
        centres = joint_centres(self.model)
        points = {
            f"{side}_{joint}": centres[f"{body}_{end}"]
            for side, end in ENDS.items()
            for joint, body in (("hip", "femur"), ("knee", "tibia"), ("ankle", "talus"))
            if f"{body}_{end}" in centres
        }
        return distances_mm(points)


def solve(
    scaled: ScaledModel,
    fit: MarkerFit,
    plates: Sequence[ForcePlate],
    contacts: Sequence[Contact],
    residual: Float[np.ndarray, "T 3"],
    folder: Path,
) -> dict[str, Any]:
    """Write OpenSim's folder of a capture with the scaled model, its inverse kinematics and, where
    forces are used, inverse dynamics; what the check of them says comes back, and is check.json.

    residual (T, 3): of the gait analysis, whose known frames have all contacts on plates. folder:
    is there. Raises HabitusError where OpenSim fails or the folder cannot be written.
    """
    files = write_opensim(fit, plates, contacts, folder, without=scaled.left_out)
    paths = (folder / name for name in (MODEL, MARKERS, SCALES))
    save_model(scaled.model, scaled.scaling.factors, *paths)
    labels = tuple(label for label in scaled.labels if label in fit.labels)
    observed = upright_markers(fit, labels)
    posed = track(scaled.model, labels, observed, fit.rate_hz)
    times = np.arange(fit.num_frames) / fit.rate_hz
    units = np.where(rotational(scaled.model), np.degrees(1.0), 1.0)
    columns = (posed.coordinates * units).T
    table = dict(zip(coordinate_names(scaled.model), columns, strict=True))
    write_text(folder / KINEMATICS, mot_text("Coordinates", times, table))
    share = None
    if "inverse_dynamics.xml" in files:
        inverse_dynamics(folder / "inverse_dynamics.xml")
        share = _residual_share(scaled, folder / DYNAMICS, times, residual)
    off = 1e3 * np.linalg.norm(posed.markers - observed, axis=2)
    found = finite(_check(scaled, fit, labels, off, share))
    write_json(folder / CHECK, found)
    return found


def _residual_share(
    scaled: ScaledModel,
    path: Path,
    times: Float[np.ndarray, " T"],
    residual: Float[np.ndarray, "T 3"],
) -> float | None:
    """Mean force on the pelvis that nothing exerts, as a share of the body weight, in frames all of
    whose contacts are on plates.
    """
    at, forces = read_table(path)
    names = [f"pelvis_t{axis}_force" for axis in "xyz"]
    known = np.isfinite(residual).all(1) & (times >= at[0]) & (times <= at[-1])
    if not known.any() or any(name not in forces for name in names):
        return None
    own = np.stack([np.interp(times[known], at, forces[name]) for name in names], 1)
    return float(np.linalg.norm(own, axis=1).mean() / (GRAVITY * scaled.mass))


def _check(
    scaled: ScaledModel,
    fit: MarkerFit,
    labels: Sequence[str],
    off: Float[np.ndarray, "T M"],
    share: float | None,
) -> dict[str, Any]:
    """The numbers of a trial. off (T, M): distances (mm) of markers in inverse kinematics."""
    placing = fit.capture_name == scaled.placed_on
    unused = off[scaled.placed_until :] if placing else off
    scaling = scaled.scaling
    found = {
        "fit_verdict": fit.verdict.level,
        "generic_model": scaled.source,
        "mass_kg": scaled.mass,
        "markers_placed_on": scaled.placed_on,
        "marker_rms_mm": _rms(off),
        "marker_max_mm": float(np.nanmax(off)) if np.isfinite(off).any() else None,
        "unused_frames_marker_rms_mm": _rms(unused),
        "unused_frames": len(unused),
        "marker_rms_mm_by_label": {
            label: _rms(column) for label, column in zip(labels, off.T, strict=True)
        },
        "markers_left_out": list(scaled.left_out),
        "measures": {
            name: {"person_mm": 1e3 * mine, "generic_model_mm": 1e3 * its}
            for name, (mine, its) in scaling.measures.items()
        },
        "scale_factors": {body: list(own) for body, own in scaling.factors.items()},
        "landmark_rms_mm": 1e3 * scaling.landmark_error,
        "joints_mm": {"scaled_model": scaled.joints_mm(), "fit": dict(scaled.fit_joints_mm)},
        "residual_share_of_weight": share,
    }
    return {"verdict": _verdict(found)} | found


def _verdict(found: Mapping[str, Any]) -> dict[str, Any]:
    """How far the scaled model can be trusted: level and reasons."""
    reasons: list[tuple[str, str]] = []
    rms, landmarks = found["unused_frames_marker_rms_mm"], found["landmark_rms_mm"]
    if rms is None:
        what = "no other frames than those the markers were placed on: their error shows little"
        reasons.append(("doubtful", f"This trial has {what}; see the check of another trial."))
    else:
        level = _level(rms, RMS_MM)
        what = f"Markers are {rms:.1f} mm (RMS) off in frames that nothing was taken from"
        reasons.append((level, f"{what}. This judges their places more than lengths of bones."))
    if found["fit_verdict"] != "good":
        reasons.append(("doubtful", f"The fit of this capture is {found['fit_verdict']}."))
    level = _level(landmarks, LANDMARKS_MM)
    if level != "good":
        what = f"the model's landmarks are {landmarks:.0f} mm (RMS) from the person's"
        reasons.append((level, f"After scaling {what}: are its markers where their labels say?"))
    factors = found["scale_factors"]
    middle = float(np.median(list(factors.values())))
    least, most = middle * FACTORS.least, middle * FACTORS.most
    wide = [body for body, own in factors.items() if min(own) < least or max(own) > most]
    if wide:
        what = f"Scale factors of {', '.join(wide)} are far from the others (median {middle:.2f})"
        reasons.append(("doubtful", f"{what}: are the model's markers where their labels say?"))
    levels = [level for level, _ in reasons]
    worst = next(level for level in ("failed", "doubtful", "good") if level in levels)
    return {"level": worst, "reasons": [text for _, text in reasons]}


def _level(value: float, bound: Bound) -> str:
    if value > bound.failed:
        return "failed"
    return "doubtful" if value > bound.doubtful else "good"


def _rms(off: Float[np.ndarray, "..."]) -> float | None:
    known = off[np.isfinite(off)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else None


def distances_mm(points: Mapping[str, Float[np.ndarray, "3"]]) -> dict[str, float]:
    """Distances (mm) between the hips, and along each leg from joint to joint."""
    pairs = [("left_hip", "right_hip")]
    pairs += [
        (f"{side}_{one}", f"{side}_{other}")
        for side in SIDES
        for one, other in (("hip", "knee"), ("knee", "ankle"))
    ]
    return {
        f"{one} to {other}": 1e3 * float(np.linalg.norm(points[one] - points[other]))
        for one, other in pairs
        if one in points and other in points
    }


def scaled_model(
    fits: Sequence[MarkerFit],
    model: PathLike,
    mass: float,
    marker_set: PathLike | None = None,
    placing: int = 0,
) -> ScaledModel:
    """A generic model (.osim) scaled to the person of these fits, with their markers on it.

    marker_set: an .xml with the markers of a model that has none. mass: kg. placing: which fit's
    capture the markers are placed on: its first half where it is the only one. Raises HabitusError
    where fits are of several shapes, opensim is not installed, or the model is none that can be
    scaled.
    """
    fit = fits[placing]
    if any(not np.array_equal(one.betas, fit.betas) for one in fits):
        raise HabitusError(
            "the results have different body shapes, and one model is scaled to one person; fit "
            "the captures of a person in one run"
        )
    path = _checked(model)
    extra = None if marker_set is None else _checked(marker_set)
    generic = load_model(path, extra)
    landmarks = _model_landmarks(tuple(marker_bodies(generic)), path.name)
    own = _own_layout(fit)
    person = _person(fit, landmarks.values(), own)
    names = {marker.label: place_name(marker) for marker in landmarks.values()}
    scaling = scale_to(generic, names, person, mass, path.name)
    carried = _carried(fit, own, marker_bodies(generic), scaling.bodies)
    until = fit.num_frames if len(fits) > 1 else max(1, fit.num_frames // 2)
    markers = _placed_markers(fit, scaling, carried, until)
    return ScaledModel(
        with_markers(scaling.model, markers),
        scaling,
        tuple(markers),
        path.name,
        mass,
        fit.capture_name,
        until,
        tuple(label for label in fit.labels if label not in markers),
        _fit_joints(fit),
    )


def _checked(path: PathLike) -> Path:
    """A file of OpenSim's, after a look by the project's own reader."""
    own = Path(path)
    try:
        root = read_xml(read_text_file(own, MAX_XML_BYTES))
    except (OSError, UnicodeDecodeError, HabitusError) as error:
        raise HabitusError(f"{own}: {error}; expected a file of OpenSim's") from error
    if root.tag != "OpenSimDocument":
        raise HabitusError(f"{own} holds <{root.tag}>; expected an <OpenSimDocument>")
    return own


def place_name(marker: Marker) -> str:
    """A marker's place; the middle of the posterior spines under its own name."""
    sacral = marker.between is not None and marker.between[:2] == SACRAL
    return SACRUM if sacral else marker.place


def _model_landmarks(labels: Sequence[str], name: str) -> dict[str, Marker]:
    """A model's markers on landmarks, by label."""
    try:
        match = match_layout(labels)
    except HabitusError as error:
        raise HabitusError(
            f"{name}: no shipped layout knows the labels of its {len(labels)} markers; expected a "
            "model with a marker set of known labels, or one beside it (--opensim-markers)"
        ) from error
    return {
        m.label: m
        for m in match.layout.markers
        if not is_free(m) and sideless(place_name(m)) in LANDMARKS
    }


def _own_layout(fit: MarkerFit) -> dict[str, Marker]:
    """A fit's markers whose places are known, by label; none where its layout is not."""
    try:
        match = match_layout(fit.labels, layouts=[load_layout(fit.layout_name)])
    except HabitusError:
        return {}
    return {m.label: m for m in match.layout.markers if m.label in fit.labels}


def _doubted(fit: MarkerFit) -> set[str]:
    return {suspect.label for suspect in fit.suspects if not suspect.corrected}


def _person(fit: MarkerFit, wanted: Any, own: Mapping[str, Marker]) -> dict[str, np.ndarray]:
    """Places (m), in OpenSim's axes and the stance, of markers on the wanted landmarks, and the
    hips by regression: the fit's latent markers where it has one there, else virtual markers.
    """
    anatomy = anatomy_of(fit)
    markers = tuple(wanted)
    layout = MarkerLayout("wanted", markers)
    which = layout.vertices(fit.body)
    skin = np.asarray(fit.body.rest_vertices(fit.betas))[which]
    virtual = default_markers(fit.body, np.asarray(fit.betas), which, layout.distances())
    places: dict[str, np.ndarray] = {}
    for marker, bare, out in zip(markers, skin, virtual, strict=True):
        base = anatomy.landmarks.get(marker.place)
        moved = base is not None and marker.place not in anatomy.sources and marker.shift is None
        places[place_name(marker)] = out - bare + base if moved else out
    if SACRUM not in places:
        places[SACRUM] = anatomy.landmarks[SACRUM]
    doubted = _doubted(fit)
    for label, marker in own.items():
        if place_name(marker) in places and label not in doubted and not is_free(marker):
            places[place_name(marker)] = fit.latent_markers[fit.labels.index(label)]
    stand = dict(zip(places, in_stance(fit, np.stack(list(places.values()))), strict=True))
    hips = {f"{side}_hip": TO_OPENSIM @ anatomy.harrington_hip(side) for side in SIDES}
    return stand | hips


def in_stance(fit: MarkerFit, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points on the skin at rest (m) in OpenSim's axes where the person stands as at rest, but with
    the arms as in the middle of the motion: shoulders move with them, and a model's do not.
    """
    names = fit.body.joint_names
    arms = [k for k, name in enumerate(names) if name.endswith(ARM)]
    pose = np.zeros((1, len(names), 3))
    pose[0, arms] = np.median(fit.pose[:, arms], axis=0)
    place = fit.body, fit.betas, pose, np.zeros((1, 3)), fit.rate_hz, "+y"
    skin = np.asarray(fit.body.rest_vertices(fit.betas))
    attachment = attach(np.asarray(places, np.float64), skin, fit.body.faces)
    return carried_markers(BodyMotion(*place), attachment)[0] @ TO_OPENSIM.T


def _carried(
    fit: MarkerFit, own: Mapping[str, Marker], model: Mapping[str, str], bodies: Sequence[str]
) -> dict[str, str]:
    """By label the model's body that carries it; suspect markers are left out."""
    surface = np.asarray(fit.body.rest_vertices(fit.betas))
    owner = owners(fit.body, surface, np.asarray(fit.body.rest_joints(fit.betas)))
    strongest = np.argmax(fit.attachment.coefficients[:, :3], axis=1)
    corner = fit.attachment.triangles[np.arange(len(fit.labels)), strongest]
    joints = [fit.body.joint_names[k] for k in owner[corner]]
    places = [place_name(own[label]) if label in own else "" for label in fit.labels]
    found = carriers(joints, places, [model.get(label) for label in fit.labels], bodies)
    doubted = _doubted(fit)
    return {
        label: body
        for label, body in zip(fit.labels, found, strict=True)
        if body is not None and label not in doubted
    }


def upright_markers(fit: MarkerFit, labels: Sequence[str]) -> Float[np.ndarray, "T M 3"]:
    """Observed markers of these labels, m, y up, as in the .trc; NaN where missing."""
    columns = [fit.labels.index(label) for label in labels]
    return fit.observed_markers[:, columns] @ up_rotation(fit.up_axis).T


def _placed_markers(
    fit: MarkerFit, scaling: Scaling, carried: Mapping[str, str], until: int
) -> Places:
    """Markers on the scaled model: the latent ones, the model in the person's stance, refined."""
    columns = [fit.labels.index(label) for label in carried]
    carrier = [scaling.bodies.index(body) for body in carried.values()]
    latent = in_stance(fit, np.asarray(fit.latent_markers)[columns])
    places = placed(scaling.turns[None], scaling.origins[None], latent[None], carrier)
    return refined(scaling.model, _by_label(carried, places), fit, until)


def refined(model: Any, markers: Places, fit: MarkerFit, until: int) -> Places:
    """Markers where inverse kinematics of frames before ``until`` has each on average in its body,
    in `REFINEMENTS` rounds.
    """
    carried = {label: body for label, (body, _) in markers.items()}
    bodies = tuple(dict.fromkeys(carried.values()))
    carrier = [bodies.index(body) for body in carried.values()]
    rows = np.unique(np.linspace(0, until - 1, min(until, PLACING_FRAMES)).round().astype(int))
    observed = upright_markers(fit, tuple(carried))[rows]
    for _ in range(REFINEMENTS):
        own = with_markers(model, markers)
        posed = track(own, tuple(carried), observed, fit.rate_hz, bodies, ROUGH)
        again = placed(posed.turns, posed.origins, observed, carrier)
        places = np.stack([place for _, place in markers.values()])
        markers = _by_label(carried, np.where(np.isfinite(again), again, places))
    return markers


def _by_label(carried: Mapping[str, str], places: Float[np.ndarray, "M 3"]) -> Places:
    return {label: (body, p) for (label, body), p in zip(carried.items(), places, strict=True)}


def _fit_joints(fit: MarkerFit) -> dict[str, float]:
    anatomy: Anatomy = anatomy_of(fit)
    names = [f"{side}_{joint}" for side in SIDES for joint in ("hip", "knee", "ankle")]
    return distances_mm({name: anatomy.centre(name) for name in names})
