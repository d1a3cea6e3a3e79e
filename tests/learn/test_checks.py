from dataclasses import replace

import numpy as np
import pytest
import torch

from habitus.errors import HabitusError
from habitus.io.models.bodies import load_body
from habitus.io.registrations.templates import body_template
from habitus.learn.checks import check_registrations, other_topology, refuse
from habitus.learn.findings import check_template
from habitus.mesh.registrations import Registrations
from habitus.mesh.template import Template

SUBJECTS, POSES = 5, 6


def skinned():
    """The default body by skinning alone: its parts turn as their joints do, which flesh smears by some degrees."""
    return replace(load_body("default"), posedirs=None)


@pytest.fixture(scope="module")
def template():
    whole = body_template(load_body("default"))
    return Template(whole.vertices, whole.faces, whole.part, whole.parents, whole.joint_names)


@pytest.fixture(scope="module")
def surfaces():
    """Five people in six poses each that bend every joint, with a millimetre of noise."""
    body, rng = skinned(), np.random.default_rng(3)
    betas = torch.tensor(rng.normal(size=(SUBJECTS, body.num_betas))).repeat_interleave(POSES, 0)
    pose = torch.tensor(rng.normal(size=(SUBJECTS * POSES, 24, 3)) * 0.4)
    vertices = body(
        betas, pose, torch.tensor(rng.normal(size=(SUBJECTS * POSES, 3)))
    ).vertices.numpy()
    return vertices + rng.normal(0, 0.001, vertices.shape)


def registrations_of(vertices, template, **changed):
    n = vertices.shape[0]
    words = {
        "subject": tuple(f"person {k // POSES}" for k in range(n)),
        "sex": ("female",) * n,
        "set": ("pose",) * n,
        "name": tuple(f"scan {k}" for k in range(n)),
    }
    return Registrations(vertices=vertices, faces=template.faces, **(words | changed))


def findings_of(vertices, template, **changed):
    return [
        (f.kind, f.name, f.message)
        for f in check_registrations(registrations_of(vertices, template, **changed), template)
    ]


def swapped(words, **at):
    words = list(words)
    for key, word in at.items():
        words[int(key[1:])] = word
    return tuple(words)


def test_good_registrations_pass(surfaces, template):
    assert findings_of(surfaces, template) == []


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda v: np.where(np.arange(len(v))[:, None] < 7, np.inf, v), "7 vertices are not finite"),
        (lambda v: np.where(np.arange(len(v))[:, None] == 3, -np.inf, v), "1 vertex is not finite"),
        (lambda v: np.where(np.arange(len(v))[:, None] % 2 == 0, np.nan, v), "3750 of its 7499 vertices are holes"),
        (lambda v: 1000 * v, "in millimetres"),
        (lambda v: 100 * v, "in centimetres"),
        (lambda v: v / 0.0254, "in inches"),
        (lambda v: 10 * v, "in decimetres"),
        (lambda v: v / 0.3048, "in feet"),
        (lambda v: v / 1000, "metres taken for millimetres"),
        (lambda v: v / 100, "metres taken for centimetres"),
        (lambda v: 250000 * v, "no known unit"),
        (lambda v: 0 * v, "collapsed to a point"),
        (lambda v: v * [0, 1, 0], "collapsed|off the template's"),
        (lambda v: np.where(v[:, :1] > np.median(v[:, 0]), v.mean(0), v), "collapsed to a point|cross the body"),
        (lambda v: np.random.default_rng(0).permutation(v), "each in its place"),
        (lambda v: np.roll(v, 1, axis=0), "each in its place|over 5 times"),
        (lambda v: v + 5.0 * (np.arange(len(v)) == 100)[:, None], "vertices fly off"),
        (lambda v: v + np.random.default_rng(0).normal(0, 0.02, v.shape), "in the mean|each in its place"),
        (lambda v: v * [-1, 1, 1], "mirror image"),
        (lambda v: v[:, [1, 0, 2]], "mirror image"),
    ],
)  # fmt: skip
def test_one_spoilt_mesh_is_named_and_no_other(surfaces, template, spoil, message):
    vertices = surfaces[: 2 * POSES].copy()
    vertices[8] = spoil(vertices[8])
    findings = [
        f
        for f in check_registrations(registrations_of(vertices, template), template)
        if f.kind == "error"
    ]
    assert [f.name for f in findings] == ["scan 8"]
    with pytest.raises(
        HabitusError, match=rf"^1 error in the registrations: scan 8: .*({message})[^\n]*$"
    ):
        refuse(findings)


def test_where_a_body_stands_and_how_it_is_turned_does_not_matter(surfaces, template):
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    assert findings_of(surfaces @ turn + [100.0, -3.0, 7.0], template) == []


@pytest.mark.parametrize("rows", [[8], [8, 20], [0, 13, 29]])
def test_registrations_under_another_subjects_name_are_found_and_no_other(surfaces, template, rows):
    honest = [f"person {k // POSES}" for k in range(len(surfaces))]
    subject = [
        f"person {(k // POSES + 2) % SUBJECTS}" if k in rows else word
        for k, word in enumerate(honest)
    ]
    errors = [
        finding
        for finding in findings_of(surfaces, template, subject=tuple(subject))
        if finding[0] == "error"
    ]
    assert [name for _, name, _ in errors] == [f"scan {k}" for k in rows]
    for k, (_, _, message) in zip(rows, errors, strict=True):
        assert f"subject is {subject[k]} but its build is that of {honest[k]}" in message


