"""People in clothes: what a scanner sees of a person in a T-shirt, trousers, a jacket or a skirt.

Cloth rests on what faces upwards (shoulders, the chest, a seat) and hangs off the rest by its ease,
a smooth random field of 5 to 45 mm with wrinkles of 3 mm; it spans hollows (the small of the back,
between the breasts), ends at hems, and is nowhere inside the skin. A skirt is a tube around both
legs. The skin under it is known, so that a fit can be judged.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import igl
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array
from scipy.spatial import ConvexHull

from habitus.body.model import BodyModel
from habitus.fit.selection.held_out import smooth_field
from habitus.mesh.normals import vertex_normals

TRUNK = ("spine1", "spine2", "spine3", "collar")
GARMENTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "T-shirt": (*TRUNK, "shoulder"),
        "jacket": (*TRUNK, "shoulder", "elbow"),
        "shorts": ("pelvis", "hip"),
        "trousers": ("pelvis", "hip", "knee"),
    }
)
"""Joints, by name without the side, whose skin a garment covers."""
OUTFITS = (
    ("T-shirt", "trousers"),
    ("jacket", "trousers"),
    ("T-shirt", "shorts"),
    ("jacket", "skirt"),
)
EASE = {"T-shirt": (0.005, 0.025), "jacket": (0.012, 0.045), "shorts": (0.008, 0.03),
        "trousers": (0.008, 0.03), "skirt": (0.015, 0.06)}  # fmt: skip
"""Metres: between which the mean distance of a garment from the skin lies."""
CLOTH = 0.0012
"""Metres: thickness of the cloth where it rests."""
WRINKLES = 0.003
SMOOTHINGS = 150
"""Rounds in which cloth is drawn to the mean of its neighbours, outside the skin."""
KEPT = 0.6
"""Share of the ease at which the cloth stays off the skin at least."""
RING = 96
"""Points of a skirt's ring."""


@dataclass(frozen=True)
class ClothedPerson:
    """What a scanner sees, ``vertices`` (N, 3; m) and ``faces`` (F, 3), and which vertices of the
    body clothes cover: ``covered`` (V,), 0 or 1.
    """

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "F 3"]
    covered: Float[np.ndarray, " V"]


def clothed(
    body: BodyModel,
    skin: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    outfit: tuple[str, ...],
    rng: np.random.Generator,
) -> ClothedPerson:
    """A person whose posed skin (m) is given, upright, y up, in an outfit of `GARMENTS` and skirt.

    faces: those of the body that can be seen.
    """
    seen, covered = skin, np.zeros(len(skin))
    more = []
    for garment in outfit:
        if garment == "skirt":
            more.append(_skirt(body, skin, rng))
            covered = np.maximum(covered, _mask(body, ("pelvis", "hip")))
            continue
        mask = _mask(body, GARMENTS[garment])
        seen = np.where(mask[:, None] > 0.0, _cloth(body, skin, mask, EASE[garment], rng), seen)
        covered = np.maximum(covered, mask)
    vertices, triangles = [seen], [faces]
    for points, rings in more:
        triangles.append(rings + sum(map(len, vertices)))
        vertices.append(points)
    return ClothedPerson(np.concatenate(vertices), np.concatenate(triangles), covered)


def _mask(body: BodyModel, joints: tuple[str, ...]) -> Float[np.ndarray, " V"]:
    """1 at vertices that ride on those joints for the most part."""
    plain = [name.removeprefix("left_").removeprefix("right_") for name in body.joint_names]
    mine = [k for k, name in enumerate(plain) if name in joints]
    return (np.asarray(body.skinning_weights)[:, mine].sum(1) > 0.5).astype(float)


def _cloth(
    body: BodyModel,
    skin: np.ndarray,
    mask: np.ndarray,
    ease: tuple[float, float],
    rng: np.random.Generator,
) -> Float[np.ndarray, "V 3"]:
    """The cloth of one garment."""
    normal = vertex_normals(skin, body.faces)
    field = np.clip(0.5 + 0.5 * smooth_field(body.v_template, rng)[:, 0], 0.0, None)
    hanging = 1.0 - np.clip(1.5 * normal[:, 1], 0.0, 1.0)
    off = CLOTH + rng.uniform(*ease) * 2.0 * field * hanging
    off += WRINKLES * hanging * np.abs(smooth_field(3.0 * body.v_template, rng)[:, 0])
    cloth = skin + (mask * off)[:, None] * normal
    near = csr_array(igl.adjacency_matrix(np.asarray(body.faces, np.int64)), dtype=float)
    mean = diags_array(1.0 / np.maximum(near.sum(1), 1.0)) @ near
    for _ in range(SMOOTHINGS):
        cloth = np.where(mask[:, None] > 0.0, 0.5 * (cloth + mean @ cloth), cloth)
        inside = np.maximum(CLOTH, KEPT * off) - ((cloth - skin) * normal).sum(1)
        cloth += (mask * np.maximum(inside, 0.0))[:, None] * normal
    return cloth


def _skirt(
    body: BodyModel, skin: np.ndarray, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "N 3"], Int[np.ndarray, "F 3"]]:
    """A tube around hips and both thighs, from the waist to the knees or the shins."""
    names = body.joint_names
    weights = np.asarray(body.skinning_weights)
    mine = [k for k, n in enumerate(names) if n in ("pelvis", "spine1") or n[-3:] == "hip"
            or n[-4:] == "knee"]  # fmt: skip
    legs = skin[weights[:, mine].sum(1) > 0.5]
    pelvis = skin[weights[:, names.index("pelvis")] > 0.5]
    knees = skin[weights[:, [names.index("left_knee"), names.index("right_knee")]].sum(1) > 0.9]
    top = float(pelvis[:, 1].max())
    hem = float(knees[:, 1].max() - rng.uniform(0.0, 0.3) * np.ptp(knees[:, 1]))
    flare = rng.uniform(*EASE["skirt"])
    angles = np.linspace(0.0, 2.0 * np.pi, RING, endpoint=False)
    waves = 0.006 * np.cos(angles * rng.integers(5, 12) + rng.uniform(0.0, 6.0))
    ways = np.stack([np.cos(angles), np.sin(angles)], 1)
    rings = []
    reach = np.zeros(RING)
    middle = pelvis[:, [0, 2]].mean(0)
    for height in np.arange(top, hem, -0.01):
        level = legs[np.abs(legs[:, 1] - height) < 0.015][:, [0, 2]] - middle
        if len(level) > 3:
            hull = level[ConvexHull(level).vertices]
            reach = np.maximum(reach - 0.002, (hull @ ways.T).max(0))  # cloth hangs, drawn in a bit
        down = (top - height) / (top - hem)
        radius = reach + CLOTH + down * (flare + waves)
        rings.append(
            np.column_stack([radius * ways[:, 0], np.full(RING, height), radius * ways[:, 1]])
        )
    points = np.concatenate(rings) + np.array([middle[0], 0.0, middle[1]])
    ring, place = np.meshgrid(np.arange(len(rings) - 1), np.arange(RING), indexing="ij")
    a, b = ring * RING + place, ring * RING + (place + 1) % RING
    lower_a, lower_b = a + RING, b + RING
    faces = np.concatenate(
        [
            np.stack([a, b, lower_a], -1).reshape(-1, 3),
            np.stack([b, lower_b, lower_a], -1).reshape(-1, 3),
        ]
    )
    return points, faces
