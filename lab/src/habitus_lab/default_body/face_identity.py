"""Who a face is: 30 components of MakeHuman's face sliders beside the shape space's own betas.

The survey measures little of a face, so people rebuilt from it are siblings. Sliders of forehead,
brows, eyes, ears, nose, mouth, cheeks, chin and head are drawn; what the body's betas can do on the
head is taken out; principal components of the rest, weighed by the surface's area, are `facedirs`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .contacts import Meetings, apart
from .shape_space import ShapeSpace
from .sliders import local_offsets
from .sources import Source

COMPONENTS = 30
SECTIONS = ("forehead", "eyebrows", "eyes", "ears", "nose", "mouth", "cheek", "chin", "head")
# shifts to one side, and what a pose or the body's own betas do
SKIPPED = ("nose-trans-in-out", "mouth-trans-in-out", "head-trans", "head-angle", "head-age")
SPREAD = 0.35  # standard deviation of a slider of -1..1
SKULL_SPREAD = 0.12  # of what reshapes the whole skull: more looks square
SKULL = ("head-", "forehead-scale")


@dataclass(frozen=True)
class FaceSpace:
    """facedirs (H, 3, 30) of the head's vertices, and how well they do."""

    directions: np.ndarray
    between_people: float  # metres rms over the face's area, of faces drawn with unit betas
    held_out: float  # metres mean: what is left of faces that were not learned from
    meetings: Meetings | None = None


def drawn_faces(source: Source, count: int, rng: np.random.Generator) -> np.ndarray:
    """Offsets (count, 19158, 3) float32 of random sliders from the face as it is."""
    names, offsets = local_offsets(source, SECTIONS, SKIPPED)
    spread = np.array([SKULL_SPREAD if name.startswith(SKULL) else SPREAD for name in names])
    values = np.clip(rng.normal(size=(count, len(names))) * spread, -1, 1).astype(np.float32)
    moved = np.tensordot(np.maximum(-values, 0), offsets[:, 0], 1)
    moved += np.tensordot(np.maximum(values, 0), offsets[:, 1], 1)
    return moved


def face_space(
    offsets: np.ndarray,
    rest: np.ndarray,
    shapedirs: np.ndarray,
    head: np.ndarray,
    mirror: np.ndarray,
    skins: tuple[np.ndarray, ...],
    rng: np.random.Generator,
    known: Meetings | None = None,
) -> FaceSpace:
    """The space of faces with these offsets (N, V, 3) from a body at rest (V, 3).

    `head` (V,) is 1 on the head and fades to 0 at the neck; `skins` are triangles (F, 3) of the head
    alone; `shapedirs` (V, 3, B) are the body's; `known` springs of a like body spare their search.
    """
    used = np.flatnonzero(head > 0)
    metric = np.sqrt(_areas(rest, skins[0])[used])
    metric /= np.linalg.norm(metric)
    flat = (offsets[:, used] * (head[used, None] * metric[:, None])).reshape(len(offsets), -1)
    body = (shapedirs[used] * metric[:, None, None]).reshape(-1, shapedirs.shape[-1])
    basis, _ = np.linalg.qr(body)
    flat = flat - flat.mean(0)
    flat -= (flat @ basis) @ basis.T
    learn, test = flat[: -len(flat) // 5], flat[-len(flat) // 5 :]
    left = test - (test @ (axes := _principal(learn)[0])) @ axes.T
    axes, spread = _principal(flat)
    weight = np.repeat(metric, 3)[:, None]
    dirs = np.zeros((*rest.shape, COMPONENTS))
    dirs[used] = np.where(weight > 0, axes * spread / np.maximum(weight, 1e-12), 0).reshape(
        len(used), 3, -1
    )
    dirs = _symmetric(dirs, mirror)
    space = ShapeSpace(
        rest,
        dirs,
        np.zeros((1, COMPONENTS)),
        spread**2,
        0.0,
        np.zeros(1),
        np.zeros((1, COMPONENTS)),
    )
    space, meetings = apart(space, skins, mirror, rest, rng, known)
    found = space.shapedirs * (head > 0)[:, None, None]
    drawn = (found[used] * metric[:, None, None]).reshape(-1, COMPONENTS)
    rows = left.reshape(len(left), -1, 3) / np.maximum(metric, 1e-12)[:, None]
    distance = np.linalg.norm(rows, axis=2)
    return FaceSpace(
        found,
        float(np.sqrt((drawn**2).sum())),
        float((distance * metric**2).sum(1).mean()),
        meetings,
    )


def _principal(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    values, sides = np.linalg.eigh((flat @ flat.T).astype(float))
    values = np.sqrt(np.maximum(values[::-1][:COMPONENTS], 0))
    return flat.T @ sides[:, ::-1][:, :COMPONENTS] / values, values / np.sqrt(len(flat) - 1)


def _symmetric(dirs: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    return 0.5 * (dirs + dirs[mirror] * np.array([-1.0, 1.0, 1.0])[:, None])


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) a third of each triangle's area to each of its corners."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))