def test_good_registrations_that_share_a_name_with_a_stranger_are_not_blamed(surfaces, template):
    kept = [
        k for k in range(len(surfaces)) if k % POSES < 2 or k == 8
    ]  # two of each, three of the second
    subject = ["a", "a", "b", "b", "c", "c", "b", "d", "d", "e", "e"]
    assert [k // POSES for k in kept] == [0, 0, 1, 1, 1, 2, 2, 3, 3, 4, 4]
    errors = [
        finding
        for finding in findings_of(surfaces[kept], template, subject=tuple(subject))
        if finding[0] == "error"
    ]
    assert {name for _, name, _ in errors} <= {"scan 4", "scan 6"}


def test_a_subject_of_two_sexes_is_refused(surfaces, template):
    sex = swapped(["female"] * len(surfaces), k14="male")
    message = "the sex of this subject is female in 5 (first scan 12) and male in 1 (first scan 14); expected one"
    assert findings_of(surfaces, template, sex=sex) == [("error", "person 2", message)]


def test_a_subject_with_one_pose_is_reported(surfaces, template):
    subject = swapped([f"person {k // POSES}" for k in range(len(surfaces))], k29="passer-by")
    found = findings_of(surfaces, template, subject=subject)
    assert [(kind, name) for kind, name, _ in found] == [("warning", "passer-by")]
    which = swapped(["pose"] * len(surfaces), k29="shape")
    assert findings_of(surfaces, template, subject=subject, set=which) == []


@pytest.mark.parametrize(
    ("joint", "straight"),
    [
        ("left_elbow", {"left_shoulder": 0, "left_wrist": 0}),
        ("neck", {}),
        ("right_knee", {"right_hip": 1}),
    ],
)
def test_a_joint_that_hardly_bends_is_named(template, joint, straight):
    """Its neighbours do not turn along the limb, at that axis: flesh hands such a twist on over the joint."""
    body, rng = skinned(), np.random.default_rng(3)
    pose = rng.normal(size=(12, 24, 3)) * 0.4
    k = body.joint_names.index(joint)
    pose[:, k] = [0.0, 0.4, 0.1] + 0.02 * rng.normal(size=(12, 3))  # always bent alike is not bent
    for other, axis in straight.items():
        pose[:, body.joint_names.index(other), axis] = 0.0
    betas = torch.tensor(rng.normal(size=(2, body.num_betas))).repeat_interleave(6, 0)
    vertices = body(betas, torch.tensor(pose)).vertices.numpy()
    found = findings_of(vertices, template, subject=("a",) * 6 + ("b",) * 6)
    assert [(kind, name) for kind, name, _ in found] == [("warning", joint)]
    assert "0 of 12 do" in found[0][2]


def test_too_few_poses_at_all_are_one_warning(surfaces, template):
    found = findings_of(surfaces[:3], template, subject=("a",) * 3)
    assert [(kind, name) for kind, name, _ in found] == [("warning", "the registrations")]


def test_joints_without_vertices_are_reported(surfaces, template):
    part = np.where(template.part == 22, 20, template.part)
    found = findings_of(surfaces, replace(template, part=part))
    assert [(kind, name) for kind, name, _ in found] == [("warning", "left_hand")]


def test_another_topology_is_refused_but_not_another_order_of_faces(surfaces, template):
    rng = np.random.default_rng(3)
    shuffled = np.roll(template.faces, 1, axis=1)[rng.permutation(len(template.faces))]
    good = registrations_of(surfaces, template)
    assert other_topology(replace(good, faces=shuffled), template) is None
    flipped = template.faces.copy()
    flipped[:4] = flipped[:4, ::-1]
    cases = {
        "4 of 14986 faces are not": replace(good, faces=flipped),
        "14985 faces, the template has 14986": replace(good, faces=template.faces[1:]),
        "7500 vertices, the template has 7499": replace(
            good, vertices=np.zeros((len(good), 7500, 3))
        ),
    }
    for message, registrations in cases.items():
        with pytest.raises(HabitusError, match=message):
            refuse(check_registrations(registrations, template))


def test_registrations_that_cannot_be_read_are_named(surfaces, template):
    class Broken:
        shape = surfaces.shape

        def __getitem__(self, k):
            if k == 4:
                raise HabitusError("scan.ply: it is torn")
            return surfaces[k]

    findings = findings_of(Broken(), template)
    assert findings == [("error", "scan 4", "scan.ply: it is torn")]


def test_registrations_are_read_one_at_a_time_and_may_be_measured_in_threads(surfaces, template):
    from concurrent.futures import ThreadPoolExecutor

    class Counting:
        shape, read = surfaces.shape, []

        def __getitem__(self, k):
            assert np.ndim(k) == 0
            self.read.append(int(k))
            return surfaces[k]

    registrations = registrations_of(
        Counting(), template, sex=swapped(["female"] * len(surfaces), k3="male")
    )
    with ThreadPoolExecutor(2) as pool:
        threaded = check_registrations(registrations, template, over=pool.map)
    assert sorted(Counting.read) == list(range(len(surfaces)))
    assert threaded == check_registrations(registrations, template)


def test_refusal_names_the_first_few_and_counts_the_rest(surfaces, template):
    findings = check_registrations(registrations_of(1000 * surfaces[:8], template), template)
    with pytest.raises(HabitusError) as refused:
        refuse(findings)
    assert str(refused.value).startswith("8 errors in the registrations: scan 0: ")
    assert str(refused.value).endswith("; and 3 more") and "\n" not in str(refused.value)
    refuse([finding for finding in findings if finding.kind == "warning"])


def test_holes_are_noted_once_and_what_is_seen_is_judged(surfaces, template):
    vertices = surfaces[: 2 * POSES].copy()
    vertices[1, 100:300], vertices[8, 2000:2071] = np.nan, np.nan
    (found,) = findings_of(vertices, template)
    message = "2 registrations have holes: 1.8% of the vertices on average, most scan 1 (2.7%)"
    assert found == ("warning", "the registrations", message)
    weights = np.ones(vertices.shape[1])
    weights[:500] = 0.0
    vertices[8, 400] = 1e9  # in a hole
    assert [kind for kind, *_ in findings_of(vertices, template, weights=weights)] == ["warning"]
    vertices[8, 600:700] *= 1000
    found = findings_of(vertices, template, weights=weights)
    assert [(kind, name) for kind, name, _ in found] == [
        ("error", "scan 8"),
        ("warning", "the registrations"),
    ]
    (error, *_) = findings_of(vertices, template, weights=2 * weights)
    assert error[2] == "scan 0: its weights run from 0 to 2; expected 0 to 1"


def test_parts_that_are_scattered_over_the_mesh_are_refused_and_pieces_apart_noted(
    surfaces, template
):
    random = np.random.default_rng(0).permutation(template.part)
    (error, *_) = findings_of(surfaces[:6], replace(template, part=random))
    assert error[:2] == ("error", "the template") and "its 24 parts lie in" in error[2]
    elbow, foot = (template.joint_names.index(name) for name in ("left_elbow", "right_foot"))
    part = template.part.copy()
    part[template.part_vertices(foot)[:9]] = elbow
    found = findings_of(surfaces, replace(template, part=part))
    assert [(kind, name) for kind, name, _ in found] == [("warning", "parts of left_elbow")]
    assert "9 vertices lie among parts of joints that are far from theirs" in found[0][2]


def test_a_template_that_faces_backwards_or_whose_sides_are_exchanged_is_noted(template):
    (found,) = check_template(replace(template, vertices=template.vertices * [-1, 1, -1]))
    assert (found.kind, found.name) == (
        "warning",
        "the template",
    ) and "joints called left have smaller x" in str(found)
    assert check_template(template) == []


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], "they stand with +z up and face -y"),
        ([[1, 0, 0], [0, 0, 1], [0, -1, 0]], "they stand with -z up and face +y"),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], "they stand with +y up and face -z"),
    ],
)
def test_another_frame_than_the_templates_is_noted(template, turn, words):
    body, pose = skinned(), np.random.default_rng(2).normal(size=(6, 24, 3)) * 0.2
    surfaces = body((), pose).vertices @ np.array(turn, float).T
    found = findings_of(surfaces, template, subject=("a",) * 6)[-1]
    assert found[:2] == ("warning", "the registrations") and words in found[2]


