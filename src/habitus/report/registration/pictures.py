"""Pictures of scans and of what was registered to them: points splatted on a grid, lit from the
viewer's left.
"""

import numpy as np
from jaxtyping import Float, Int, UInt8

from habitus.mesh.normals import face_normals

RAMP = ("#ece7df", "#f7d48a", "#f0934a", "#cf3f4b", "#6a1b5f")
PLAIN = "#b9b2a7"
_LIGHT = np.array([-0.35, 0.45, 1.0]) / np.linalg.norm([-0.35, 0.45, 1.0])
_DENSE = 400_000


def coloured(values: Float[np.ndarray, " N"], limit: float) -> Float[np.ndarray, "N 3"]:
    """Colours (0 to 1) of values from 0 to a limit."""
    stops = np.array([_rgb(colour) for colour in RAMP])
    place = np.clip(values / limit, 0.0, 1.0) * (len(stops) - 1)
    return np.stack([np.interp(place, np.arange(len(stops)), stops[:, k]) for k in range(3)], 1)


def plain(count: int) -> Float[np.ndarray, "N 3"]:
    """Grey."""
    return np.tile(_rgb(PLAIN), (count, 1))


def spread(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    colours: Float[np.ndarray, "V 3"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and colours that lie densely on a surface."""
    normals = face_normals(vertices, faces)
    rng = np.random.default_rng(0)
    area = np.linalg.norm(normals, axis=1)
    face = rng.choice(len(faces), _DENSE, p=area / area.sum())
    share = rng.dirichlet((1.0, 1.0, 1.0), _DENSE)
    corners = faces[face]
    mixed = (np.einsum("pk,pkc->pc", share, each[corners]) for each in (vertices, colours))
    points, colour = mixed
    return points, normals[face] / np.maximum(area[face], 1e-12)[:, None], colour


def splatted(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    colours: Float[np.ndarray, "N 3"],
    turn: Float[np.ndarray, "3 3"],
    frame: Float[np.ndarray, "n 3"],
    height: int = 480,
    size: int = 1,
) -> UInt8[np.ndarray, "H W 4"]:
    """Points (m) seen along the third row of ``turn``, each ``2 size + 1`` pixels wide; ``frame``
    fills the height.
    """
    across = frame @ turn.T
    low = across.min(0)
    high = across.max(0)
    scale = (height - 8) / max(high[1] - low[1], (high[0] - low[0]) / 1.5)
    width = int((high[0] - low[0]) * scale) + 8
    seen = points @ turn.T
    facing = normals @ turn.T
    light = 0.45 + 0.55 * np.clip(facing @ _LIGHT, 0.0, 1.0)
    front = facing[:, 2] > 0.0
    x = ((seen[:, 0] - low[0]) * scale + 4).astype(int)[front]
    y = ((high[1] - seen[:, 1]) * scale + 4).astype(int)[front]
    order = np.argsort(seen[front, 2], kind="stable")
    shade = np.round(255 * np.clip(colours * light[:, None], 0.0, 1.0)).astype(np.uint8)[front][
        order
    ]
    image = np.zeros((height, width, 4), np.uint8)
    steps = range(-size, size + 1)
    for down in steps:
        for right in steps:
            rows = np.clip(y[order] + down, 0, height - 1)
            columns = np.clip(x[order] + right, 0, width - 1)
            image[rows, columns, :3], image[rows, columns, 3] = shade, 255
    return image


def views(root: Float[np.ndarray, "3 3"]) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Axes to the right, up and to the viewer, from before and behind a person whose pelvis is
    turned by ``root``.
    """
    ahead = root @ np.array([0.0, 0.0, 1.0])
    ahead = np.array([ahead[0], 0.0, ahead[2]])
    length = np.linalg.norm(ahead)
    ahead = ahead / length if length > 0.2 else np.array([0.0, 0.0, 1.0])
    up = np.array([0.0, 1.0, 0.0])
    front = np.stack([np.cross(up, ahead), up, ahead])
    return {"front": front, "back": front * np.array([[-1.0], [1.0], [-1.0]])}


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))
