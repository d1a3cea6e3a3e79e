"""Soft tissue exaggerated: its motion grows, its mean and everything else stay."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

from habitus.body.motion import BodyMotion
from habitus.body.soft_tissue import exaggerated, skin_motion
from habitus.errors import HabitusError


@pytest.fixture(scope="module")
def walk() -> BodyMotion:
    return BodyMotion.of(synthetic_fit(20))


def test_the_laws_of_a_factor(walk):
    np.testing.assert_allclose(exaggerated(walk, 1.0).soft_tissue, walk.soft_tissue, atol=1e-15)
    np.testing.assert_allclose(
        exaggerated(exaggerated(walk, 1.5), 2.0).soft_tissue,
        exaggerated(walk, 3.0).soft_tissue,
        atol=1e-12,
    )
    for factor in (0.0, 1.5, 4.0):
        found = exaggerated(walk, factor)
        np.testing.assert_allclose(found.soft_tissue.mean(0), walk.soft_tissue.mean(0), atol=1e-12)
        assert skin_motion(found) == pytest.approx(factor * skin_motion(walk), abs=1e-9)
        assert (
            found.pose is walk.pose
            and found.trans is walk.trans
            and f"{factor:g} times" in found.made[-1]
        )


def test_skin_motion_is_that_of_the_surface(walk):
    rest = walk.body.rest_vertices(walk.betas + walk.soft_tissue)
    away = rest - rest.mean(axis=0)
    assert skin_motion(walk) == pytest.approx(np.sqrt((away**2).sum(-1).mean()), rel=1e-9)


def test_what_cannot_be_exaggerated(walk):
    with pytest.raises(HabitusError, match="soft tissue"):
        exaggerated(replace(walk, soft_tissue=None), 2.0)
    for factor in (-1.0, float("nan"), float("inf")):
        with pytest.raises(HabitusError, match="factor"):
            exaggerated(walk, factor)
