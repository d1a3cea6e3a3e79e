"""`habitus gait` from a capture of a laboratory to its files, against the laboratory's own numbers."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import ezc3d
import numpy as np
import pytest

import habitus as hb
from habitus.body.anatomical_angles import segments_of, without_segments
from habitus.body.motion import BodyMotion
from habitus.cli.main import main
from habitus.errors import HabitusError
from habitus.export.opensim_engine import engine
from habitus.export.opensim_setup import FILES
from habitus.gait.analysis import analyse
from habitus.jobs.anatomy import anatomy_of
from habitus.jobs.gait import _capture_of, gait, gaits
from habitus.jobs.results import Motion


@pytest.fixture(scope="module")
def walk(shared, tmp_path_factory):
    """A child's walk over two plates, fitted and analysed by Plug-in Gait's convention."""
    out = tmp_path_factory.mktemp("gait") / "out"
    (result,) = gaits([shared / "mocap" / "HC030A05.c3d"], out, convention="pig")
    return result, out


def own_output(path, name: str) -> np.ndarray:
    """What the laboratory's software wrote (T, 3), NaN where nothing."""
    file = ezc3d.c3d(str(path))
    point = file["parameters"]["POINT"]
    keys = sorted((k for k in point if k.startswith("LABELS")), key=lambda k: (len(k), k))
    labels = [label for key in keys for label in point[key]["value"]]
    values = file["data"]["points"][:3, next(k for k, v in enumerate(labels) if v.endswith(name))].T
    return np.where(np.abs(values).sum(1, keepdims=True) > 0, values, np.nan)


def rows_of(path) -> tuple[list[str], np.ndarray]:
    rows = list(csv.reader(path.read_text().splitlines()))
    return rows[0], np.array(
        [[float(cell) if cell else np.nan for cell in row] for row in rows[1:]]
    )


@pytest.mark.parametrize(
    ("name", "theirs", "offset", "shape"),
    [("pelvis_tilt", "PelvisAngles", 3.0, 1.5), ("hip_flexion", "HipAngles", 4.7, 2.2),
     ("knee_flexion", "KneeAngles", 3.0, 2.0), ("ankle_dorsiflexion", "AnkleAngles", 4.0, 2.5)],
)  # fmt: skip
def test_sagittal_angles_agree_with_plug_in_gait(walk, shared, name, theirs, offset, shape):
    for side in ("left", "right"):
        own = walk[0].angles[f"{side}_{name}"]
        reference = own_output(shared / "mocap" / "HC030A05.c3d", side[0].upper() + theirs)[:, 0]
        off = (own - reference)[np.isfinite(reference)]
        assert np.sqrt(np.mean(off**2)) < offset and off.std() < shape


def test_moments_agree_with_plug_in_gait(walk, shared):
    analysis = walk[0]
    table = dict(zip(analysis.dynamics.names, analysis.dynamics.values.T, strict=True))
    for contact in analysis.contacts:
        rows = slice(int(contact.start * 100), int(contact.end * 100))
        for name, theirs, most in (
            ("ankle_plantarflexion", "AnkleMoment", 0.08),
            ("knee_extension", "KneeMoment", 0.08),
            ("hip_extension", "HipMoment", 0.14),
        ):
            reference = own_output(
                shared / "mocap" / "HC030A05.c3d", contact.side[0].upper() + theirs
            )
            off = table[f"{contact.side}_{name}_moment"][rows] - 1e-3 * reference[rows, 0]
            assert np.sqrt(np.nanmean(off**2)) < most, (contact.side, name)


def test_forces_and_motion_agree(walk):
    analysis = walk[0]
    assert [contact.side for contact in analysis.contacts] == ["right", "left"]
    assert not any(contact.refused for contact in analysis.contacts)
    assert analysis.residual_share < 0.045 and abs(analysis.vertical_bias) < 0.015
    assert analysis.masses.total == pytest.approx(45.8) and "recorded" in analysis.masses.source


def test_events_by_the_motion_agree_with_the_plates(walk, shared):
    fit = hb.mosh(shared / "mocap" / "HC030A05.c3d")[0]
    blind = gait(fit)
    assert {events.source for events in blind.events.values()} == {"motion"} and not blind.contacts
    for contact in walk[0].contacts:
        own = blind.events[contact.side]
        assert np.abs(own.strikes - contact.start).min() < 0.03
        assert np.abs(own.offs - contact.end).min() < 0.03


