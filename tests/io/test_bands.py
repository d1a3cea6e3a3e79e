"""Reference curves from a folder of results."""

import numpy as np
import pytest

from habitus.errors import HabitusError
from habitus.io.bands import read_bands

HEAD = "side,stride,percent,knee_flexion_deg,hip_internal_rotation_deg_not_validated"


def write_result(folder, shift):
    """A result of two strides a side, the knee at percent + shift on average; the hip is unknown
    in one stride.
    """
    rows = [HEAD]
    for side in ("left", "right"):
        for stride, extra in ((1, -2.0), (2, 2.0)):
            hip = "" if (side, stride) == ("left", 1) else "5"
            rows += [f"{side},{stride},{k},{k + shift + extra},{hip}" for k in range(101)]
    folder.mkdir(parents=True)
    (folder / "cycles.csv").write_text("\n".join(rows) + "\n")


def test_a_band_is_the_mean_and_the_spread_of_results(tmp_path):
    for name, shift in (("a", 0.0), ("b", 3.0), ("c", 6.0)):
        write_result(tmp_path / name, shift)
    bands = read_bands(tmp_path)
    np.testing.assert_allclose(bands["knee_flexion"][:, 0], np.arange(101) + 3.0)
    np.testing.assert_allclose(bands["knee_flexion"][:, 1], 3.0)
    np.testing.assert_allclose(bands["hip_internal_rotation"], [[5.0, 0.0]] * 101, atol=1e-12)


def test_fewer_than_three_results_and_other_tables_are_refused(tmp_path):
    write_result(tmp_path / "a", 0.0)
    write_result(tmp_path / "b", 0.0)
    with pytest.raises(HabitusError, match=r"2 folders with cycles\.csv"):
        read_bands(tmp_path)
    write_result(tmp_path / "c", 0.0)
    (tmp_path / "c" / "cycles.csv").write_text("time,knee\n1,2\n")
    with pytest.raises(HabitusError, match="its columns differ"):
        read_bands(tmp_path)
    (tmp_path / "c" / "cycles.csv").write_text(f"{HEAD}\nleft,1,0,x,1\n")
    with pytest.raises(HabitusError, match=r"expected cycles\.csv"):
        read_bands(tmp_path)
