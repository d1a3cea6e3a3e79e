"""The result folder of a fit to depth views."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from habitus.body.gender import female_probability
from habitus.body.state import BodyState
from habitus.body.surface_files import write_textured
from habitus.export.npz import motion_arrays, write_arrays
from habitus.export.png import png
from habitus.files import whole_folder, write_text
from habitus.fit.offsets import along_normals
from habitus.fit.points.colour_views import Skin, bake, spread
from habitus.fit.points.depth_evidence import ViewEvidence
from habitus.fit.points.depth_result import RgbdFit
from habitus.observe.light import srgb_bytes
from habitus.results.save import METRICS, REPORT, gender_entry, measurements_csv, write_json
from habitus.types import PathLike

DEPTH_FILES = ("body.npz", "body.glb", "measurements.csv", METRICS, REPORT)
TEXTURE_SIZES = {400: 1024, 0: 256}
"""Texels along a side of the texture, by the least height (pixels) of the colour images."""

DepthPage = Callable[[RgbdFit, Mapping[str, Any], Skin | None], str]
"""The report of a fit, its numbers and the texture of the skin."""


def save_depth(fit: RgbdFit, folder: PathLike, page: DepthPage | None = None) -> None:
    """Write body.npz, body.glb, measurements.csv, metrics.json and report.html.

    Raises HabitusError where the folder cannot be written.
    """
    skin = _baked_skin(fit)
    with whole_folder(folder, DEPTH_FILES) as partial:
        write_arrays(partial / "body.npz", _depth_arrays(fit))
        _write_depth_glb(fit, skin, partial / "body.glb")
        write_text(partial / "measurements.csv", measurements_csv(fit.measurements))
        numbers = depth_metrics(fit)
        write_json(partial / METRICS, numbers)
        if page is not None:
            write_text(partial / REPORT, page(fit, numbers, skin))


def depth_metrics(fit: RgbdFit) -> dict[str, Any]:
    """Errors of depth (mm), shares explained, light, timings (s), measurements, verdict and
    warnings.
    """
    seconds = {name: float(value) for name, value in fit.stage_seconds.items()}
    return {
        "capture": fit.capture_name,
        "body": fit.body_name,
        "age_years": fit.body.age,
        "views": [_view(view) for view in fit.evidence.views],
        "depth_error_mm": {
            "median": float(np.median([view.median_mm for view in fit.evidence.views])),
            "p95": float(np.max([view.p95_mm for view in fit.evidence.views])),
        },
        "segmentation": fit.evidence.segmentation,
        "appearance": _appearance(fit),
        "status": fit.status,
        "costs": dict(fit.costs),
        "body_costs": dict(fit.body_costs),
        "stage_seconds": {**seconds, "total": sum(seconds.values())},
        "hair_mm": 0.0 if fit.hair is None else float(1e3 * fit.hair.max()),
        "body_measurements": dict(fit.measurements),
        "gender": gender_entry(_female_probability(fit), fit.gender),
        "verdict": fit.verdict.entry(),
        "warnings": list(fit.warnings),
    }


def _view(view: ViewEvidence) -> dict[str, Any]:
    return {
        "name": view.name,
        "median_mm": view.median_mm,
        "bias_mm": view.bias_mm,
        "p95_mm": view.p95_mm,
        "noise_mm": view.noise_mm,
        "explained_fraction": view.explained,
        "outside_fraction": view.outside,
        "silhouette_overlap": view.overlap,
        "turn_degrees": view.turn_deg,
        "on_floor": view.on_floor,
        "cut_off": view.cut_off,
        "pixels": view.pixels,
        "ends_unexplained_fraction": dict(view.ends),
    }


def _appearance(fit: RgbdFit) -> dict[str, Any] | None:
    appearance = fit.appearance
    if appearance is None:
        return None
    return {
        "colour_residual": appearance.residual,
        "observed_fraction": float((appearance.seen > 0).mean()),
        "colour_camera_shift_mm": (1e3 * appearance.shift.shift).tolist(),
        "silhouette_overlap": appearance.shift.overlap,
        "light": appearance.light.tolist(),
    }


def _female_probability(fit: RgbdFit) -> float | None:
    """P(female) of the neutral shape, taken as known exactly; None without a classifier of sex."""
    return None if fit.body.female_direction is None else female_probability(fit.body, fit.betas)


def _depth_arrays(fit: RgbdFit) -> dict[str, np.ndarray]:
    arrays = motion_arrays(fit) | {
        "made": np.array([f"fitted to {len(fit.pose)} depth views of {fit.capture_name}"]),
        "view_names": np.array([view.name for view in fit.evidence.views]),
        "T_world_sensor": np.stack(
            [_rigid(prepared.turn, prepared.shift) for prepared in fit.prepared_views]
        ),
    }
    if fit.skin is not None:
        arrays["skin_offset"] = fit.skin.astype(np.float32)
    if fit.appearance is not None:
        arrays["albedo"] = fit.appearance.albedo.astype(np.float32)
        arrays["light"] = fit.appearance.light
        arrays["colour_camera_shift"] = fit.appearance.shift.shift
    return arrays


def _rigid(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = translation
    return out


def _baked_skin(fit: RgbdFit) -> Skin | None:
    """The texture of the person's skin; None without colour images."""
    if fit.appearance is None:
        return None
    image = fit.prepared_views[0].view.colour
    height = 0 if image is None else len(image)
    size = next(size for least, size in TEXTURE_SIZES.items() if height >= least)
    state = BodyState(fit.betas, fit.pose, fit.trans)
    return bake(fit.body, state, fit.prepared_views, fit.appearance, size, fit.skin)


def _write_depth_glb(fit: RgbdFit, skin: Skin | None, path: Path) -> None:
    """The person in the pose of the first view, with their own colours, centred over the origin."""
    body = fit.finest_body
    vertices = np.asarray(body(fit.betas, fit.pose[0], fit.trans[0]).vertices)
    if fit.skin is not None:
        vertices = along_normals(vertices, spread(fit.body, fit.skin[:, None])[:, 0], body)
    vertices = vertices - [*vertices[:, :1].mean(0), 0.0, vertices[:, 2].mean()]
    albedo = np.full((body.num_vertices, 3), 0.6) if skin is None else skin.vertex_albedo
    picture = None
    if skin is not None and skin.texture is not None:
        picture = png(_opaque(skin.texture))
    write_textured(vertices, body.faces, path, albedo, body.mesh, picture)


def _opaque(linear: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 4"]:
    """Linear colours as bytes of sRGB with an opaque fourth channel."""
    return np.dstack([srgb_bytes(linear), np.full(linear.shape[:2], 255, np.uint8)])
