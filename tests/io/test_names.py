"""Names out of files as names of files: inside their folder, visible, short, encodable, whatever
they were.
"""

import os
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.names import file_name

NASTY = st.text(st.sampled_from("ab./\\:\0\n\x1b[?*<>|\"' \u202e\udcff\u200bé漢%~"), max_size=300)


@given(NASTY | st.text(max_size=20))
def test_any_text_is_one_name_inside_its_folder_or_refused(text):
    try:
        name = file_name(text)
    except HabitusError:
        assert text.strip() in ("", ".", "..")
        return
    assert name.isprintable() and 0 < len(name.encode()) <= 200
    assert (
        not re.search(r'[<>:"/\\|?*]', name)
        and not name.startswith((".", " "))
        and not name.endswith((".", " "))
    )
    assert Path("out", name).parent == Path("out") and os.path.normpath(
        f"out/{name}"
    ) == os.path.join("out", name)
    assert file_name(name) == name


@pytest.mark.parametrize("text", ["", ".", "..", " ", " .. "])
def test_names_of_other_folders_are_refused(text):
    with pytest.raises(HabitusError, match=r"odd\.npz.*rename the file"):
        file_name(text, "odd.npz")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("walk 01", "walk 01"),
        ("Läufer_走る", "Läufer_走る"),
        ("../../etc/passwd", "_._.._etc_passwd"),
        (".hidden", "_hidden"),
        ("CON", "_CON"),
        ("nul.tar", "_nul.tar"),
        ("console", "console"),
        ("a\x1b[31m\udcff", "a_x1b[31m_udcff"),
        ("C:\\temp", "C__temp"),
    ],
)
def test_what_names_become(text, name):
    assert file_name(text) == name


def test_long_names_are_cut_and_still_told_apart():
    one = file_name("ü" * 300 + "a")
    other = file_name("ü" * 300 + "b")
    assert one != other and one[:80] == other[:80] and len(one.encode()) <= 200
