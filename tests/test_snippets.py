"""Every command and every piece of Python in the pages: the command line's own parser takes the
commands, modules, names and arguments exist, and what needs neither minutes nor other files runs
here. For the rest `COMMANDS_NOT_RUN` and `PYTHON_NOT_RUN` say why, and which test runs it.
"""

import builtins
import importlib
import json
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import tomllib
import typing
from collections.abc import Iterator
from functools import cache
from inspect import cleandoc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_character import write_character
from made_fbx_character import write_fbx_character
from snippets import PAGES, ROOT, Snippet, commands, inline, snippets

import habitus as hb
from habitus.body.prior import prior_of
from habitus.cli.main import COMMANDS, _parsed, main
from habitus.fit.markers.settings import MoshSettings
from habitus.io.captures.c3d_write import write_c3d
from habitus.io.captures.read import Capture
from habitus.io.layouts.files import load_layout
from habitus.io.models.bodies import load_body, save_body
from habitus.jobs import mosh
from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

COMMANDS_NOT_RUN = {
    r"(pip|pipx|uvx|conda) .*|python3 -m venv .*": "needs the package index",
    r"make .*|\S*python -m (pytest|ruff) .*": "the whole suite and its checks",
    r"python (tools|blender)/.*|\S*python benchmarks/.*|python -m habitus_lab.*": (
        "minutes to days, some with data that cannot be shipped"
    ),
    r"(export|srun|scancel|address=|sbatch|apptainer|kubectl|podman|OMP_NUM_THREADS=).*|dask .*"
    r"|.* --cluster .*": "needs a cluster: tests/jobs/archive/test_archive_run.py",
    r"habitus archive .*": "several fits: tests/jobs/archive/test_archive_run.py",
    r"habitus live .*": "a stream, until Ctrl-C: tests/cli/test_live_command.py",
    r"habitus view .*": "a server, until Ctrl-C: tests/jobs/test_viewing.py",
    r"habitus mosh .* --layout .*": "minutes: tests/jobs/test_discovering.py",
    r"habitus mosh .* --label auto .*|habitus label .*": "minutes: tests/jobs/test_label.py",
    r"habitus mosh .*": "a whole fit: tests/cli/test_main.py",
    r"habitus cameras .*": "a fit a command: tests/jobs/test_camera_jobs.py",
    r"habitus gait .*": "several fits: tests/jobs/test_gait.py",
    r"habitus rgbd .*": "minutes: tests/jobs/test_rgbd.py",
    r"habitus register .* --topology .*|.* --model SMPLX.*": (
        "ten seconds: tests/jobs/test_topologies_jobs.py"
    ),
    r"habitus register .*|habitus measure results/anna.*|.*--target registered/.*": (
        "a registration: tests/cli/test_register_command.py"
    ),
    r".* --target character.obj .*": "a registration: tests/jobs/test_motions.py",
    r"habitus retarget .* --robot .*": "needs a maker's robot file: tests/fit/test_robots.py",
    r"habitus train .*": "minutes: tests/cli/test_train_command.py",
    r"habitus train-dynamics .*": "minutes: tests/jobs/test_train_dynamics.py",
    r"habitus evaluate .*": "minutes: tests/cli/test_evaluate_command.py",
    r"habitus select-.*": "minutes: tests/jobs/test_selection.py",
    r"habitus compare .*": "five seconds a command: tests/cli/test_compare_command.py",
    r"habitus body .*\.glb": "seven seconds: tests/jobs/test_measurements_in_and_out.py",
    r"habitus export .* --(rig manny|bake-correctives) .*": (
        "three seconds a command: tests/export/test_rigs.py, tests/export/test_correctives.py"
    ),
    r"habitus export results/body.npz .*": "runs in docs/exporting.md",
    r".* --skin .*": "paints two megapixels: tests/export/test_skins.py",
    r".* --picture .*": "draws four pictures: tests/cli/test_measure_commands.py",
    r".* --layout my.json .*": "a file of yours: tests/jobs/test_virtual_markers.py",
}
"""Commands, as regular expressions of the whole line: what they need, and the test that runs the
subcommand. The first that matches counts.
"""

