"""Draws pictures of bodies in motion for the docs: several motions below each other, at the same
moments.

python tools/motion_pictures.py walk.npz walk_x2.npz --at 0.5 1.2 2.0 --out
docs/images/exaggerated.png python tools/motion_pictures.py walk.npz hero.npz --at 0.5 1.2 --moved
--out docs/images/retargeted.png
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import habitus as hb
from habitus.body.motion import BodyMotion
from habitus.rotations import up_rotation

SCALE = 150.0
TWICE = 2  # pixels a metre; drawn larger and made smaller again
LIGHT = np.array([-0.4, 0.6, 0.7]) / np.linalg.norm([-0.4, 0.6, 0.7])
GREY = np.array([205, 196, 186.0])
MOST = 0.05  # metres of soft tissue that are drawn red


def panel(
    motion: BodyMotion, frame: int, size: tuple[int, int], ground: float, moved: bool, turn: float
) -> Image.Image:
    """A frame seen from the body's front, turned about the vertical by ``turn`` (rad)."""
    body = motion.body
    world = up_rotation(motion.up_axis)
    vertices = motion.vertices(frame) @ world.T
    vertices -= np.array([*vertices.mean(axis=0)[[0, 2]], ground])[[0, 2, 1]]
    cosine = np.cos(turn)
    sine = np.sin(turn)
    vertices = vertices @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    pixels = TWICE * SCALE * vertices[:, :2] * [1, -1] + TWICE * np.array(
        [size[0] / 2, size[1] - 25]
    )
    corners = vertices[body.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    shade = (0.45 + 0.55 * np.clip(normal @ LIGHT, 0, 1))[:, None]
    colour = np.clip(
        shade * _colours(motion, frame, moved)[body.faces].mean(axis=1), 0, 255
    ).astype(int)
    image = Image.new("RGB", (TWICE * size[0], TWICE * size[1]), "white")
    draw = ImageDraw.Draw(image)
    draw.line(
        [(0, TWICE * (size[1] - 25)), (TWICE * size[0], TWICE * (size[1] - 25))],
        fill=(150, 150, 150),
        width=2,
    )
    front = np.flatnonzero(normal[:, 2] > 0)
    for face in front[np.argsort(corners[front, :, 2].mean(axis=1))]:
        draw.polygon([tuple(point) for point in pixels[body.faces[face]]], fill=tuple(colour[face]))
    return image.resize(size, Image.Resampling.LANCZOS)


def _colours(motion: BodyMotion, frame: int, moved: bool) -> np.ndarray:
    """Grey, and with ``moved`` red where soft tissue is far from its mean."""
    if not moved or motion.soft_tissue is None:
        return np.tile(GREY, (motion.body.num_vertices, 1))
    away = motion.body.shapedirs @ (motion.soft_tissue[frame] - motion.soft_tissue.mean(axis=0))
    share = np.clip(np.linalg.norm(away, axis=1) / MOST, 0, 1)[:, None]
    return (1 - share) * GREY + share * np.array([214, 40, 40.0])


def main() -> None:
    """Draw each motion's moments side by side, the motions below each other."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("motions", type=Path, nargs="+")
    parser.add_argument("--at", type=float, nargs="+", required=True, help="seconds")
    parser.add_argument("--moved", action="store_true", help="colour soft tissue")
    parser.add_argument("--size", type=int, nargs=2, default=(230, 330))
    parser.add_argument("--turn", type=float, default=0.0, help="degrees")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows = []
    for path in options.motions:
        motion = hb.load_motion(path)
        some = np.linspace(0, motion.num_frames - 1, 60).astype(int)
        low = [(motion.vertices(int(k)) @ up_rotation(motion.up_axis).T)[:, 1].min() for k in some]
        frames = [round(t * motion.rate_hz) for t in options.at]
        given = tuple(options.size), float(np.median(low)), options.moved, np.deg2rad(options.turn)
        rows.append(
            np.concatenate([np.asarray(panel(motion, frame, *given)) for frame in frames], axis=1)
        )
    Image.fromarray(np.concatenate(rows)).save(options.out, optimize=True)
    print(f"wrote {options.out}: {options.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
