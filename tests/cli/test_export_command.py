"""`habitus export`: what is written, said and refused."""

import pytest
from read_fbx import Fbx
from synthetic_fit import synthetic_fit

from habitus.cli.main import main
from habitus.io.models.bodies import load_body


def run(*arguments: object) -> int:
    try:
        main([str(word) for word in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


@pytest.fixture(scope="module")
def npz(tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "body.npz"
    synthetic_fit(5, body=load_body("default"), body_name="default", soft=False).export(path)
    return path


def test_a_fit_becomes_an_fbx(npz, tmp_path, capsys):
    out = tmp_path / "walk.fbx"
    assert (
        run(
            "export",
            npz,
            "--out",
            out,
            "--fps",
            60,
            "--bake-correctives",
            "pca:3",
            "--detail",
            "coarse",
        )
        == 0
    )
    said = capsys.readouterr().out
    assert (
        "blend shapes; what they leave out" in said and "3 frames at 60 Hz" in said and "MB" in said
    )
    assert len(Fbx(out).vertices(2)) == load_body("default").num_vertices
    assert (
        run("export", npz, "--out", out, "--bake-correctives", "live:5", "--detail", "coarse") == 0
    )
    assert (
        "walk.correctives.json" in capsys.readouterr().out
        and (tmp_path / "walk.correctives.json").exists()
    )
    assert run("export", npz, "--out", tmp_path / "walk.trc") == 0
    assert "M03" in (tmp_path / "walk.trc").read_text()


def test_one_mesh_is_called_one_and_a_folder_of_results_is_taken(npz, tmp_path, capsys):
    assert run("export", npz.parent, "--out", tmp_path / "rest.obj", "--detail", "coarse") == 0
    said = capsys.readouterr().out
    assert "one mesh" in said and "frames" not in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--out", "walk.max"), "cannot write a motion to walk.max"),
        (("--out", "walk.fbx", "--bake-correctives", "pca"), "expected auto, all, none"),
        (("--out", "walk.fbx", "--fps", "0"), "frames a second"),
    ],
)
def test_bad_input_is_one_line(npz, arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run("export", npz, *arguments) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not list(tmp_path.iterdir())


def test_no_such_file(tmp_path, capsys):
    assert run("export", tmp_path / "nowhere.npz", "--out", tmp_path / "a.fbx") == 2
    assert "nowhere.npz: no such file" in capsys.readouterr().err
