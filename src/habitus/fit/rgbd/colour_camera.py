"""Where the colour camera is: its translation beside the depth camera, by the person's outline in
colour (T 4.6.1).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, gaussian_filter, label

from habitus.fit.rgbd.sights import Sight
from habitus.observe.camera import Camera
from habitus.render.draw import draw
from habitus.render.jacobians.images import silhouette_jacobian
from habitus.render.triangles import Triangles

STEPS = 5
BLUR = 1.5
REDUCED = 0.5
PRIOR_SD = 0.008
"""Metres by which a calibration may be off."""
CERTAINTY = 0.01
"""Weight of a pixel of the outlines' difference: neighbours along an outline are off together."""
LEAST_OVERLAP = 0.6
"""Share of the outline's pixels that must be the model's: with less, something else differs from
the background.
"""


@dataclass(frozen=True, eq=False)
class ColourShift:
    """What is added to the colour camera's translation (m, its own axes), and how well the outlines
    then overlap.
    """

    shift: Float[np.ndarray, " 3"]
    overlap: float | None


def person_in_colour(sight: Sight) -> Bool[np.ndarray, "h w"] | None:
    """Pixels of the colour image that differ from the empty room's; None without that."""
    view = sight.view
    if view.colour is None or view.background_colour is None:
        return None
    apart = np.abs(view.colour.astype(np.float32) - view.background_colour).max(-1)
    smooth = gaussian_filter(apart, 1.0)
    found = binary_opening(smooth > max(12.0, 5.0 * float(np.median(smooth))))
    pieces, count = label(found)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    sizes[0] = 0
    return pieces == sizes.argmax() if count else found


def find_shift(
    sights: list[Sight], vertices: list[Float[np.ndarray, "V 3"]], triangles: Triangles
) -> ColourShift:
    """The shift at which the model's outline in colour is the person's, by Gauss-Newton through the
    renderer.
    """
    seen = [person_in_colour(sight) for sight in sights]
    pairs = [
        (s, m, v)
        for s, m, v in zip(sights, seen, vertices, strict=True)
        if m is not None and m.any()
    ]
    if not pairs:
        return ColourShift(np.zeros(3), None)
    shift = np.zeros(3)
    overlap = 0.0
    for _ in range(STEPS):
        matrix = np.eye(3) / PRIOR_SD**2
        right = -shift / PRIOR_SD**2
        overlaps = []
        for sight, mask, surface in pairs:
            assert sight.colour_camera is not None
            camera = moved(sight.colour_camera, shift).scaled(REDUCED)
            residual, jacobian, share = _difference(camera, mask, surface, triangles)
            matrix += CERTAINTY * jacobian.T @ jacobian
            right -= CERTAINTY * jacobian.T @ residual
            overlaps.append(share)
        overlap = min(overlaps)
        shift = shift + np.linalg.solve(matrix, right)
    wrong = overlap < LEAST_OVERLAP or np.linalg.norm(shift) > 3.0 * PRIOR_SD
    return ColourShift(np.zeros(3) if wrong else shift, overlap)


def moved(camera: Camera, shift: Float[np.ndarray, " 3"]) -> Camera:
    """The camera with its translation shifted."""
    return camera.replace(translation=camera.translation + torch.from_numpy(shift))


def _difference(
    camera: Camera,
    mask: Bool[np.ndarray, "h w"],
    vertices: Float[np.ndarray, "V 3"],
    triangles: Triangles,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Blurred outlines' difference, its derivative by the translation, and their overlap."""
    points = torch.from_numpy(vertices)
    frame = draw(camera, points, triangles)
    drawn = frame.silhouette().numpy()
    rows = (
        (np.arange(camera.height) / REDUCED + 0.5 / REDUCED).astype(int).clip(max=mask.shape[0] - 1)
    )
    columns = (
        (np.arange(camera.width) / REDUCED + 0.5 / REDUCED).astype(int).clip(max=mask.shape[1] - 1)
    )
    observed = mask[np.ix_(rows, columns)].astype(float)
    jacobian = silhouette_jacobian(frame).to_camera(camera, points, ["translation"])["translation"]
    blurred = [gaussian_filter(one.reshape(drawn.shape), BLUR).ravel() for one in jacobian.T]
    both = np.minimum(drawn, observed).sum() / max(np.maximum(drawn, observed).sum(), 1e-9)
    return gaussian_filter(drawn - observed, BLUR).ravel(), np.stack(blurred, 1), float(both)
