"""Do angles, centres, events, forces and moments agree with what laboratories have?

    python benchmarks/gait.py CAPTURE ... [--out FILE]

CAPTURE: C3D files whose points hold Plug-in Gait's outputs, captures of one person named alike but
for their last two characters (HC030A05, HC030A22). Rows:

- angles: against Plug-in Gait's, degrees: RMS, RMS after a constant offset of the trial and side
  (RMS0), Pearson's r, and the standard deviation of a person's offset between trials.
- centres: knees against the middle of markers on both epicondyles, mm, where a file has them.
- hips: against the functional centre of a trial (--hip) that moves the hip about, mm.
- events: strikes and offs by the motion alone against plates, ms.
- forces: the residual of Newton's equation, % of body weight, and refused contacts.
- partial hits: made from whole contacts, and how many are refused.
- moments: against Plug-in Gait's in stances whose forces are used, Nm/kg.
"""

import argparse
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
from common import parser, run, show_table

import habitus as hb
from habitus.body.anatomical_angles import segment_rotations
from habitus.body.segments import owners
from habitus.gait.analysis import analyse
from habitus.io.layouts.files import load_layout, match_layout
from habitus.jobs.anatomy import anatomy_of, angles
from habitus.jobs.gait import gait
from habitus.rotations import procrustes

ANGLES = {
    "pelvis_tilt": ("PelvisAngles", 0),
    "pelvis_obliquity": ("PelvisAngles", 1),
    "pelvis_rotation": ("PelvisAngles", 2),
    "hip_flexion": ("HipAngles", 0),
    "hip_adduction": ("HipAngles", 1),
    "hip_internal_rotation": ("HipAngles", 2),
    "knee_flexion": ("KneeAngles", 0),
    "knee_adduction": ("KneeAngles", 1),
    "ankle_dorsiflexion": ("AnkleAngles", 0),
    "thorax_tilt": ("ThoraxAngles", 0),
    "spine_flexion": ("SpineAngles", 0),
    "shoulder_flexion": ("ShoulderAngles", 0),
    "elbow_flexion": ("ElbowAngles", 0),
}
MOMENTS = {
    "ankle_plantarflexion": "AnkleMoment",
    "knee_extension": "KneeMoment",
    "hip_extension": "HipMoment",
}


def outputs(path: Path) -> dict[str, np.ndarray]:
    """The points (T, 3) of a file by the ends of their labels, NaN where all is zero."""
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    keys = sorted((k for k in point if k.startswith("LABELS")), key=lambda k: (len(k), k))
    labels = [label for key in keys for label in point[key]["value"]]
    points = file["data"]["points"][:3].transpose(1, 2, 0)
    gone = np.abs(points).sum(-1, keepdims=True) == 0.0
    points = np.where(gone, np.nan, points)
    return {label.split(":")[-1]: own for label, own in zip(labels, points, strict=False)}


def angle_rows(fits: dict[Path, object]) -> list[dict]:
    """A row for each angle, trial and side."""
    rows = []
    for path, fit in fits.items():
        table, theirs = angles(fit, "pig"), outputs(path)
        for name, (label, axis) in ANGLES.items():
            for side in ("left", "right"):
                reference = theirs.get(side[0].upper() + label)
                if reference is None:
                    continue
                off = table[f"{side}_{name}"][: len(reference)] - reference[:, axis]
                known = np.isfinite(off)
                if known.sum() < 20:
                    continue
                off = off[known] - 360.0 * np.round(np.median(off[known]) / 360.0)
                own = table[f"{side}_{name}"][: len(reference)][known]
                rows.append(
                    {"angle": name, "trial": path.stem, "person": path.stem[:-2], "side": side}
                    | {"RMS": float(np.sqrt((off**2).mean())), "RMS0": float(off.std())}
                    | {"offset": float(off.mean())}
                    | {"r": float(np.corrcoef(own, reference[known, axis])[0, 1])}
                )
    return rows


def angle_table(rows: list[dict]) -> dict[str, dict]:
    """Means over trials and sides, and how a person's offset repeats."""
    out = {}
    for name in ANGLES:
        own = [row for row in rows if row["angle"] == name]
        groups = defaultdict(list)
        for row in own:
            groups[row["person"], row["side"]].append(row["offset"])
        again = [np.var(v, ddof=1) for v in groups.values() if len(v) > 1]
        if own:
            means = {key: float(np.mean([row[key] for row in own])) for key in ("RMS", "RMS0", "r")}
            between = float(np.sqrt(np.mean(again))) if again else float("nan")
            out[name] = {"n": len(own), **means, "offset SD within": between}
    return out