PYTHON_NOT_RUN = {
    "README.md:import habitus as hb": "a longer capture, pixels: tests/test_house.py",
    "docs/your-own-term.md:": "needs a walk into the floor: tests/test_your_own_term.py",
    "docs/adding-a-body-model.md:from habitus.io.models.bodies import load_body": (
        "files under licence: tests/io/models/test_bodies.py"
    ),
    "docs/amass.md:fit.save": "writes over the fit: tests/export/test_amass.py",
    "docs/amass.md:hb.save_body": "needs smplx: tests/export/test_amass.py",
    "docs/amass.md:trans = data": "needs another program's joints: tests/export/test_amass.py",
    "docs/archives.md:capture,subject": "a table",
    "docs/cameras.md:detections =": "fits: tests/jobs/test_camera_jobs.py",
    "docs/cameras.md:import json": "sends for ever: tests/jobs/test_live_detections.py",
    "docs/comparing.md:": "five seconds: tests/cli/test_compare_command.py",
    "docs/evaluating.md:": "minutes: tests/cli/test_evaluate_command.py",
    "docs/exaggerating-and-retargeting.md:found =": "a registration: tests/jobs/test_motions.py",
    "docs/exporting.md:fit.export": "as its command, which runs",
    "docs/in-your-program.md:import habitus_maya": "in Maya: tests/programs/test_maya.py",
    "docs/in-your-program.md:import habitus_unreal": "in Unreal: tests/programs/test_unreal.py",
    "docs/in-your-program.md:habitus_unreal.": "in Unreal: tests/programs/test_unreal.py",
    "docs/live.md:fit =": "a stream: tests/jobs/test_live.py",
    "docs/live.md:from habitus.io.streams": "a stream, for ever: tests/io/streams/test_faces.py",
    "docs/other-bodies.md:": "twenty seconds: tests/jobs/test_topologies_jobs.py",
    "docs/results.md:bpy.": "in Blender: tests/export/test_blender.py",
    "docs/rgbd.md:": "minutes: tests/jobs/test_rgbd.py",
    "docs/robots.md:": "needs a maker's robot file: tests/fit/test_robots.py",
    "docs/selecting-markers.md:": "minutes: tests/jobs/test_selection.py",
    "docs/several-sensors.md:": "minutes: tests/jobs/test_sensors.py",
    "docs/training.md:": "minutes: tests/jobs/test_train.py",
}
"""Page and beginning of snippets, likewise."""

THIRD_PARTY = ("apptainer ", "gh ", "helm ", "pip ", "podman ")
"""Commands of other programs, with options of their own."""


def examples() -> list[tuple[str, str]]:
    """Place and text of each shell command of the pages and of the examples in --help."""
    found = [
        (f"{snippet.page}:{line}", text)
        for snippet in snippets()
        if snippet.kind == "shell"
        for line, text in commands(snippet)
    ]
    for name in COMMANDS:
        for paragraph in re.split(r"\n\s*\n", cleandoc(_module(name).ABOUT)):
            line = " ".join(paragraph.split("      (")[0].split())
            if line.startswith("habitus "):
                found.append((f"habitus {name} --help", line))
    return found


def _module(name: str) -> Any:
    return importlib.import_module(f"habitus.cli.{name.replace('-', '_')}")


COMMAND_LINES = examples()
_BEFORE = re.compile(r"(uvx (--from \S+ )?|apptainer exec .*\.sif )(?=habitus )")
"""What may stand before a command of ours."""
OURS = [
    (place, bare)
    for place, text in COMMAND_LINES
    if (bare := _BEFORE.sub("", text, count=1)).startswith("habitus ")
]
PYTHON = [snippet for snippet in snippets() if snippet.kind == "python"]


