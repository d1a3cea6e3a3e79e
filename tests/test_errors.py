"""What a user reads: one line, short, and nothing in it that a terminal would obey."""

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from habitus.errors import HabitusError, listed, shown

ANYTHING = st.text(st.characters(codec=None, categories=None), max_size=2000)


@given(ANYTHING, st.integers(3, 600))
def test_shown_names_are_printable_and_short(text, limit):
    safe = shown(text, limit)
    assert safe.isprintable() and len(safe) <= limit
    safe.encode()  # no halves of characters
    if text.isprintable() and len(text) <= limit:
        assert safe == text


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("LFHD", "LFHD"),
        ("Größe 左", "Größe 左"),
        ("\x1b[31mred", r"\x1b[31mred"),
        ("two\nlines\t", r"two\x0alines\x09"),
        ("\x9b2J", r"\x9b2J"),
        ("\u202egnp.exe", r"\u202egnp.exe"),
        ("\udcff.c3d", r"\udcff.c3d"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_what_cannot_be_seen_is_written_as_an_escape(text, safe):
    assert shown(text) == safe


def test_long_names_are_cut_in_their_middle():
    cut = shown("a" * 100_000 + "b" * 100_000)
    assert len(cut) == 80 and cut.startswith("aaa") and cut.endswith("bbb") and "…" in cut


@given(ANYTHING)
def test_a_message_is_one_short_line_whatever_it_quotes(text):
    message = str(HabitusError(f"walk.c3d: {text}; export it again"))
    assert message.isprintable() and len(message) < 500
    assert message.startswith("walk.c3d: ") and message.endswith("; export it again")


def test_lines_of_a_message_become_one():
    assert str(HabitusError("one\n  two\r\n\nthree\n")) == "one two three"


def test_errors_travel_between_processes():
    error = HabitusError("x" * 1000)
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == str(HabitusError(error))


def test_long_lists_are_told_by_their_beginning():
    assert listed(["a", "b"]) == "a, b" and listed([]) == ""
    assert listed([str(k) for k in range(20)], 3) == "0, 1, 2 … and 17 more"
