"""Which point of a stream is which marker: told by values, kept when the stream calls its points
something else.
"""

import numpy as np

from habitus.io.streams.wiring import find_wiring, rewired

RNG = np.random.default_rng(3)
POINTS = 1e3 * RNG.normal(size=(40, 6, 3))
NAMES = tuple(f"Bob:{x}" for x in "ABCDEF")


def test_columns_unit_and_signs_are_found_and_later_frames_treated_alike():
    factors = 1e-3 * np.array([1.0, 1.0, -1.0])  # a mirrored space, righted
    markers = POINTS[:, [4, 0, 2]] * factors
    markers[3:20, 1] = np.nan
    found = find_wiring(POINTS, markers, 1e-3)
    assert found.columns.tolist() == [4, 0, 2]
    np.testing.assert_allclose(found.factors, factors)
    frame = 1e3 * RNG.normal(size=(6, 3))
    frame[0], frame[4] = 0.0, (9999999.0, 1.0, 1.0)  # what some systems write for nothing
    told = found.markers(frame)
    assert np.isnan(told[:2]).all()
    np.testing.assert_allclose(told[2], frame[2] * factors)


def test_labels_exchanged_lately_are_exchanged_from_now_on_and_a_marker_seen_only_early_is_found():
    markers = POINTS[:, :3] * 1e-3
    markers[10:, [0, 1]] = markers[10:, [1, 0]]
    markers[8:, 2] = np.nan
    assert find_wiring(POINTS, markers, 1e-3).columns.tolist() == [1, 0, 2]
    markers[:, 2] = 7.0
    assert find_wiring(POINTS, markers, 1e-3).columns.tolist() == [1, 0, -1]


def test_labels_lead_to_the_columns_of_another_set():
    first = find_wiring(POINTS, POINTS[:, [5, 1, 3]] * 1e-3, 1e-3)
    now, gone, new = rewired(first, NAMES, ("Bob:B", "NEW", "Bob:F"))
    assert (now.columns.tolist(), gone, new) == ([2, 0, -1], (2,), ("NEW",))
    again, gone, new = rewired(first, NAMES, ("Ann:F", "Ann:B", "Eve:B"))
    assert again.columns.tolist() == [0, -1, -1] and gone == (1, 2)  # two Bs: nobody knows which
    nothing, gone, _ = rewired(first, NAMES, ())
    assert gone == (0, 1, 2) and np.isnan(nothing.markers(np.zeros((0, 3)))).all()
