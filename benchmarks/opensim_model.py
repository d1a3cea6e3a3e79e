"""Does a generic OpenSim model that habitus scales follow markers as well as an expert's?

    python benchmarks/opensim_model.py SUBJECT [--captures C3D ...] [--out FILE]

SUBJECT: a folder with MarkerData/NAME.trc and Models/unscaled_generic.osim, manually_scaled.osim
(an expert's) and optimized_scale_and_markers.osim (AddBiomechanics'), such as data/grf/Subject4 of
github keenon/nimblephysics (MIT). Rows:

- trials: RMS of markers in OpenSim's inverse kinematics, mm, with each model, of the markers that
  all models have. Ours has its markers placed on the first trial alone; "expert, placed" is the
  expert's model with its markers placed in the same way, which tells scaling from placing.
- joints: distances between joints, mm, of each model and of the fit.
- captures (with force plates, --captures; one person): the residual of inverse dynamics, % of body
  weight, with the generic model scaled to that person, and habitus' own without a model.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from common import parser, run, show_table

import habitus as hb
from habitus.export.opensim_engine import (
    joint_centres,
    load_model,
    marker_bodies,
    track,
    with_markers,
)
from habitus.export.opensim_scaling import ENDS
from habitus.jobs.gait import gaits
from habitus.jobs.opensim import distances_mm, refined, scaled_model, upright_markers

TRIALS = ("walking1", "walkingTS1", "walking2", "walking4", "walkingTI1", "walkingTO1")
OTHERS = {"expert": "manually_scaled", "AddBiomechanics": "optimized_scale_and_markers"}
MASS = 62.6
"""Of Subject4, kg (Models/rescaling_setup.xml)."""


def errors_mm(model: object, fit: object, labels: tuple[str, ...]) -> np.ndarray:
    """Distances (T, M) of markers in inverse kinematics."""
    observed = upright_markers(fit, labels)
    posed = track(model, labels, observed, fit.rate_hz)
    return 1e3 * np.linalg.norm(posed.markers - observed, axis=2)


def rms(off: np.ndarray) -> float:
    """Root mean square over what is seen."""
    return float(np.sqrt(np.nanmean(off**2)))


def joints_mm(model: object) -> dict[str, float]:
    """Distances between the joints of a model."""
    centres = joint_centres(model)
    return distances_mm(
        {
            f"{side}_{joint}": centres[f"{body}_{end}"]
            for side, end in ENDS.items()
            for joint, body in (("hip", "femur"), ("knee", "tibia"), ("ankle", "talus"))
        }
    )


def placed_again(model: object, fit: object) -> object:
    """A model with its own markers placed as ours are."""
    places = {
        marker.getName(): (
            marker.getParentFrame().findBaseFrame().getName(),
            marker.get_location().to_numpy(),
        )
        for marker in model.getMarkerSet()
        if marker.getName() in fit.labels
    }
    return with_markers(model, refined(model, places, fit, fit.num_frames))


def measure(options: argparse.Namespace) -> dict:
    """All tables."""
    models = options.subject / "Models"
    generic = models / "unscaled_generic.osim"
    fits = hb.mosh([options.subject / "MarkerData" / f"{name}.trc" for name in options.trials])
    ours = scaled_model(fits, generic, options.mass)
    others = {name: load_model(models / f"{file}.osim") for name, file in OTHERS.items()}
    others["expert, placed"] = placed_again(others["expert"], fits[0])
    shared = tuple(
        label
        for label in ours.labels
        if all(label in marker_bodies(model) for model in others.values())
    )
    trials = []
    for fit in fits:
        own = errors_mm(ours.model, fit, ours.labels)
        part = own[:, [ours.labels.index(label) for label in shared]]
        row = {"trial": fit.capture_name}
        row["used"] = "markers placed" if fit.capture_name == ours.placed_on else "no"
        row |= {"habitus": rms(part)}
        row |= {name: rms(errors_mm(model, fit, shared)) for name, model in others.items()}
        row |= {"habitus, all markers": rms(own), "habitus, worst sample": float(np.nanmax(own))}
        trials.append(row)
    lengths = {"habitus": ours.joints_mm()}
    lengths |= {name: joints_mm(others[name]) for name in OTHERS}
    lengths |= {"generic": joints_mm(load_model(generic)), "the fit": dict(ours.fit_joints_mm)}
    joints = {
        pair: {name: own[pair] for name, own in lengths.items()}
        | {"habitus less expert": lengths["habitus"][pair] - lengths["expert"][pair]}
        for pair in lengths["habitus"]
    }
    unused = [row for row in trials if row["used"] == "no"]
    names = ("habitus", *others)
    means = {name: {"RMS mm": float(np.mean([row[name] for row in unused]))} for name in names}
    return {
        "markers": len(shared),
        "trials": trials,
        "unused": means,
        "joints": joints,
        "captures": captures(options.captures, generic),
    }


def captures(paths: list[Path], generic: Path) -> list[dict]:
    """Captures of one person with force plates through the whole command."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for result in gaits(paths, folder, opensim_model=generic) if paths else ():
            where = Path(folder) / result.name if len(paths) > 1 else Path(folder)
            check = json.loads((where / "opensim" / "check.json").read_text())
            share = check["residual_share_of_weight"]
            rows.append(
                {"capture": result.name, "verdict": check["verdict"]["level"]}
                | {"RMS mm": check["marker_rms_mm"]}
                | {"unused RMS mm": check["unused_frames_marker_rms_mm"] or ""}
                | {"OpenSim residual %": "" if share is None else 100 * share}
                | {"habitus residual %": 100 * (result.residual_share or 0.0)}
            )
    return rows


def show(found: dict) -> None:
    """Print the tables."""
    show_table(
        f"inverse kinematics, RMS mm of {found['markers']} markers that all models have",
        found["trials"],
        1,
    )
    show_table(
        "mean of unused trials", [{"model": name, **own} for name, own in found["unused"].items()]
    )
    joints = [{"mm": name.replace("_", " "), **own} for name, own in found["joints"].items()]
    show_table("distances between joints", joints, 0)
    if found["captures"]:
        show_table("captures with force plates", found["captures"], 1)


if __name__ == "__main__":
    arguments = parser(__doc__, out=True)
    arguments.add_argument("subject", type=Path, help="folder with MarkerData and Models")
    arguments.add_argument("--trials", nargs="+", default=list(TRIALS), help="the first places")
    arguments.add_argument("--mass", type=float, default=MASS, help="kg")
    arguments.add_argument("--captures", nargs="*", type=Path, default=[], help="C3D, one person")
    run(arguments, measure, show)