def why_not(table: dict[str, str], key: str, exact: bool) -> str | None:
    """The reason of the first entry for it, or None where it is to run."""
    return next(
        (
            reason
            for start, reason in table.items()
            if (re.fullmatch(start, key) if exact else key.startswith(start))
        ),
        None,
    )


def key_of(snippet: Snippet) -> str:
    return f"{snippet.page}:{snippet.text.lstrip()}"


def words_of(text: str) -> list[str]:
    """A command's words, as a shell gives them; … and [optional ones] are left out."""
    return [word for word in shlex.split(re.sub(r"\[[^]]*\]|…|\.\.\.", "", text)) if word]


@pytest.mark.parametrize(("place", "text"), OURS, ids=[place for place, _ in OURS])
def test_the_parser_takes_the_command(place, text, capsys):
    name, *arguments = words_of(text)[1:]
    assert name in COMMANDS, f"{place}: {text}"
    try:
        _parsed(name, arguments)
    except SystemExit:
        pytest.fail(f"{place}: {text}\n{capsys.readouterr().err}")


@pytest.mark.parametrize(
    "wrong",
    ["mosh walk.c3d", "mosh walk.c3d --out o --nothing", "body --sex woman", "label --out x"],
)
def test_the_parser_takes_not_every_command(wrong):
    name, *arguments = wrong.split()
    with pytest.raises((SystemExit, hb.HabitusError)):
        _parsed(name, arguments)


@cache
def options_of(name: str) -> frozenset[str]:
    """What `habitus NAME --help` shows, of its subcommands, too."""
    module = _module(name)
    kinds = typing.get_args(module.OPTIONS) or (module.OPTIONS,)
    kinds = [(typing.get_args(kind) or (kind,))[0] for kind in kinds]
    return frozenset(option for kind in kinds for option in _flags(kind)) | {"help"}


def _flags(kind: Any, prefix: str = "") -> Iterator[str]:
    """Options of a dataclass, nested ones as parent.child."""
    for name, field in getattr(kind, "__dataclass_fields__", {}).items():
        option = prefix + name.replace("_", "-")
        renamed = [
            given.name
            for given in getattr(field.type, "__metadata__", ())
            if hasattr(given, "name")
        ]
        yield from (option, f"{prefix}no-{name.replace('_', '-')}", *filter(None, renamed))
        yield from _flags(field.type, f"{option}.")


@cache
def other_options() -> frozenset[str]:
    """Options of the project's own scripts."""
    folders = ("tools", "benchmarks", "examples", "blender", "lab/src", "tests/fuzz")
    texts = (
        path.read_text("utf-8") for folder in folders for path in (ROOT / folder).rglob("*.py")
    )
    return frozenset(name for text in texts for name in re.findall(r'"--([a-z][\w-]*)"', text))


def test_options_that_sentences_name_exist():
    wrong = []
    every = frozenset.union(*map(options_of, COMMANDS), other_options())
    for page, line, text in inline():
        if page == "CHANGELOG.md":
            continue  # it also has older names
        if text.startswith(THIRD_PARTY):
            continue
        command = re.match(r"habitus ([a-z][a-z-]+)(?=\s|$)", text)
        if command and command[1] not in COMMANDS:
            wrong.append(f"{page}:{line}: {text}")
        known = options_of(command[1]) if command and command[1] in COMMANDS else every
        given = re.findall(r"(?<![\w-])--([a-z][\w.-]*)", text)
        wrong += [f"{page}:{line}: {text}" for name in given if name not in known | {"version"}]
    assert not wrong, "\n".join(wrong)