def knee_rows(fits: dict[Path, object]) -> list[dict]:
    """The knee's centre against the middle of its two markers, median over frames."""
    rows = []
    for path, fit in fits.items():
        match = match_layout(fit.labels, layouts=[load_layout(fit.layout_name)])
        at = {m.landmark: m.label for m in match.layout.markers if m.landmark}
        anatomy = anatomy_of(fit)
        turns = segment_rotations(fit, anatomy, "isb", fit.pose)
        joints = fit.joints()
        for side in ("left", "right"):
            pair = [at.get(f"{side}_knee_{end}") for end in ("lateral", "medial")]
            if any(label not in fit.labels for label in pair):
                continue
            columns = [fit.labels.index(label) for label in pair]
            middle = fit.observed_markers[:, columns].mean(1)
            hip = fit.body.joint_names.index(f"{side}_hip")
            arm = anatomy.centre(f"{side}_knee") - anatomy.joints[f"{side}_hip"]
            frame = anatomy.frame(f"{side}_thigh")
            centre = joints[:, hip] + turns[f"{side}_thigh"].apply(frame.T @ arm)
            off = 1e3 * np.linalg.norm(centre - middle, axis=1)
            rows.append({"trial": path.stem, "side": side, "knee mm": float(np.nanmedian(off))})
    return rows


NEAR_HIP = 0.12
"""Metres of markers from the hip whose skin slides over the trochanter and in the groin."""