def test_meshes_that_are_there_twice_are_noted_wherever_they_stand(surfaces, template):
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    vertices = surfaces.copy()
    vertices[9], vertices[22] = vertices[7], vertices[20] @ (turn * np.linalg.det(turn)) + 3.0
    vertices = vertices.astype(np.float32)
    (found,) = findings_of(vertices, template)
    assert found[:2] == ("warning", "the registrations")
    assert "2 meshes are there twice (scan 9 is scan 7, scan 22 is scan 20)" in found[2]


def test_many_of_a_kind_are_one_note(surfaces, template):
    subject = [f"one {k}" if k < 12 else f"person {k // POSES}" for k in range(len(surfaces))]
    (found,) = findings_of(surfaces, template, subject=tuple(subject))
    assert found[1] == "12 subjects (one 0, one 1, one 2 and 9 more)"
    body, pose = skinned(), np.random.default_rng(1).normal(size=(12, 24, 3)) * 0.4
    pose[:, 15:] *= 0.05
    (found,) = findings_of(body((), pose).vertices, template, subject=("a",) * 12)
    assert found[1].startswith("9 joints (head, ") and found[1].endswith(" and 6 more)")
    assert "bend each of these joints more than 15 degrees (0 of 12 do at the least)" in found[2]


def test_no_registrations_at_all_are_a_warning(surfaces, template):
    assert [(kind, name) for kind, name, _ in findings_of(surfaces[:0], template)] == [
        ("warning", "the registrations")
    ]