@pytest.mark.parametrize("part", ["early", "late"])
def test_a_plate_that_bears_only_a_part_is_refused(walk, part):
    """Half of a contact with a third less force, as of a foot half beside the plate; the other
    contact is used on.
    """
    analysis = walk[0]
    plate = analysis.plates[0]
    first, last = np.flatnonzero(np.isfinite(plate.pressure[:, 0]))[[0, -1]]
    middle = (first + last) // 2
    factor = np.ones((len(plate.force), 1))
    factor[slice(first, middle) if part == "early" else slice(middle, last)] = 0.67
    plates = [replace(plate, force=factor * plate.force), *analysis.plates[1:]]
    fit = analysis.motion
    again = analyse(fit, anatomy_of(fit), analysis.angles, analysis.masses, plates, analysis.events)
    refused = {contact.plate: contact.refused for contact in again.contacts}
    assert "lacks" in refused.pop(plate.number) and not any(refused.values())


def test_files_hold_what_the_analysis_does(walk):
    analysis, out = walk
    heads, table = rows_of(out / "angles.csv")
    assert heads[0] == "time_s" and "left_knee_flexion_deg" in heads
    assert "left_hip_internal_rotation_deg_not_validated" in heads
    np.testing.assert_allclose(table[:, 0], np.arange(len(table)) / 100.0, atol=1e-9)
    np.testing.assert_allclose(table[:, 1:], analysis.angles.values, atol=1e-4)
    heads, table = rows_of(out / "dynamics.csv")
    assert "right_knee_extension_moment_Nm_kg" in heads and "residual_x_N" in heads
    rows = list(csv.DictReader((out / "cycles.csv").read_text().splitlines()))
    assert len(rows) == 101 * len(analysis.strides) and {r["side"] for r in rows} == {
        "left",
        "right",
    }
    stride = next(s for s in analysis.strides if s.side == "left")
    first = next(r for r in rows if r["side"] == "left")
    expected = np.interp(
        stride.start * 100,
        np.arange(len(analysis.angles.values)),
        analysis.angles["left_knee_flexion"],
    )
    assert abs(float(first["knee_flexion_deg"]) - expected) < 1e-3
    numbers = json.loads((out / "gait.json").read_text())
    assert numbers["landmarks_from_markers"]["left_asis"] == "LASI"
    assert numbers["residual_share_of_weight"] == pytest.approx(analysis.residual_share)
    assert "left_knee_adduction" in numbers["angles_not_validated"]
    page = (out / "gait.html").read_text()
    assert page.count("<svg") > 20 and "Not validated" in page.replace(
        "not validated", "Not validated"
    )


def test_outputs_are_written_into_a_copy_of_the_capture(walk, shared, tmp_path):
    """Beside Plug-in Gait's own, which stay, as do markers, plates and events."""
    source = shared / "mocap" / "HC030A05.c3d"
    analysis = walk[0]
    analysis.save(tmp_path / "out", capture=source)
    path = tmp_path / "out" / "gait.c3d"
    own = own_output(path, "LKneeAngles_habitus")
    for axis, name in enumerate(("flexion", "adduction", "internal_rotation")):
        np.testing.assert_allclose(own[:, axis], analysis.angles[f"left_knee_{name}"], atol=1e-3)
    moments = dict(zip(analysis.dynamics.names, analysis.dynamics.values.T, strict=True))
    own = own_output(path, "RAnkleMoment_habitus")
    np.testing.assert_allclose(
        own[:, 0], 1e3 * moments["right_ankle_plantarflexion_moment"], atol=1e-2
    )
    np.testing.assert_allclose(own_output(path, "LKneeAngles"), own_output(source, "LKneeAngles"))
    before, after = (ezc3d.c3d(str(each)) for each in (source, path))
    np.testing.assert_array_equal(before["data"]["analogs"], after["data"]["analogs"])
    assert "LKneeAngles_habitus" in after["parameters"]["POINT"]["ANGLES"]["value"]
    capture, again = hb.read_capture(source), hb.read_capture(path)
    assert capture.labels == again.labels  # outputs are no markers
    np.testing.assert_allclose(capture.markers, again.markers, atol=1e-6)
    with pytest.raises(HabitusError, match="already"):
        analysis.save(tmp_path / "twice", capture=path)


def test_sides_of_opensims_names_stay_apart(shared, tmp_path):
    """knee_angle_r and knee_angle_l are one curve of each side, and two outputs."""
    (result,) = gaits(
        [shared / "mocap" / "HC030A05.c3d"], tmp_path / "out", convention="opensim", c3d=True
    )
    rows = list(csv.DictReader((tmp_path / "out" / "cycles.csv").read_text().splitlines()))
    assert "knee_angle_deg" in rows[0] and not any(
        h.endswith(("_l_deg", "_r_deg")) for h in rows[0]
    )
    for side in ("left", "right"):
        stride = next(s for s in result.strides if s.side == side)
        own = next(row for row in rows if row["side"] == side)
        angle = result.angles[f"knee_angle_{side[0]}"]
        expected = np.interp(stride.start * 100, np.arange(len(angle)), angle)
        assert abs(float(own["knee_angle_deg"]) - expected) < 1e-3
        written = own_output(tmp_path / "out" / "gait.c3d", f"{side[0].upper()}KneeAngles_habitus")
        np.testing.assert_allclose(written[:, 0], angle, atol=1e-3)