def rigid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turns and shifts (T, …) of markers (T, M, 3) that move as one, NaN where one is missing."""
    known = np.isfinite(points).all((1, 2))
    turn, shift = np.full((len(points), 3, 3), np.nan), np.full((len(points), 3), np.nan)
    first = np.broadcast_to(points[known][0], points[known].shape)
    turn[known], shift[known] = procrustes(first, points[known], np.ones(first.shape[:2]))
    return turn, shift


def hip_rows(path: Path, side: str) -> list[dict]:
    """The hip's centre against the functional one of a trial that moves this hip about (SCoRE, Ehrig
    et al. 2006), by markers on the iliac spines and on the thigh away from the hip; Harrington's
    regression beside it.
    """
    fit = hb.mosh(path)[0]
    names = fit.body.joint_names
    surface = fit.body.rest_vertices(fit.betas)
    owner = owners(fit.body, surface, fit.body.rest_joints(fit.betas))
    near = np.linalg.norm(fit.latent_markers[:, None] - surface, axis=-1).argmin(1)
    part = np.array([names[k] for k in owner[near]])
    hip = fit.body.rest_joints(fit.betas)[names.index(f"{side}_hip")]
    far = np.linalg.norm(fit.latent_markers - hip, axis=1) > NEAR_HIP
    spines = [label for name, label in anatomy_of(fit).sources.items() if name.endswith("is")]
    pelvis = rigid(fit.observed_markers[:, [fit.labels.index(label) for label in spines]])
    thigh = rigid(fit.observed_markers[:, (part == f"{side}_hip") & far])
    known = np.isfinite(pelvis[1]).all(1) & np.isfinite(thigh[1]).all(1)
    matrix = np.concatenate([pelvis[0][known], -thigh[0][known]], 2).reshape(-1, 6)
    right = (thigh[1] - pelvis[1])[known].reshape(-1)
    own = np.linalg.lstsq(matrix, right, rcond=None)[0]
    ends = [t @ c + s for (t, s), c in zip((pelvis, thigh), (own[:3], own[3:]), strict=True)]
    functional = 0.5 * (ends[0] + ends[1])
    anatomy, joints = anatomy_of(fit), fit.joints()
    axes = segment_rotations(fit, anatomy, "isb", fit.pose)["pelvis"]
    arm = anatomy.frame("pelvis").T @ (anatomy.harrington_hip(side) - anatomy.joints["pelvis"])
    centres = {
        "the body's": joints[:, names.index(f"{side}_hip")],
        "Harrington's": joints[:, 0] + axes.apply(arm),
    }
    apart = 1e3 * float(np.nanmedian(np.linalg.norm(ends[0] - ends[1], axis=1)))
    return [
        {"trial": path.stem, "side": side, "hip centre": name, "SCoRE's residual mm": apart}
        | {"to SCoRE mm": 1e3 * float(np.nanmedian(np.linalg.norm(c - functional, axis=1)))}
        for name, c in centres.items()
    ]


def gait_rows(fits: dict[Path, object]) -> tuple[list[dict], list[dict], list[dict]]:
    """Residuals, events against plates, and moments."""
    forces, events, moments = [], [], []
    for path, fit in fits.items():
        analysis, blind = gait(fit, path), gait(fit)
        if not analysis.contacts:
            continue
        share, bias = analysis.residual_share, analysis.vertical_bias
        refused = [f"plate {c.plate}: {c.refused}" for c in analysis.contacts if c.refused]
        forces.append(
            {"trial": path.stem, "contacts": len(analysis.contacts), "refused": "; ".join(refused)}
            | {"residual %": float("nan") if share is None else 100 * share}
            | {"vertical bias %": float("nan") if bias is None else 100 * bias}
        )
        table = dict(zip(analysis.dynamics.names, analysis.dynamics.values.T, strict=True))
        theirs = outputs(path)
        for contact in analysis.contacts:
            if contact.refused:
                continue
            own = blind.events[contact.side]
            for kind, time, found in (
                ("strike", contact.start, own.strikes), ("off", contact.end, own.offs)
            ):  # fmt: skip
                if time is not None and len(found):
                    late = 1e3 * float(found[np.abs(found - time).argmin()] - time)
                    events.append({"trial": path.stem, "event": kind, "late ms": late})
            rate = analysis.rate_hz
            last = np.inf if contact.end is None else contact.end * rate
            rows = slice(int((contact.start or 0.0) * rate), int(min(last, len(fit.pose))))
            for name, label in MOMENTS.items():
                reference = theirs.get(contact.side[0].upper() + label)
                if reference is None:
                    continue
                off = table[f"{contact.side}_{name}_moment"][rows] - 1e-3 * reference[rows, 0]
                known = np.isfinite(off)
                if known.sum() > 10:
                    rms = float(np.sqrt((off[known] ** 2).mean()))
                    moments.append({"trial": path.stem, "moment": name, "RMS Nm/kg": rms})
    return forces, events, moments


def partial_rows(fits: dict[Path, object]) -> list[dict]:
    """Made partial hits: a plate shows less than it bears, in half of a contact or in all of it.
    Contacts are those that are used as recorded; their edges say nothing of what was made.
    """
    rows = []
    for path, fit in fits.items():
        if not any(label.endswith("KneeAngles") for label in outputs(path)):
            continue
        whole = gait(fit, path)
        for number, plate in enumerate(whole.plates):
            used = [c for c in whole.contacts if c.plate == plate.number]
            before = {c.plate for c in whole.contacts if c.refused}
            if len(used) != 1 or used[0].refused:
                continue
            loaded = np.flatnonzero(np.isfinite(plate.pressure[:, 0]))
            first, last = int(loaded[0]), int(loaded[-1])
            middle = (first + last) // 2
            parts = {"early": (first, middle), "late": (middle, last), "whole": (first, last)}
            for part, (one, other) in parts.items():
                for lost in (0.2, 0.35, 0.5):
                    factor = np.ones((len(plate.force), 1))
                    factor[one:other] = 1.0 - lost
                    plates = list(whole.plates)
                    plates[number] = replace(plate, force=factor * plate.force)
                    again = analyse(
                        fit, anatomy_of(fit), whole.angles, whole.masses, plates, whole.events
                    )
                    refused = {c.plate for c in again.contacts if c.refused}
                    rows.append(
                        {"trial": path.stem, "plate": plate.number, "part": part, "lost": lost}
                        | {"found": plate.number in refused}
                        | {"others refused": len(refused - before - {plate.number})}
                    )
    return rows


def measure(options: argparse.Namespace) -> dict:
    """All tables."""
    fits = {path: hb.mosh(path)[0] for path in options.captures}
    rows = angle_rows(fits)
    forces, events, moments = gait_rows(fits)
    partial = partial_rows(fits)
    by_event = {
        f"foot {kind}": {
            "n": len(own),
            "median ms": float(np.median(own)),
            "SD ms": float(np.std(own, ddof=1)),
        }
        for kind in ("strike", "off")
        if len(own := [row["late ms"] for row in events if row["event"] == kind]) > 1
    }
    by_moment = {
        name: {"n": len(own), "RMS Nm/kg": float(np.mean(own))}
        for name in MOMENTS
        if (own := [row["RMS Nm/kg"] for row in moments if row["moment"] == name])
    }
    return {
        "angles": angle_table(rows),
        "knees": knee_rows(fits),
        "hips": [] if options.hip is None else hip_rows(options.hip, options.hip_side),
        "events": by_event,
        "forces": {row["trial"]: row for row in forces},
        "moments": by_moment,
        "partial hits": {
            "made": len(partial),
            "found": sum(row["found"] for row in partial),
            "whole contacts": len({(row["trial"], row["plate"]) for row in partial}),
            "others refused": sum(row["others refused"] > 0 for row in partial),
        },
        "rows": {"angles": rows, "events": events, "moments": moments},
    }


def show(found: dict) -> None:
    """Print the tables."""

    def named(table: dict) -> list[dict]:
        return [{"": name, **row} for name, row in table.items()]

    show_table("angles against Plug-in Gait, degrees", named(found["angles"]), 2)
    show_table("knee centre against the middle of epicondyle markers", found["knees"], 1)
    if found["hips"]:
        show_table("hip centre against a functional one", found["hips"], 1)
    show_table("events by the motion against plates", named(found["events"]), 1)
    show_table("plates against what the motion needs", list(found["forces"].values()), 1)
    show_table("made partial hits", [found["partial hits"]])
    show_table("sagittal moments against Plug-in Gait", named(found["moments"]), 3)


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("captures", nargs="+", type=Path)
    arguments.add_argument("--hip", type=Path, default=None, help="a functional trial of a hip")
    arguments.add_argument("--hip-side", choices=("left", "right"), default="right")
    run(arguments, measure, show)
