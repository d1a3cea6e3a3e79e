"""Lists of labels from other programs: their labels come out, known ones with their places,
prefixes are no part.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.io.layouts.files import load_layout, match_layout

KNOWN = (
    "LASI",
    "RASI",
    "LPSI",
    "RPSI",
    "LKNE",
    "RKNE",
    "LANK",
    "RANK",
    "LTOE",
    "RTOE",
    "LHEE",
    "RHEE",
    "C7",
)
MKR = "!MKR#2\n\n[Autolabel]\n\n{}\n\nLASI,RASI\nPelvis = LASI, RASI, LPSI\n\n[Joints]\n"
VSK = '<?xml version="1.0"?><KinematicModel><MarkerSet><Markers>{}</Markers></MarkerSet></KinematicModel>'
QTM = "<QTM_Parameters><The_3D><Labels>{}</Labels></The_3D></QTM_Parameters>"


def content(form, labels):
    if form == "set.vsk":
        return VSK.format(
            "".join(f'<Marker NAME="{x}" SEGMENT="Pelvis" POSITION="1 2 3"/>' for x in labels)
        )
    if form == "qtm.xml":
        return QTM.format(
            "".join(f"<Label><Name>{x}</Name><RGBColor>65280</RGBColor></Label>" for x in labels)
        )
    return (
        MKR.format("\n".join(labels))
        if form == "set.mkr"
        else "\ufeff" + "\r\n".join(f"{x}\t0" for x in labels)
    )


@pytest.mark.parametrize("form", ["set.vsk", "qtm.xml", "set.mkr", "labels.txt"])
@pytest.mark.parametrize("prefix", ["", "Subject1", "Subject1:"])
def test_labels_come_out_with_the_places_that_known_layouts_have(tmp_path, form, prefix):
    labels = tuple(prefix + label for label in (*KNOWN, "ODD9"))
    (tmp_path / form).write_text(content(form, labels), encoding="utf-8")
    layout = load_layout(tmp_path / form)
    assert set(layout.labels) == set(labels[:-1]) and set(layout.left_out) == {labels[-1]}
    assert (
        layout[prefix + "LASI"].landmark == "left_asis" and layout[prefix + "C7"].landmark == "c7"
    )
    assert set(match_layout(labels, layouts=[layout]).matched) == set(labels[:-1])


@pytest.mark.parametrize("form", ["set.vsk", "qtm.xml", "set.mkr", "labels.txt"])
@pytest.mark.parametrize("labels", [(), ("A1", "A2", "A3"), ("FOO",) * 9])
def test_lists_that_nobody_knows_are_refused_and_point_to_discovery(tmp_path, form, labels):
    (tmp_path / form).write_text(content(form, labels), encoding="utf-8")
    with pytest.raises(HabitusError, match="expected at least 6; let --layout discover") as raised:
        load_layout(tmp_path / form)
    assert "\n" not in str(raised.value)


@given(st.sampled_from(["a.mkr", "a.txt", "a.vsk"]), st.text(max_size=200))
@settings(max_examples=12, deadline=None)
def test_any_text_gives_a_layout_or_one_line(tmp_path_factory, form, text):
    path = tmp_path_factory.mktemp("list") / form
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        load_layout(path)
    except HabitusError as error:
        assert "\n" not in str(error)


def test_long_prefixes_without_a_separator_are_left_off():
    labels = tuple(f"Participant007Session2Trial{label}" for label in KNOWN)
    assert match_layout(labels).matched == labels
