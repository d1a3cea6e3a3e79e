"""Exports of long motions: written a block of frames at a time, or refused with advice."""

import tracemalloc

import numpy as np
import pytest
from synthetic_fit import synthetic_fit, tube_body

from habitus.errors import HabitusError
from habitus.export import animation, glb
from habitus.export.motion import export_motion
from habitus.io.people import read_fit
from habitus.parallel import blocks


def peak(moving, path):
    """Bytes that an export allocates, at most; arrays over files do not count."""
    tracemalloc.start()
    export_motion(moving, path)
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


@pytest.mark.parametrize("ending", [".bvh", ".trc"])
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path, monkeypatch, ending):
    monkeypatch.setattr(blocks, "BLOCK", 256)
    monkeypatch.setattr(blocks, "IN_MEMORY", 1 << 16)
    short, long = (synthetic_fit(frames) for frames in (1000, 8000))
    export_motion(synthetic_fit(4), tmp_path / f"warm{ending}")
    assert peak(long, tmp_path / f"long{ending}") < 1.5 * peak(short, tmp_path / f"short{ending}")


@pytest.mark.parametrize("ending", [".bvh", ".trc", ".mot"])
def test_blocks_leave_no_seam(tmp_path, monkeypatch, ending):
    fit = synthetic_fit(90)
    export_motion(fit, tmp_path / f"a{ending}")
    whole = (tmp_path / f"a{ending}").read_bytes()
    monkeypatch.setattr(blocks, "BLOCK", 7)
    export_motion(fit, tmp_path / f"a{ending}")
    assert (tmp_path / f"a{ending}").read_bytes() == whole


@pytest.mark.parametrize("ending", [".fbx", ".glb"])
def test_animations_of_too_many_frames_are_refused_with_a_rate_that_fits(
    tmp_path, monkeypatch, ending
):
    fit = synthetic_fit(200, body=tube_body(posedirs=True), rate_hz=120.0)
    monkeypatch.setattr(animation, "MOST_FRAMES", 50)
    if ending == ".glb":  # leaves frames out by itself, and says how many are left
        monkeypatch.setattr(glb, "GLB_FRAMES", 50)
        written = export_motion(fit, tmp_path / "a.glb")
        assert (written.frames, written.rate_hz) == (50, 30.0)
        return
    with pytest.raises(HabitusError, match=r"200 frames are too many .* at most 50.*--fps 27"):
        export_motion(fit, tmp_path / f"a{ending}")
    written = export_motion(fit, tmp_path / f"a{ending}", fps=27)
    assert written.frames <= 50


def test_large_arrays_of_a_file_are_read_a_block_at_a_time(tmp_path, monkeypatch):
    fit = synthetic_fit(500)
    export_motion(fit, tmp_path / "a.npz")
    known = read_fit(tmp_path / "a.npz", fit.body)
    monkeypatch.setattr(blocks, "IN_MEMORY", 1 << 12)
    monkeypatch.setattr("habitus.io.archives.IN_MEMORY", 1 << 12)
    monkeypatch.setattr(blocks, "BLOCK", 64)
    read = read_fit(tmp_path / "a.npz", fit.body)
    for name in ("pose", "trans", "observed_markers", "marker_weights", "soft_tissue"):
        assert blocks.is_file_backed(getattr(read, name))
        np.testing.assert_array_equal(getattr(read, name), getattr(known, name))
    content = (tmp_path / "a.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(content[: len(content) // 2])
    with pytest.raises(HabitusError, match=r"cut\.npz"):
        read_fit(tmp_path / "cut.npz", fit.body)
