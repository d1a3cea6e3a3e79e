import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_fit import synthetic_fit

from habitus.errors import HabitusError
from habitus.export.rates import at_rate


def test_every_fourth_frame_is_taken_as_it_is():
    fit = synthetic_fit(90, rate_hz=120.0)
    assert at_rate(fit, None) is fit and at_rate(fit, 120) is fit
    slow = at_rate(fit, 30)
    assert slow.rate_hz == 30 and slow.num_frames == 23
    for name in ("pose", "trans", "soft_tissue"):
        np.testing.assert_array_equal(getattr(slow, name), getattr(fit, name)[::4])


@pytest.mark.parametrize("fps", [25.0, 50.0, 250.0])
def test_what_lies_between_two_frames(fps):
    fit = synthetic_fit(60, rate_hz=120.0)
    found = at_rate(fit, fps)
    assert found.num_frames == int(59 * fps / 120 + 1e-6) + 1
    places = np.arange(found.num_frames) * 120 / fps
    known = np.stack([np.interp(places, np.arange(60), column) for column in fit.trans.T], 1)
    np.testing.assert_allclose(found.trans, known, atol=1e-12)
    k = found.num_frames // 2
    before = int(places[k])
    part = places[k] % 1
    first, second = (Rotation.from_rotvec(fit.pose[before + d]) for d in (0, 1))
    way = (first.inv() * second).magnitude()
    here = Rotation.from_rotvec(found.pose[k])
    np.testing.assert_allclose((first.inv() * here).magnitude(), part * way, atol=1e-9)
    np.testing.assert_allclose((here.inv() * second).magnitude(), (1 - part) * way, atol=1e-9)


def test_no_rate_is_refused():
    for fps in (0, -5, 1e9, float("nan")):
        with pytest.raises(HabitusError, match="frames a second"):
            at_rate(synthetic_fit(3), fps)
    assert at_rate(synthetic_fit(1, soft=False), 30).num_frames == 1