def test_other_commands_name_what_is_there():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    rules = (ROOT / "Makefile").read_text("utf-8")
    wrong = []
    for place, text in COMMAND_LINES:
        words = words_of(text)
        extras = re.findall(r"(?:habitus|\.)\[([\w,-]+)\]", text) if "pip install" in text else []
        there = {
            "make": lambda w: re.search(rf"^{w[1]}:", rules, re.MULTILINE),
            "python": lambda w: _script(w[1:]),
            ".venv/bin/python": lambda w: _script(w[1:]),
        }.get(words[0], lambda w: True)
        extras = {name for group in extras for name in group.split(",")}
        if not there(words) or not extras <= set(project["optional-dependencies"]):
            wrong.append(f"{place}: {text}")
    assert not wrong, "\n".join(wrong)


def _script(words: list[str]) -> bool:
    """Whether a script or module of the project is there, with these options."""
    if words[0] == "-m" and not words[1].startswith("habitus_lab"):
        return True
    path = (
        ROOT / "lab/src" / f"{words[1].replace('.', '/')}.py"
        if words[0] == "-m"
        else ROOT / words[0]
    )
    if path.name == "NAME.py":
        return True
    if not path.is_file():
        return False
    text = path.read_text("utf-8")
    options = [word[2:] for word in words if word.startswith("--")]
    return all(name in text.replace("_", "-") or name == "help" for name in options)


def test_names_and_arguments_of_python_exist(tmp_path):
    """Without running it: pyright knows what `hb` returns, its attributes and its arguments."""
    pages: dict[str, list[str]] = {}
    for snippet in PYTHON:
        if why_not(PYTHON_NOT_RUN, key_of(snippet), False) != "a table":
            lines = pages.setdefault(snippet.page, GIVEN.splitlines())
            lines += [f"# {snippet}", *textwrap.dedent(snippet.text).splitlines()]
    for page, lines in pages.items():
        name = page.replace("/", "_").removesuffix(".md")
        (tmp_path / f"{name}.py").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (tmp_path / "wrong.py").write_text(f"{GIVEN}hb.export_file(fit, 'a', wrong=1)\nfit.height\n")
    found = _type_errors(tmp_path)
    wrong = [line for line in found if line.startswith("wrong.py")]
    assert len(wrong) == 2 and found == wrong, "\n".join(found)


GIVEN = """import numpy as np
import habitus as hb
from habitus import load_body
fit, body = hb.load_fit("fit"), load_body("default")
capture, betas, layout = hb.read_capture("walk.c3d"), np.zeros(24), "auto"
pose, trans = np.zeros((5, 24, 3)), np.zeros((5, 3))
"""
"""What the pages' pieces go on from."""
YOURS = {"bpy", "detect", "floor", "r", "sensors", "smplx", "video"}
"""Names in the pages that stand for something of the reader's."""


def _type_errors(folder: Path) -> list[str]:
    """What pyright finds in a folder's files, but for what only a reader's program can know."""
    (folder / "pyrightconfig.json").write_text(
        json.dumps(
            {
                "extraPaths": [str(ROOT / "src"), str(ROOT / "programs")],
                "reportOptionalMemberAccess": False,
                "reportArgumentType": False,
                "reportMissingModuleSource": False,
            }
        )
    )
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable]
    run = subprocess.run([*command, "-p", str(folder)], capture_output=True)
    found = []
    for error in json.loads(run.stdout)["generalDiagnostics"]:
        name = re.match(r'"(\w+)" is not defined', error["message"])
        program = re.match(r'Import "(maya|unreal|bpy)', error["message"])
        if error["severity"] == "error" and not program and not (name and name[1] in YOURS):
            at = error["range"]["start"]["line"] + 1
            found.append(f"{Path(error['file']).name}:{at}: {error['message']}")
    return sorted(found)


def test_nothing_that_looks_like_code_is_left_out():
    """A piece of Python with a mistake in it would be taken for text."""
    code = re.compile(r"^(import|from|def|class|habitus) |\bhb\.", re.MULTILINE)
    assert not [str(s) for s in snippets() if s.kind == "text" and code.search(s.text)]


