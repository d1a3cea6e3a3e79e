"""One made person before a depth camera, in small images: made once a session."""

from dataclasses import replace
from functools import cache

import numpy as np

from habitus.body.model import BodyModel
from habitus.fit.points.depth_settings import STANDARD
from habitus.io.models.bodies import load_body
from habitus_lab.population.rgbd_people import Scene, planted_rest, rgbd_scene

SCALE = 0.35
QUICK_DEPTH = replace(
    STANDARD,
    search=replace(STANDARD.search, turns=(0.0, 45.0), arms=STANDARD.search.arms[1:2]),
    limbs=replace(STANDARD.limbs, passes=1, kept=1, pixels=500),
    skin_places=120,
)
"""Of views of people in an A-pose, turned as in `small_scene`."""


@cache
def small_scene(sensor: str = "azure-kinect", seed: int = 5) -> tuple[BodyModel, Scene]:
    """The default body, and a person near it in two views."""
    body = load_body("default")
    rng = np.random.default_rng(seed)
    return body, rgbd_scene(body, planted_rest(body, rng), rng, sensor=sensor, scale=SCALE)
