"""Sensors do to depth what the literature says: noise that grows, steps, holes, shadows beside what
is near.
"""

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus_lab.population.depth_sensors import SENSORS, sense, shadow

KINECT = SENSORS["kinect-v1"]
AZURE = SENSORS["azure-kinect"]


def wall(sensor, distance, cosine=1.0):
    size = (sensor.height, sensor.width)
    return np.full(size, distance), np.full(size, cosine)


@pytest.mark.parametrize("distance", [1.5, 2.5, 4.0])
def test_noise_of_structured_light_grows_as_was_measured(distance):
    found = sense(KINECT, *wall(KINECT, distance), np.random.default_rng(0))
    nguyen = 0.0012 + 0.0019 * (distance - 0.4) ** 2
    assert 0.75 < found[found > 0].std() / nguyen < 1.35
    assert abs(np.median(found) - distance) < nguyen


def test_structured_light_comes_in_steps_of_disparity():
    found = sense(KINECT, *wall(KINECT, 3.0), np.random.default_rng(0))
    disparity = KINECT.focal * KINECT.baseline / np.unique(found[found > 0])
    steps = disparity / KINECT.disparity_step
    assert np.abs(steps - np.round(steps)).max() < 0.06  # depth itself comes in millimetres
    assert len(steps) < 20


def test_time_of_flight_is_millimetres():
    found = sense(AZURE, *wall(AZURE, 2.5), np.random.default_rng(0))
    assert 0.001 < found[found > 0].std() < 0.004


@pytest.mark.parametrize("sensor", [KINECT, AZURE], ids=lambda sensor: sensor.name)
def test_grazing_and_far_surfaces_are_holes(sensor):
    rng = np.random.default_rng(0)
    assert not sense(sensor, *wall(sensor, 2.0, 0.5 * sensor.grazing), rng).any()
    assert not sense(sensor, *wall(sensor, 7.0), rng).any()
    assert not sense(sensor, *wall(sensor, np.inf), rng).any()
    assert sense(sensor, *wall(sensor, 2.0), rng).all()


def test_the_projector_leaves_a_shadow_as_wide_as_parallax():
    depth = np.full((4, 640), 4.0)
    depth[:, 300:400] = 2.0
    found = shadow(depth, KINECT.focal, KINECT.baseline)
    width = KINECT.focal * KINECT.baseline * (1 / 2.0 - 1 / 4.0)
    assert (
        abs(found[0].sum() - width) <= 1.5 and found[:, 270:300].any() and not found[:, 300:].any()
    )


def test_another_size_is_refused():
    with pytest.raises(HabitusError, match="kinect-v1"):
        sense(KINECT, np.ones((4, 4)), np.ones((4, 4)), np.random.default_rng(0))
