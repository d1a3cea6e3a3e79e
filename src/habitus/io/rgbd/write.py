"""Writes views as a folder that `read_views` reads: what made data and examples are kept in."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from habitus.errors import require_extra
from habitus.files import whole_folder, write_text
from habitus.observe.camera import Camera, RgbdCapture
from habitus.rotations import matrix_from_rotvec
from habitus.types import PathLike


def write_views(capture: RgbdCapture, folder: PathLike, unit: float = 0.001) -> None:
    """depth/ and color/ images of the views and of the empty room, and cameras.json. All views
    share their cameras.

    Raises HabitusError where the folder cannot be written.
    """
    first = capture.views[0]
    with whole_folder(folder) as partial:
        for k, view in enumerate(capture.views):
            _write(partial / "depth" / f"{k:04d}.png", _steps(view.depth, unit))
            if view.colour is not None:
                _write(partial / "color" / f"{k:04d}.png", view.colour)
            if view.mask is not None:
                _write(partial / "mask" / f"{k:04d}.png", view.mask.astype(np.uint8) * 255)
        if first.background is not None:
            _write(partial / "background" / "depth.png", _steps(first.background, unit))
        if first.background_colour is not None:
            _write(partial / "background" / "color.png", first.background_colour)
        table: dict[str, Any] = {"depth_scale": unit, "depth": _intrinsics(first.camera)}
        if first.colour_camera is not None:
            turn = np.asarray(matrix_from_rotvec(first.colour_camera.rotation))
            shift = first.colour_camera.translation.tolist()
            table["color"] = _intrinsics(first.colour_camera)
            table["depth_to_color"] = {"rotation": turn.tolist(), "translation": shift}
        write_text(partial / "cameras.json", json.dumps(table, indent=1) + "\n")


def _steps(depth: np.ndarray, unit: float) -> np.ndarray:
    return np.round(np.nan_to_num(depth) / unit).clip(0, 65535).astype(np.uint16)


def _write(path: Path, image: np.ndarray) -> None:
    require_extra("PIL", "image files", "rgbd")
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def _intrinsics(camera: Camera) -> dict[str, Any]:
    (fx, fy), (cx, cy) = camera.focal_length.tolist(), camera.principal_point.tolist()
    entries = {
        "width": camera.width,
        "height": camera.height,
        "fx": fx,
        "fy": fy,
        "cx": cx - 0.5,
        "cy": cy - 0.5,
    }
    return (
        entries
        if camera.distortion is None
        else {**entries, "distortion": camera.distortion.tolist()}
    )
