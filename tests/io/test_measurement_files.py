"""Files of pattern programs: what is written is read again, and what is no measurement is said."""

import json
from xml.etree import ElementTree

import pytest

from habitus.body.measurement_names import DEFINITIONS
from habitus.errors import HabitusError
from habitus.export.measurements import program_of, write_measurements
from habitus.io.measurement_files import read_measurements
from habitus.io.measurement_names import PROGRAMS
from habitus.io.models.bodies import load_body
from habitus.jobs.measuring import measure_file

ENDINGS = {"garmentcode": ".yaml", "seamly": ".smis", "freesewing": ".json"}


@pytest.fixture(scope="module")
def values():
    return load_body("female").measure()


def test_every_name_is_one_of_our_measurements():
    for program in PROGRAMS.values():
        assert set(program.names.values()) <= DEFINITIONS.keys()


@pytest.mark.parametrize("program", PROGRAMS)
def test_what_is_written_is_read_again(values, program, tmp_path):
    path = tmp_path / f"her{ENDINGS[program]}"
    assert write_measurements(values, path, program, "female") == ()
    found = read_measurements(path)
    assert found.program == PROGRAMS[program].title and not found.unused
    assert set(found.values) == set(PROGRAMS[program].names.values())
    for name, value in found.values.items():
        assert value == pytest.approx(values[name], abs=6e-3 if name.endswith("deg") else 6e-5)
    assert found.sex == ("female" if program == "seamly" else "")


def test_seamly_opens_what_its_schema_demands(values, tmp_path):
    """v0.3.4.xsd of individual size measurements: these elements, in this order, names unique."""
    write_measurements(values, tmp_path / "her.smis", "seamly")
    root = ElementTree.parse(tmp_path / "her.smis").getroot()
    assert root.tag == "smis"
    order = ["version", "read-only", "notes", "unit", "pm_system", "personal", "body-measurements"]
    assert [each.tag for each in root] == order
    assert [root.findtext(n) for n in ("version", "unit", "pm_system")] == ["0.3.4", "cm", "998"]
    personal = ["family-name", "given-name", "birth-date", "gender", "email"]
    assert [each.tag for each in root.find("personal")] == personal
    names = [m.get("name") for m in root.iterfind("body-measurements/m")]
    assert len(names) == len(set(names)) > 60
    assert all(set(m.attrib) == {"name", "value"} for m in root.iterfind("body-measurements/m"))


def test_units_formulas_zeros_and_foreign_names(tmp_path):
    path = tmp_path / "him.vit"
    path.write_text(
        "<vit><unit>inch</unit><personal><gender>male</gender></personal><body-measurements>"
        '<m name="bust_circ" value="40"/><m name="waist_circ" value="0"/>'
        '<m name="neck_arc_b" value="(neck_circ - 3)"/><m name="@mine" value="4"/>'
        "</body-measurements></vit>"
    )
    found = read_measurements(path)
    assert found.values == pytest.approx({"chest_circumference_m": 1.016}) and found.sex == "male"
    assert found.unused == ("neck_arc_b", "@mine")
    (tmp_path / "a.json").write_text(json.dumps({"measies": {"chest": 1016, "shoulderSlope": 13}}))
    found = read_measurements(tmp_path / "a.json").values
    assert found == pytest.approx({"chest_circumference_m": 1.016, "shoulder_slope_deg": 13})
    (tmp_path / "a.yaml").write_text("body: # cm\n  bust: 101.6\n  _waist_level: 3\n")
    assert read_measurements(tmp_path / "a.yaml").values == pytest.approx(
        {"chest_circumference_m": 1.016}
    )


def test_our_own_files_are_read_too(tmp_path):
    measured = measure_file("default")
    for name in ("a.json", "a.csv"):
        measured.save(tmp_path / name)
        kept = {n: v for n, v in measured.values.items() if v > 0}
        assert read_measurements(tmp_path / name).values == pytest.approx(kept, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "", "no file of measurements; expected .smis"),
        ("a.smis", "<smis>", "a.smis: "),
        ("a.smis", "<smms/>", "table of several sizes"),
        ("a.smis", "<pattern/>", "root is pattern; expected smis or vit"),
        ("a.smis", "<smis><unit>ell</unit></smis>", "unit is ell; expected mm, cm or inch"),
        ("a.smis", '<!DOCTYPE x [<!ENTITY a "b">]><smis/>', "declares the entity"),
        ("a.yaml", "body:\n  - bust", "line 2: - bust; expected NAME: NUMBER"),
        ("a.yaml", "body:\n  bust:\n", "line 2: bust has no number"),
        ("a.json", "[1]", "is no table"),
        ("a.json", '{"chest": "large"}', "holds no measurement (chest are not known)"),
        ("a.csv", "a,b\n1,2", "expected name and value"),
    ],
)
def test_what_is_none_is_refused_in_one_line(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(HabitusError) as told:
        read_measurements(tmp_path / name)
    assert words in str(told.value) and "\n" not in str(told.value)


def test_an_ending_belongs_to_one_program(values, tmp_path):
    assert [program_of(f"a{ending}") for ending in (".vit", ".yml", ".json", ".csv")] == [
        "seamly",
        "garmentcode",
        "",
        "",
    ]
    with pytest.raises(HabitusError, match=r"a\.csv for FreeSewing: expected a name in \.json"):
        write_measurements(values, tmp_path / "a.csv", "freesewing")
    with pytest.raises(HabitusError, match="nothing to write"):
        write_measurements({"height_m": 1.7}, tmp_path / "a.yaml", "garmentcode")
    with pytest.raises(HabitusError, match="format is 'dxf'"):
        write_measurements(values, tmp_path / "a.yaml", "dxf")
