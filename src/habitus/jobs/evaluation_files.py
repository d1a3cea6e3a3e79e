"""Files of an evaluation: report.html, evaluation.json, per_vertex.npz, and the folder figures."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import habitus
from habitus.errors import require_extra
from habitus.evaluate.generalisation import Generalisation
from habitus.evaluate.posable import PosableBody
from habitus.evaluate.result import Evaluation, ModelEvaluation
from habitus.files import atomic_write, locked, tidy
from habitus.mesh.registrations import Registrations
from habitus.report.evaluation.figures import figures
from habitus.report.evaluation.page import training_page
from habitus.report.evaluation.pictures import draw_pictures, slug
from habitus.results.save import finite


@contextmanager
def prepared_folder(folder: Path) -> Iterator[None]:
    """The folder made and locked. Raises HabitusError where that cannot be, or what draws figures
    is not installed.
    """
    require_extra("matplotlib", "figures")
    with locked(folder):
        tidy(folder / "figures")
        yield


def write_evaluation(evaluation: Evaluation, folder: Path) -> None:
    """Write all files, each whole or not at all. Raises HabitusError where that cannot be done."""
    numbers = finite(evaluation_numbers(evaluation))
    pictures = list(draw_pictures(evaluation))
    plots = figures(numbers)
    files = {f"figures/{name}.svg": text.encode() for name, text in plots.items()}
    files |= {f"figures/{each.file}": each.content for each in pictures}
    numbers["figures"] = sorted(files)
    for name in _figures_of_before(folder) - {*files}:
        (folder / name).unlink(missing_ok=True)
    files["evaluation.json"] = (
        json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    ).encode()
    files["report.html"] = training_page(numbers, plots, pictures).encode()
    for name, content in files.items():
        with atomic_write(folder / name) as temporary:
            temporary.write_bytes(content)
    with atomic_write(folder / "per_vertex.npz") as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **_per_vertex(evaluation))


def _figures_of_before(folder: Path) -> set[str]:
    """The figures that an evaluation wrote to this folder earlier, by its own account."""
    try:
        figures = json.loads((folder / "evaluation.json").read_text("utf-8"))["figures"]
        return {name for name in figures if name == f"figures/{Path(name).name}"}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def _per_vertex(evaluation: Evaluation) -> dict[str, np.ndarray]:
    """Mean errors (m) of vertices, (K, V): "<model>/<measure>" and "<model>/<measure>/clean"."""
    colours = {}
    for entry in evaluation.models:
        for curve in filter(None, (entry.shape, entry.pose)):
            key = f"{slug(entry.name)}/{curve.measure}"
            colours[key] = curve.per_vertex.astype(np.float32)
            if curve.clean_per_vertex is not None:
                colours[f"{key}/clean"] = curve.clean_per_vertex.astype(np.float32)
    return colours


# -- numbers ---------------------------------------------------------------------------------------


def evaluation_numbers(evaluation: Evaluation) -> dict[str, Any]:
    """Every number as plain values: errors in mm, times in ms (fits: s), angles in degrees."""
    data = evaluation.registrations
    models = evaluation.models
    removed = _removed(models)
    return {
        "habitus": habitus.__version__,
        "dataset": {
            "path": evaluation.dataset,
            "registrations": list(data.name),
            "subjects": list(data.subject),
            "vertices": data.num_vertices,
            "noise_free": evaluation.clean is not None,
            "observed_fraction": _observed_fraction(data),
        },
        "shown": evaluation.shown,
        "models": [
            _model_numbers(entry) | {"removed_by_pose_shapes": removed.get(entry.name)}
            for entry in models
        ],
    }


def _observed_fraction(data: Registrations) -> float:
    """The mean weight of vertices: errors are measured over observed ones only."""
    weights = [data.read_seen(k)[1] for k in range(len(data))]
    return float(np.mean([1.0 if weight is None else weight.mean() for weight in weights]))


def _removed(models: Sequence[ModelEvaluation]) -> dict[str, dict[str, Any]]:
    """For models measured without their pose blend shapes as well: what share (%) of that error in
    pose generalisation these remove, against noise-free meshes where there are any.
    """
    by_name = {entry.name: entry for entry in models}
    shares = {}
    for entry in models:
        full = by_name.get(entry.without_pose_shapes_of or "")
        if full and full.pose and entry.pose:
            means = (
                c.means if c.clean_means is None else c.clean_means for c in (full.pose, entry.pose)
            )
            with_them, without = means
            percent = 100 * (1 - with_them / np.maximum(without, 1e-12))
            shares[full.name] = {"counts": list(full.pose.counts), "percent": percent.tolist()}
    return shares


def _model_numbers(entry: ModelEvaluation) -> dict[str, Any]:
    body = entry.model.body if isinstance(entry.model, PosableBody) else None
    total = entry.variances.sum()
    return {
        "name": entry.name,
        "file": entry.file,
        "kind": entry.model.kind,
        "skinning": body and body.skinning,
        "pose_features": body and body.pose_features
        if body and body.posedirs is not None
        else None,
        "shape_features": body and body.shape_features,
        "num_betas": entry.model.num_betas,
        "without_pose_shapes_of": entry.without_pose_shapes_of,
        "model_generalisation": _curve_numbers(entry.shape),
        "pose_generalisation": entry.pose and _curve_numbers(entry.pose),
        "run_time": {
            "counts": list(entry.times.counts),
            "median_ms": (1e3 * entry.times.medians).tolist(),
        },
        "cumulative_variance": {
            "of": "all shapes trained on" if entry.all_variances else "the model's own directions",
            "share": (np.cumsum(entry.variances) / (total if total > 0 else 1.0)).tolist(),
        },
        "neck_twist": entry.twist
        and {
            "joints": list(entry.twist.joints),
            "radius_mm": 1e3 * entry.twist.radius,
            "angles": list(entry.twist.angles),
            "girth": entry.twist.girth.tolist(),
            "asymmetry": entry.twist.asymmetry,
            "shrink": entry.twist.shrink,
        },
    }


def _curve_numbers(curve: Generalisation) -> dict[str, Any]:
    clean = curve.clean_errors
    means = curve.clean_means
    return {
        "counts": list(curve.counts),
        "mean_mm": (1e3 * curve.means).tolist(),
        "clean_mean_mm": None if means is None else (1e3 * means).tolist(),
        "registrations": list(curve.registrations),
        "errors_mm": (1e3 * curve.errors).tolist(),
        "clean_errors_mm": None if clean is None else (1e3 * clean).tolist(),
        "fit_seconds": curve.seconds.mean(1).tolist(),
    }
