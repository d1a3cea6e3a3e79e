"""The public face: what ``import habitus`` offers, that it costs nothing, and that its words
agree.
"""

import ast
import importlib
import inspect
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic_fit import synthetic_fit

import habitus
from habitus.errors import HabitusError
from habitus.fit.markers.suspects import Suspect

LISTED = set(
    "BodyModel Camera Depth Fit FitSettings HabitusError Keypoints Markers Mosh MoshWeights Scan Term Trainer __version__ archive body_from_measurements compare draw "
    "evaluate exaggerate "
    "export_file fill_capture fit_cameras fit_rgbd gait hand_pose label live load_body load_fit load_layout load_motion "
    "minimize mosh "
    "open_registrations read_calibration read_capture read_detections read_views register_scans register_vertices retarget retarget_to_character retarget_to_robot select_markers "
    "save_body select_poses "
    "simulate_soft_tissue split_people terms train train_dynamics virtual_markers write_surface write_trc".split()
)


def test_dir_shows_the_public_face_and_nothing_else():
    assert set(dir(habitus)) == LISTED == set(habitus.__all__)


@pytest.mark.parametrize("name", sorted(LISTED))
def test_every_name_is_there_and_tells_what_it_is(name):
    if (
        name == "Trainer"
        and "class Trainer" not in (Path(habitus.__file__).parent / "jobs/train.py").read_text()
    ):
        pytest.skip("jobs/train.py has no Trainer yet")
    found = getattr(habitus, name)
    assert name == "__version__" or (inspect.getdoc(found) or "").strip()


def test_the_stub_names_what_the_module_loads():
    stub = ast.parse(Path(habitus.__file__).with_suffix(".pyi").read_text())
    told = {
        name.asname: node.module
        for node in ast.walk(stub)
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    modules = {
        name: f"{where}.{name}" if name == "terms" else where for name, where in told.items()
    }
    assert modules == habitus._MODULES | {"HabitusError": "habitus.errors"}
    assert (Path(habitus.__file__).parent / "py.typed").exists()


def test_the_type_checker_reads_every_name():
    """`make types` holds it to what the names promise."""
    read = ast.walk(ast.parse((Path(__file__).parent / "typed_public_face.py").read_text()))
    used = {
        node.attr
        for node in read
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "hb"
    }
    assert used >= LISTED, LISTED - used


@pytest.mark.parametrize(
    "first", ["habitus.evaluate.result", "habitus.jobs.evaluate", "habitus.jobs.train"]
)
def test_a_package_of_the_same_name_does_not_hide_a_function(first):
    code = (
        f"import {first}, habitus; print(habitus.evaluate.__name__, "
        "callable(habitus.evaluate), habitus.train)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.startswith("evaluate True <function train"), done.stderr


def test_import_takes_no_time():
    code = (
        "import time, sys; t = time.process_time(); import habitus; print(time.process_time() - t)"
    )
    taken = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout)
        for _ in range(5)
    ]
    assert min(taken) < 0.02


def test_a_misspelt_name_is_answered_with_the_right_one():
    with pytest.raises(AttributeError, match="did you mean 'load_body'"):
        habitus.load_bod  # noqa: B018
    with pytest.raises(AttributeError, match="read_capture"):
        habitus.zzz  # noqa: B018
    assert not hasattr(habitus, "__wrapped__")


def test_the_verbs_agree_in_their_words():
    verbs = {
        verb: inspect.signature(getattr(habitus, verb)).parameters
        for verb in ("mosh", "train", "evaluate")
    }
    shared = {"progress", "workers", "sex", "seed", "out"}
    for one in verbs.values():
        for other in verbs.values():
            for word in shared & set(one) & set(other):
                assert _kind(one[word].annotation) == _kind(other[word].annotation), word
    assert {"progress", "workers", "out"} <= set(verbs["mosh"]) and {
        "progress",
        "workers",
        "out",
    } <= set(verbs["evaluate"])


def _kind(annotation: object) -> str:
    """The last kind that a parameter takes: one verb may take looser ones beside it (a number of
    threads, say); names to choose from are a text.
    """
    text = inspect.formatannotation(annotation)
    if "Literal" in text:
        return "str"
    return [part for part in text.split(" | ") if part != "None"][-1]


