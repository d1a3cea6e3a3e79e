"""Whatever bytes arrive, a capture or one clear line comes out: never a traceback, a hang, or
memory without end.
"""

import time
from pathlib import Path

import numpy as np
import pytest
from capture_texts import motive_text, qtm_text, trc_text
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mannequin import LABELS, world_points, write_raw_c3d

from habitus.errors import HabitusError
from habitus.io.captures.read import read_captures

_SLOWEST_S = 2.0
_FEW = LABELS[:12]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one small sound file of each kind."""
    folder = tmp_path_factory.mktemp("sound")
    points = world_points("+y", frames=12)[:, :12]
    write_raw_c3d(folder / "a.c3d", _FEW, points * 1e3, parameters={("SUBJECTS", "NAMES"): ["Ann"]})
    np.savez(folder / "a.npz", markers=points, labels=np.array(_FEW), frame_rate=100)
    np.savez_compressed(folder / "b.npz", markers=points, labels=np.array(_FEW), frame_rate=100)
    (folder / "a.trc").write_text(trc_text(_FEW, points * 1e3))
    (folder / "a.csv").write_text(motive_text(_FEW, points))
    (folder / "a.tsv").write_text(qtm_text(_FEW, points * 1e3, times=True, more=True))
    return folder


def _read(folder: Path, name: str, content: bytes) -> None:
    """Reads ``content``: a sane capture, or a HabitusError of one line that names the file."""
    path = folder / name
    path.write_bytes(content)
    started = time.perf_counter()
    try:
        captures = read_captures(path)
    except HabitusError as error:
        assert "\n" not in str(error) and name in str(error)
    else:
        for capture in captures:
            frames, markers, axes = capture.markers.shape
            assert (
                frames > 0
                and markers == len(capture.labels) == len(set(capture.labels))
                and axes == 3
            )
            assert np.isfinite(capture.markers).any() and not np.isinf(capture.markers).any()
            assert 0 < capture.rate_hz < 1e6 and capture.up_axis[1] in "xyz"
    assert time.perf_counter() - started < _SLOWEST_S


NAMES = ("a.c3d", "a.trc", "a.csv", "a.tsv", "a.npz", "b.npz")
_FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.parametrize("name", NAMES)
@given(share=st.floats(0, 1))
@_FUZZ
def test_truncated(tmp_path: Path, sound: Path, name: str, share: float) -> None:
    _read(tmp_path, name, (content := (sound / name).read_bytes())[: int(share * len(content))])


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@_FUZZ
def test_flipped_bits(tmp_path: Path, sound: Path, name: str, data: st.DataObject) -> None:
    content = bytearray((sound / name).read_bytes())
    reach = data.draw(st.sampled_from([24, 600, len(content)]))
    places = st.tuples(st.integers(0, min(reach, len(content)) - 1), st.integers(0, 255))
    for place, value in data.draw(st.lists(places, min_size=1, max_size=8)):
        content[place] = value
    _read(tmp_path, name, bytes(content))


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@_FUZZ
def test_pieces_lost_doubled_and_mixed_up(
    tmp_path: Path, sound: Path, name: str, data: st.DataObject
) -> None:
    content = (sound / name).read_bytes()
    cut = st.integers(0, len(content))
    for _ in range(data.draw(st.integers(1, 3))):
        first, second = sorted((data.draw(cut), data.draw(cut)))
        middle = data.draw(
            st.sampled_from([b"", content[first:second] * 2, b"nan", b"-1e400,\t", b"\0", b"\n"])
        )
        content = content[:first] + middle + content[second:]
    _read(tmp_path, name, content)


@pytest.mark.parametrize("name", NAMES)
@given(content=st.one_of(st.binary(max_size=3000), st.text(max_size=2000).map(str.encode)))
@_FUZZ
def test_anything_at_all(tmp_path: Path, name: str, content: bytes) -> None:
    _read(tmp_path, name, content)


_CELL = st.sampled_from(
    [
        "",
        "1",
        "2",
        "3.5",
        "-4e3",
        "nan",
        "inf",
        "1e999",
        "x",
        "Marker",
        "Position",
        "X",
        "Y",
        "Z",
        "LFHD",
        "Frame#",
    ]
)
_TABLE = st.lists(st.lists(_CELL, max_size=9), max_size=9)


@pytest.mark.parametrize("name", ["a.trc", "a.csv", "a.tsv"])
@given(rows=_TABLE, keep=st.integers(0, 12))
@_FUZZ
def test_tables_of_anything_under_a_sound_header(
    tmp_path: Path, sound: Path, name: str, rows: list[list[str]], keep: int
) -> None:
    separator = "," if name == "a.csv" else "\t"
    head = (sound / name).read_text().splitlines()[:keep]
    _read(tmp_path, name, "\n".join([*head, *(separator.join(row) for row in rows)]).encode())


@given(
    counts=st.tuples(*[st.integers(0, 65535)] * 4),
    scale=st.floats(width=32),
    data=st.integers(0, 65535),
)
@_FUZZ
def test_headers_that_promise_the_moon(
    tmp_path: Path, sound: Path, counts: tuple[int, ...], scale: float, data: int
) -> None:
    content = bytearray((sound / "a.c3d").read_bytes())
    content[2:10] = np.array(counts, "<u2").tobytes()
    content[12:16] = np.float32(scale).tobytes()
    content[16:18] = np.uint16(data).tobytes()
    _read(tmp_path, "a.c3d", bytes(content))


def test_points_of_which_none_is_near_another_are_no_capture(tmp_path: Path) -> None:
    write_raw_c3d(
        tmp_path / "a.c3d", _FEW[:2], np.array([[[-4e4, 0.0, 0.0], [4e4, 0.0, 0.0]]]), unit="m"
    )
    with pytest.raises(HabitusError, match=r"a\.c3d: its points are kilometres"):
        read_captures(tmp_path / "a.c3d")