def test_a_fit_that_is_not_good_is_said(walk, tmp_path):
    """Of markers that are not where the body is, angles are not."""
    fit = walk[0].motion
    shift = 0.3 * np.random.default_rng(0).normal(size=fit.observed_markers.shape)
    wrong = replace(fit, observed_markers=fit.observed_markers + shift)
    assert wrong.verdict.level != "good"
    gait(wrong).save(tmp_path / "out")
    numbers = json.loads((tmp_path / "out" / "gait.json").read_text())
    assert numbers["fit_verdict"]["level"] == wrong.verdict.level
    assert f"banner {wrong.verdict.level}" in (tmp_path / "out" / "gait.html").read_text()


def test_the_capture_of_a_fit_is_the_one_of_its_name(walk):
    fit = replace(walk[0].motion, capture_name="walk_Anna")
    files = [
        Path(name) for name in ("walk.c3d", "w.c3d", "run.c3d", "walk_Anna.trc", "walk_Ann.txt")
    ]
    assert _capture_of(fit, files) == Path("walk.c3d")
    assert _capture_of(fit, [Path("run.c3d")]) is None


def test_a_copy_needs_a_capture(walk, tmp_path):
    walk[0].motion.save(tmp_path / "fit")
    with pytest.raises(HabitusError, match="--captures"):
        gaits([tmp_path / "fit"], tmp_path / "out", c3d=True)
    with pytest.raises(HabitusError, match="names differ"):
        gaits([tmp_path / "fit", tmp_path / "fit"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_for_opensim(walk, tmp_path):
    """Forces, where they act and what they turn are those of the plates, y up."""
    analysis = walk[0]
    analysis.save(tmp_path / "out", opensim=True)
    folder = tmp_path / "out" / "opensim"
    assert {path.name for path in folder.iterdir()} == set(FILES)
    lines = (folder / "ground_forces.mot").read_text().splitlines()
    start = lines.index("endheader") + 1
    heads = lines[start].split("\t")
    values = np.array([[float(x) for x in line.split("\t")] for line in lines[start + 1 :]])
    assert f"nRows={len(values)}" in lines and f"nColumns={len(heads)}" in lines
    table = dict(zip(heads, values.T, strict=True))
    weight = 9.81 * 45.8
    for contact in analysis.contacts:
        end = contact.side[0]
        inside = (table["time"] > contact.start + 0.1) & (table["time"] < contact.end - 0.1)
        up = table[f"ground_force_{end}_vy"]
        assert 0.6 * weight < up[inside].mean() < 1.2 * weight
        assert not up[table["time"] < contact.start - 0.01].any()
        assert np.abs(table[f"ground_force_{end}_py"][inside]).max() < 0.01
        plate = next(p for p in analysis.plates if p.number == contact.plate)
        total = np.linalg.norm([table[f"ground_force_{end}_v{axis}"] for axis in "xyz"], axis=0)
        np.testing.assert_allclose(
            total[inside], np.linalg.norm(plate.force, axis=1)[inside], atol=1e-3
        )
    loads = ElementTree.parse(folder / "external_loads.xml").getroot()
    assert [force.findtext("applied_to_body") for force in loads.iter("ExternalForce")] == [
        "calcn_r",
        "calcn_l",
    ]
    tasks = ElementTree.parse(folder / "inverse_kinematics.xml").getroot()
    assert [task.get("name") for task in tasks.iter("IKMarkerTask")] == list(analysis.motion.labels)
    markers = hb.read_capture(folder / "markers.trc")
    assert markers.labels == analysis.motion.labels


def test_opensim_reads_the_folder(walk, tmp_path):
    pytest.importorskip("opensim", reason="pip install opensim")
    opensim = engine()  # writes no log
    walk[0].save(tmp_path / "out", opensim=True)
    folder = tmp_path / "out" / "opensim"
    storage = opensim.Storage(str(folder / "ground_forces.mot"))
    assert storage.getSize() > 1000 and storage.getColumnLabels().getSize() == 19
    loads = opensim.ExternalLoads(str(folder / "external_loads.xml"), True)
    assert loads.getSize() == 2
    tool = opensim.InverseKinematicsTool(str(folder / "inverse_kinematics.xml"), False)
    assert tool.getMarkerDataFileName().endswith("markers.trc")
    assert tool.get_IKTaskSet().getSize() == len(walk[0].motion.labels)
    opensim.InverseDynamicsTool(str(folder / "inverse_dynamics.xml"), False)


def test_a_laboratorys_band_is_drawn_and_a_wrong_one_refused(walk, tmp_path):
    analysis, _ = walk
    band = tmp_path / "band.csv"
    lines = ["percent,knee_flexion_mean,knee_flexion_sd"]
    lines += [f"{p},{30 + 0.1 * p},5" for p in range(0, 101, 2)]
    band.write_text("\n".join(lines))
    analysis.save(tmp_path / "out", band)
    assert (tmp_path / "out" / "gait.html").read_text().count("<polygon") == 1
    for text, message in (
        ("a,b\n1,2\n", "expected percent"),
        ("", "none"),
        ("percent,a_mean,a_sd\n0,x,1\n5,1,1\n", "expected numbers"),
        ("percent,a_mean,a_sd\n5,1,1\n5,1,1\n", "does not rise"),
    ):
        band.write_text(text)
        with pytest.raises(HabitusError, match=message) as caught:
            analysis.save(tmp_path / "out", band)
        assert "\n" not in str(caught.value)


def test_angles_of_any_sensors_fit_come_by_the_same_call(walk, tmp_path):
    fit = walk[0]
    body = hb.load_body("female")
    pose = np.zeros((5, len(body.joint_names), 3))
    motion = Motion.of(
        BodyMotion(
            body, np.zeros(body.num_betas), pose, np.zeros((5, 3)), 30.0, "+y", body_name="female"
        )
    )
    table = motion.angles("isb")
    assert table.values.shape == (5, len(table.names)) and not table.sources
    assert not table.validated.any()  # nobody compared them
    motion.export(tmp_path / "still.npz")
    again = gait(tmp_path / "still.npz")
    np.testing.assert_allclose(again.angles.values, table.values, atol=1e-3)
    assert not again.strides and again.residual_share is None
    assert fit.angles.sources


def test_angles_of_segments_without_markers_are_not_validated(shared):
    """A set of the legs alone: its arms hang as the pose prior has them."""
    fit = hb.mosh(shared / "mocap" / "HC030A05.c3d")[0]
    table = fit.angles("isb")
    sure = dict(zip(table.names, table.validated, strict=True))
    assert sure["left_knee_flexion"] and sure["right_elbow_flexion"]
    blind = without_segments(table, ["left_knee", "right_elbow"])
    sure = dict(zip(blind.names, blind.validated, strict=True))
    assert not sure["left_knee_flexion"] and not sure["left_ankle_dorsiflexion"]
    assert (
        not sure["right_elbow_flexion"]
        and sure["right_knee_flexion"]
        and sure["left_elbow_flexion"]
    )
    assert segments_of("knee_angle_l") == {"left_hip", "left_knee"}
    assert segments_of("pelvis_tilt") == {"pelvis"}
    with pytest.raises(HabitusError, match="needs 3 or more"):
        gait(replace_frames(fit, 2))


def replace_frames(fit, count: int) -> BodyMotion:
    return BodyMotion(
        fit.body, fit.betas, fit.pose[:count], fit.trans[:count], fit.rate_hz, fit.up_axis
    )


def test_the_command(shared, tmp_path, capsys):
    source = shared / "mocap" / "HC042A40.c3d"
    main(["gait", str(source), "--out", str(tmp_path / "out"), "--convention", "opensim"])
    said = capsys.readouterr().out
    assert "beyond the plate's edge" in said and "strides" in said
    with open(tmp_path / "out" / "angles.csv") as file:
        assert "hip_flexion_r_deg" in file.readline()
    for extra in ([str(tmp_path / "none.c3d")], [str(source), "--mass", "900"]):
        with pytest.raises(SystemExit) as ended:
            main(["gait", *extra, "--out", str(tmp_path / "o")])
        assert ended.value.code == 2
    assert "mass is 900 kg" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_plates_weigh_whose_mass_is_not_known(shared):
    """Where they bear the person for a second; within what a volume may be off."""
    path = shared / "mocap" / "HC042A13.c3d"
    fit = replace(hb.mosh(path)[0], recorded={})
    analysis = gait(fit, path)
    assert "plates" in analysis.masses.source
    assert abs(analysis.masses.total - 59.9) < 1.0 and abs(analysis.vertical_bias) < 0.005
    assert gait(fit).masses.source == "from the volume"


def test_a_result_folder_takes_its_capture_from_a_folder(shared, tmp_path):
    fit = hb.mosh(shared / "mocap" / "HC042A13.c3d")[0]
    fit.save(tmp_path / "HC042A13")
    (result,) = gaits([tmp_path / "HC042A13"], tmp_path / "out", captures=shared / "mocap")
    assert len(result.contacts) == 2 and result.residual_share < 0.045
    (without,) = gaits([tmp_path / "HC042A13"], tmp_path / "out")
    assert not without.contacts