COMMANDS = {
    "mosh": "mosh",
    "archive": "archive",
    "live": "live",
    "label": "label",
    "register": "register_scans",
    "select_markers": "select_markers",
    "select_poses": "select_poses",
    "train": "train",
    "train_dynamics": "train_dynamics",
    "evaluate": "evaluate",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_of_the_command_is_one_in_python(command):
    fields = importlib.import_module(f"habitus.cli.{command}").OPTIONS.__dataclass_fields__
    only_there = {"quiet", "strict", "cluster", "view", "port", "send", "known", "paths"}
    words = set(inspect.signature(getattr(habitus, COMMANDS[command])).parameters)
    if command == "register":  # with a topology it is another function
        words |= set(inspect.signature(habitus.register_vertices).parameters)
    assert set(fields) - only_there <= words


def test_weights_reach_the_stages_they_are_named_for():
    settings = habitus.Mosh(
        weights=habitus.MoshWeights(surface=50, acceleration=3, shape_pose=2, data=1)
    ).recipe_settings
    assert (settings.shape.surface, settings.shape.pose, settings.shape.data) == (50, 2, 1)
    assert (settings.pose.acceleration, settings.pose.pose, settings.pose.data) == (3, 1, 1)
    assert habitus.Mosh().recipe_settings == type(settings)()


@pytest.mark.parametrize("value", [-1, float("nan"), "much", None])
def test_weights_that_make_no_sense(value):
    with pytest.raises(HabitusError, match="surface"):
        habitus.MoshWeights(surface=value)


def test_what_needs_torch_says_so_where_it_is_not_installed():
    """All else of the public face is there without it."""
    code = """
        import habitus
        for name in habitus.__all__:
            try:
                getattr(habitus, name)
            except habitus.HabitusError as error:
                print(name, error, sep=": ")
        """
    told = dict(line.split(": ", 1) for line in _without_torch(code).stdout.splitlines())
    images = "Camera draw fit_rgbd read_views split_people".split()
    images = {told.pop(name) for name in images}
    assert all(
        "needs PyTorch, which is not installed" in line and "habitus[torch]" in line
        for line in images
    )
    assert set(told) == {"Trainer", "evaluate", "train", "train_dynamics"}
    assert all(
        "need torch, which is not installed" in line and "habitus[train]" in line
        for line in told.values()
    )


def test_depth_views_need_torch_when_they_are_read():
    said = _without_torch("import habitus; habitus.Depth('views').read()").stderr.splitlines()[-1]
    assert "HabitusError: habitus.Depth needs PyTorch" in said and "habitus[torch]" in said


def test_a_module_that_needs_torch_says_so_for_who_asked():
    code = """
        from habitus.errors import TorchIsAnExtra
        with TorchIsAnExtra("drawing"):
            import habitus.render.draw
        """
    said = _without_torch(code).stderr.splitlines()[-1]
    assert "HabitusError: drawing needs PyTorch" in said and "habitus[torch]" in said


@pytest.mark.parametrize(
    "words", [["train", "x", "--out", "y"], ["evaluate", "x", "y", "--out", "z"]]
)
def test_a_command_that_needs_torch_says_so_in_one_line(words):
    done = _without_torch(f"from habitus.cli.main import main; main({words})")
    assert done.returncode == 2 and done.stderr.startswith(
        "habitus: training body models and evaluating them need"
    )
    assert "habitus[train]" in done.stderr and done.stderr.count("\n") == 1


def _without_torch(code: str) -> subprocess.CompletedProcess[str]:
    """What code does and says where torch cannot be imported."""
    blocked = "import sys\nsys.modules['torch'] = None\n" + textwrap.dedent(code)
    return subprocess.run([sys.executable, "-c", blocked], capture_output=True, text=True)


# -- a result can be used --------------------------------------------------------------------------


@pytest.mark.parametrize("soft", [True, False])
def test_a_fit_is_read_back(soft, tmp_path):
    told = (Suspect("M02", "fell", 4), Suspect("M03", "put back", 7, corrected=True))
    fit = synthetic_fit(frames=30, soft=soft, suspects=told)
    fit.save(tmp_path / "walk")
    assert {path.name for path in (tmp_path / "walk").iterdir()} == {
        "body.npz",
        "body.glb",
        "metrics.json",
        "report.html",
    }
    again = habitus.load_fit(tmp_path / "walk" / "body.npz", fit.body)
    np.testing.assert_allclose(again.vertices(), fit.vertices(), atol=1e-5)
    np.testing.assert_allclose(again.errors_mm, fit.errors_mm, atol=1e-3)
    for name in (
        "labels",
        "suspects",
        "warnings",
        "status",
        "rate_hz",
        "up_axis",
        "seed",
        "layout_name",
        "capture_name",
    ):
        assert getattr(again, name) == getattr(fit, name), name
    for ours, theirs in zip(again.pose_stage, fit.pose_stage, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    again.save(tmp_path / "again")


def test_fits_that_cannot_be_read(tmp_path):
    with pytest.raises(HabitusError, match="no such file"):
        habitus.load_fit(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(HabitusError, match=r"text\.npz.*expected"):
        habitus.load_fit(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", poses=np.zeros((2, 72)))
    with pytest.raises(HabitusError, match=r"other\.npz.*trans"):
        habitus.load_fit(tmp_path / "other.npz")
    fit = synthetic_fit(frames=5)
    fit.export(tmp_path / "fit.npz")
    with pytest.raises(HabitusError, match=r"tubes.*body="):
        habitus.load_fit(tmp_path / "fit.npz")
    with pytest.raises(HabitusError, match="joints"):
        habitus.load_fit(tmp_path / "fit.npz", "default")


def test_export_goes_by_the_ending(tmp_path):
    fit = synthetic_fit(frames=4)
    for name in ("walk.npz", "walk.GLB", "meshes"):
        fit.export(tmp_path / name)
    assert {path.name for path in tmp_path.iterdir()} == {"walk.npz", "walk.GLB", "meshes"}
    assert len(list((tmp_path / "meshes").iterdir())) == 4
    with pytest.raises(HabitusError, match=r"walk\.max: expected \.npz .*\.glb"):
        fit.export(tmp_path / "walk.max")


@pytest.mark.parametrize("ending", [".ply", ".obj"])
def test_a_surface_is_written_and_read_back(ending, tmp_path):
    from habitus.io.meshes import read_mesh

    surface = _surface()
    habitus.write_surface(surface, tmp_path / f"posed{ending}")
    vertices, faces = read_mesh(tmp_path / f"posed{ending}")
    np.testing.assert_allclose(vertices, surface.vertices, atol=1e-6)
    np.testing.assert_array_equal(faces, surface.faces)


def test_a_surface_as_glb(tmp_path):
    surface = _surface()
    habitus.write_surface(surface, tmp_path / "posed.glb")
    content = (tmp_path / "posed.glb").read_bytes()
    assert content[:4] == b"glTF" and surface.vertices.astype("<f4").tobytes() in content


def test_surfaces_that_cannot_be_written(tmp_path):
    surface = _surface()
    with pytest.raises(HabitusError, match=r"posed\.stl: expected a name in \.ply, \.obj, \.glb"):
        habitus.write_surface(surface, tmp_path / "posed.stl")
    several = SimpleNamespace(vertices=np.zeros((2, 4, 3)), faces=surface.faces[:0])
    with pytest.raises(HabitusError, match="one surface"):
        habitus.write_surface(several, tmp_path / "posed.ply")
    with pytest.raises(HabitusError, match=r"faces=body\.faces"):
        habitus.write_surface(SimpleNamespace(vertices=surface.vertices), tmp_path / "posed.ply")
    with pytest.raises(HabitusError, match="all its vertices"):
        habitus.write_surface(
            SimpleNamespace(vertices=surface.vertices[:3], faces=surface.faces), tmp_path / "p.ply"
        )
    assert list(tmp_path.iterdir()) == []


def _surface() -> SimpleNamespace:
    fit = synthetic_fit(frames=1)
    return SimpleNamespace(vertices=fit.vertices(0), faces=np.asarray(fit.body.faces))