def test_every_reason_is_needed_and_names_a_test_that_is_there():
    lines = [text for _, text in COMMAND_LINES]
    keys = list(map(key_of, PYTHON))
    taken = [why_not({p: p for p in COMMANDS_NOT_RUN}, line, True) for line in lines]
    assert set(COMMANDS_NOT_RUN) == set(taken) - {None}
    taken = [why_not({p: p for p in PYTHON_NOT_RUN}, key, False) for key in keys]
    assert set(PYTHON_NOT_RUN) == set(taken) - {None}
    for reason in (*COMMANDS_NOT_RUN.values(), *PYTHON_NOT_RUN.values()):
        for path in re.findall(r"tests/\S+\.py", reason):
            assert (ROOT / path).is_file(), path


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Iterator[Path]:
    """A folder with what the pages' commands read: a short capture and its hasty fit, a character,
    and files that other commands of the pages write.
    """
    folder = tmp_path_factory.mktemp("pages")
    body, layout, rng = load_body("default"), load_layout("cmu-41"), np.random.default_rng(1)
    prior = prior_of(body).for_joints(body.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 12, 60.0, rng)
    places = layout.vertices(body), layout.distances()
    truth = simulate_capture(body, np.zeros(body.num_betas), pose, trans, *places, Faults(), rng)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(
            mosh,
            "MoshSettings",
            lambda **g: MoshSettings(**g | {"annealing": (10.0,), "frames": 3}),
        )
        write_c3d(Capture("walk", layout.labels, truth.observed, 60.0, "+y"), Path("walk.c3d"))
        hb.Mosh(layout="cmu-41").fit("walk.c3d").save("results/walk")
        shutil.copy("results/walk/body.npz", "results/body.npz")
        save_body(load_body("neutral"), "smplh.npz")
        write_character(Path("character.glb"), step=4)
        write_fbx_character(Path("character.fbx"), step=4)
        for line in (
            "export female --out character.vrm",
            "export results/walk/body.npz --out walk.bvh",
        ):
            main(line.split())
        yield folder


RUN = {page: [t for at, t in OURS if at.startswith(f"{page}:")] for page in PAGES}
RUN = {
    page: [text for text in dict.fromkeys(lines) if not why_not(COMMANDS_NOT_RUN, text, True)]
    for page, lines in RUN.items()
}
RUN = {page: lines for page, lines in RUN.items() if lines}


@pytest.mark.parametrize("page", RUN)
def test_the_commands_of_a_page_run(page, place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    for text in RUN[page]:
        words = words_of(text)[1:]
        try:
            main(words)
        except SystemExit as end:
            pytest.fail(f"{page}: {text}: exit code {end.code}: {capsys.readouterr().err}")
        for at, word in enumerate(words):
            if word == "--out":
                assert Path(words[at + 1]).exists(), f"{page}: {text} wrote nothing"


TO_RUN = {
    page: [
        snippet
        for snippet in PYTHON
        if snippet.page == page and not why_not(PYTHON_NOT_RUN, key_of(snippet), False)
    ]
    for page in PAGES
}
TO_RUN = {page: pieces for page, pieces in TO_RUN.items() if pieces}


@pytest.mark.parametrize("page", TO_RUN)
def test_the_python_of_a_page_runs(page, place, monkeypatch, capsys):
    """Its pieces go on from each other, and from a fit and a body where they name one."""
    monkeypatch.chdir(place)
    names = {
        "hb": hb,
        "np": np,
        "load_body": hb.load_body,
        "body": hb.load_body("default", detail="full"),
        "fit": hb.load_fit("results/walk/body.npz"),
        "betas": np.zeros(24),
        "pose": np.zeros((5, 24, 3)),
        "trans": np.zeros((5, 3)),
        "__name__": "page",
        "__builtins__": builtins,
    }
    for snippet in TO_RUN[page]:
        exec(compile(textwrap.dedent(snippet.text), str(snippet), "exec"), names)
