"""Labels without meaning find their places again on a known person; what is not decided is said."""

import numpy as np
import pytest
from planted import plant, prior_of_poses

from habitus.errors import HabitusError
from habitus.fit.discover import starts
from habitus.fit.discover.description import describe
from habitus.fit.discover.places import seated
from habitus.fit.discover.recipe import _cheaper, discover
from habitus.fit.discover.settings import DiscoverSettings
from habitus.fit.discover.skin import spread_places
from habitus.fit.markers.settings import MoshSettings


@pytest.fixture(scope="module")
def planted():
    return plant(frames=24)


@pytest.fixture(scope="module")
def near(planted):
    """Labels seated from the right poses on the mean body."""
    body = planted.body
    frames = slice(0, 24, 8)
    skin = spread_places(body, 400)
    prior = prior_of_poses().for_joints(body.joint_names)
    start = (np.zeros(body.num_betas), planted.pose[frames], planted.trans[frames])
    return skin, seated(body, skin, planted.observed[frames], prior, *start, rounds=(0.06,))


def test_labels_are_seated_where_they_sit(planted, near):
    _, found = near
    template = np.asarray(planted.body.v_template)
    off = np.linalg.norm(
        template[found.vertices] - template[planted.layout.vertices(planted.body)], axis=1
    )
    assert np.median(off) < 0.04 and off.mean() < 0.05 and np.nanmean(found.errors) < 0.006
    np.testing.assert_allclose(found.posterior.sum(axis=1), 1.0)


def test_a_discovery_of_neutral_names_puts_markers_on_their_side_and_part(planted, monkeypatch):
    hasty = DiscoverSettings(
        heights=(1.0,),
        coarse=80,
        fine=300,
        frames=3,
        alike=1,
        start_frames=1,
        place_spreads=(0.06, 0.06),
        together=DiscoverSettings().together[::3],
        fit=MoshSettings(annealing=(1.0,)),
    )
    monkeypatch.setattr(starts, "_directions", lambda every=starts._directions: every()[::4])
    monkeypatch.setattr(starts, "_POSES", starts._POSES[:2])
    labels = [f"m{k}" for k in range(len(planted.layout))]
    found = discover(planted.body, prior_of_poses(), labels, planted.observed, settings=hasty)
    template = np.asarray(planted.body.v_template)
    right = template[planted.layout.vertices(planted.body)][
        [labels.index(x) for x in found.layout.labels]
    ]
    here = template[found.layout.vertices(planted.body)]
    sided = np.abs(right[:, 0]) > 0.05
    assert np.mean(np.sign(here[sided, 0]) == np.sign(right[sided, 0])) > 0.95
    assert np.median(np.linalg.norm(here - right, axis=1)) < 0.08
    assert len(found.layout) + len(found.left_out) == len(labels) and not found.doubts
    assert all(0.0 <= marker.confidence <= 1.0 for marker in found.layout.markers)


def test_a_reading_that_costs_as_much_is_said_and_names_decide(planted, near):
    skin, found = near
    pairs = {"L": "left", "R": "right"}
    labels = [
        f"{'L' if m.place.startswith('left') else 'R' if m.place.startswith('right') else 'M'}{k}"
        for k, m in enumerate(planted.layout.markers)
    ]
    assert pairs and _cheaper(planted.body, labels, found, None) == (found, None)
    best, margin = _cheaper(planted.body, labels, found, found)
    assert best is found and margin == 0.0
    said = describe(planted.body, labels, planted.observed[::5], found, skin, 0.02, {}, {})
    assert len(said.doubts) == 1 and "not decided" in said.doubts[0]
    sure = describe(planted.body, labels, planted.observed[::5], found, skin, 0.8, {}, {})
    assert not sure.doubts
    halved = [
        a.confidence / b.confidence
        for a, b in zip(said.layout.markers, sure.layout.markers, strict=True)
    ]
    np.testing.assert_allclose(halved, 0.5, atol=0.02)


def test_names_that_contradict_the_sides_found_are_said(planted, near):
    skin, found = near
    across = np.asarray(planted.body.v_template)[found.vertices, 0]
    order = iter(range(99))
    labels = [
        f"{'R' if x > 0.05 else 'L'}{next(order)}" if abs(x) > 0.05 else f"M{next(order)}"
        for x in across
    ]
    swapped = []
    k = {"L": 0, "R": 0, "M": 0}
    for label in labels:
        swapped.append(f"{label[0]}X{k[label[0]]}")
        k[label[0]] += 1
    said = describe(planted.body, swapped, planted.observed[::5], found, skin, None, {}, {})
    assert any("names say the other side" in doubt for doubt in said.doubts)


def test_too_few_labels_are_refused(planted):
    with pytest.raises(HabitusError, match=r"11 labels are ever seen; .* at least 12"):
        discover(
            planted.body, prior_of_poses(), planted.layout.labels[:11], planted.observed[:, :11]
        )
