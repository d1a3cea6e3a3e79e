"""Bodies from depth cameras: a folder of views in, a folder of results out (T 4.6.1)."""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from habitus.body.measurement_names import DEFINITIONS
from habitus.body.model import BodyModel
from habitus.body.surface_files import write_textured
from habitus.export.npz import motion_arrays, save_arrays
from habitus.files import atomic_write, whole_folder, write_text
from habitus.fit.points.depth import fit_views
from habitus.fit.points.depth_result import RgbdFit
from habitus.fit.points.settings import RgbdSettings
from habitus.fit.points.skin_offsets import along_normals
from habitus.fit.points.state import State
from habitus.fit.points.texture import Skin, bake, spread
from habitus.io.rgbd.read import read_views
from habitus.jobs.bodies import loaded
from habitus.observe.depth_views import RgbdCapture
from habitus.observe.srgb import srgb_bytes
from habitus.report.metrics import finite
from habitus.report.png import png
from habitus.report.rgbd.numbers import rgbd_metrics
from habitus.report.rgbd.page import rgbd_page
from habitus.types import PathLike

OURS = ("body.npz", "body.glb", "measurements.csv", "metrics.json", "report.html")
"""All names that `save_rgbd` may write: a later fit replaces them, and nothing else."""
LARGE, SMALL, LARGE_FROM = 1024, 256, 400
"""Texels along the texture's side, of colour images so high and of smaller ones."""


def fit_rgbd(
    views: RgbdCapture | PathLike,
    body: BodyModel | PathLike = "default",
    *,
    turns: Sequence[float | None] | None = None,
    settings: RgbdSettings | None = None,
    age: float | None = None,
) -> RgbdFit:
    """The body of a person whom a depth camera saw in one view or several (T 4.6.1), its poses,
    light and albedo.

    views: what `habitus.read_views` gives, or the folder it reads. body: a model, a file,
    "neutral", "female", "male", or "default": women's or men's, whichever explains the views
    better, the neutral one where neither does. turns: degrees by which the person was turned in
    each view, to the person's left; None where unknown, as all are by themselves. age: in years, of
    the body. Raises HabitusError for folders that hold no views, and where nobody is found in one.
    """
    capture = views if isinstance(views, RgbdCapture) else read_views(views)
    settings = settings or RgbdSettings()
    if isinstance(body, str) and body == "default":
        kinds = {name: loaded(name, "auto", age) for name in ("neutral", "female", "male")}
        return fit_views(capture, kinds, settings, turns)
    model = loaded(body, "auto", age)
    name = model.name if isinstance(body, BodyModel) else str(body)
    gender = name if name in ("female", "male") else "neutral"
    return fit_views(capture, model, settings, turns, name, gender)


def rgbd(
    folder: PathLike,
    out: PathLike,
    *,
    body: BodyModel | PathLike = "default",
    views: Sequence[int] | None = None,
    turns: Sequence[float | None] | None = None,
    depth_unit: float | None = None,
    cameras: PathLike | None = None,
    age: float | None = None,
    clothes_mm: float | None = None,
    hair_mm: float | None = None,
    progress: Callable[[str], Any] | None = None,
) -> RgbdFit:
    """Read a folder of views, fit, and write the results into the folder ``out``; what ``habitus
    rgbd`` does.

    views, depth_unit, cameras: as `habitus.read_views` takes them. clothes_mm, hair_mm: that lie on
    the skin of trunk and thighs and on the head, and are taken off; as in `RgbdSettings` where not
    given. Raises HabitusError.
    """
    tell = progress or (lambda text: None)
    tell("reading")
    capture = read_views(folder, views, depth_unit, cameras)
    tell(f"fitting {len(capture.views)} view{'s' * (len(capture.views) != 1)}")
    told = {"clothes": clothes_mm, "hair": hair_mm}
    settings = replace(
        RgbdSettings(), **{name: 1e-3 * value for name, value in told.items() if value is not None}
    )
    fit = fit_rgbd(capture, body, turns=turns, settings=settings, age=age)
    tell("writing")
    save_rgbd(fit, out)
    return fit


def save_rgbd(fit: RgbdFit, folder: PathLike) -> None:
    """body.npz, body.glb, measurements.csv, metrics.json and report.html in a folder that appears
    whole.

    Raises HabitusError where it cannot be written.
    """
    skin = None
    if fit.appearance is not None:
        state = State(fit.betas, fit.pose, fit.trans)
        tall = fit.sights[0].view.colour
        size = LARGE if tall is not None and len(tall) >= LARGE_FROM else SMALL
        skin = bake(fit.body, state, fit.sights, fit.appearance, size, fit.skin)
    with whole_folder(folder, OURS) as partial:
        _write_npz(fit, partial / "body.npz")
        _write_glb(fit, skin, partial / "body.glb")
        write_text(partial / "measurements.csv", _table(fit))
        numbers = rgbd_metrics(fit)
        text = json.dumps(finite(numbers), indent=2, ensure_ascii=False, allow_nan=False)
        write_text(partial / "metrics.json", text + "\n")
        write_text(partial / "report.html", rgbd_page(fit, numbers, skin))


def _write_npz(fit: RgbdFit, path: Path) -> None:
    arrays = motion_arrays(fit)
    arrays["made"] = np.array([f"fitted to {len(fit.pose)} depth views of {fit.capture_name}"])
    arrays["view_names"] = np.array([view.name for view in fit.evidence.views])
    arrays["T_world_sensor"] = np.stack([_rigid(sight.turn, sight.shift) for sight in fit.sights])
    if fit.skin is not None:
        arrays["skin_offset"] = fit.skin.astype(np.float32)
    if fit.appearance is not None:
        arrays["albedo"] = fit.appearance.albedo.astype(np.float32)
        arrays["light"] = fit.appearance.light
        arrays["colour_camera_shift"] = fit.appearance.shift.shift
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        save_arrays(file, arrays)


def _rigid(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, shift
    return out


def _write_glb(fit: RgbdFit, skin: Skin | None, path: Path) -> None:
    """The person as the first view shows them, in their own colours."""
    fine = fit.finest_body
    vertices = np.asarray(fine(fit.betas, fit.pose[0], fit.trans[0]).vertices)
    if fit.skin is not None:
        vertices = along_normals(vertices, spread(fit.body, fit.skin[:, None])[:, 0], fine)
    vertices = vertices - [*vertices[:, :1].mean(0), 0.0, vertices[:, 2].mean()]
    albedo = np.full((fine.num_vertices, 3), 0.6) if skin is None else skin.vertex_albedo
    picture = None
    if skin is not None and skin.texture is not None:
        picture = png(opaque(skin.texture))
    write_textured(vertices, fine.faces, path, albedo, fine.mesh, picture)


def opaque(linear: np.ndarray) -> np.ndarray:
    """Linear colours as bytes of sRGB with an opaque fourth channel."""
    return np.dstack([srgb_bytes(linear), np.full(linear.shape[:2], 255, np.uint8)])


def _table(fit: RgbdFit) -> str:
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(("name", "value", "unit", "what", "ISO 8559-1, 7250-1"))
    for name, value in fit.measurements.items():
        told = DEFINITIONS[name]
        rows.writerow(
            (name, f"{value:.6g}", "kg" if name.endswith("_kg") else "m", told.says, told.iso)
        )
    return text.getvalue()
