"""The house: imports run one way, importing costs nothing, documents are true to what is there."""

import ast
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "benchmarks").glob("*.md"),
        *(ROOT / "lab").glob("*.md"),
    ]
)


def test_imports_run_one_way():
    run = subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout


def test_the_package_knows_nothing_of_the_lab():
    for path in (ROOT / "src").rglob("*.py"):
        assert "import habitus_lab" not in (text := path.read_text()), path
        assert "from habitus_lab" not in text, path


POSIX_MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "termios", "tty"}
POSIX_ONLY = {
    "os": {
        *("chown", "chroot", "fchmod", "fchown", "fork", "forkpty", "getegid", "geteuid", "getgid"),
        *("getgroups", "getloadavg", "getpgid", "getpriority", "getresuid", "getsid", "getuid"),
        *("killpg", "lchown", "mkfifo", "mknod", "nice", "openpty", "pipe2", "pread", "pwrite"),
        *("sched_getaffinity", "sched_setaffinity", "setpgid", "setpriority", "setsid", "statvfs"),
        *("sync", "sysconf", "uname", "wait", "wait3", "wait4", "waitid", "WNOHANG"),
        *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK"),
    },
    "signal": {"SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1", "SIGUSR2", "pause", "alarm"},
    "time": {"clock_gettime", "tzset"},
}
"""What the standard library has on POSIX systems alone."""


def posix_calls(text: str) -> list[str]:
    """Uses of `POSIX_ONLY` and imports of `POSIX_MODULES` that no ``hasattr`` in the same function
    (or at the module's top) guards.
    """
    tree = ast.parse(text)
    found = []
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    guarded = {
        id(inner)
        for part in functions
        for name in [ast.unparse(part)]
        for inner in ast.walk(part)
        if isinstance(inner, ast.Attribute) and f"hasattr(os, '{inner.attr}')" in name
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            module = getattr(node, "module", None)
            names = [module] if module else [alias.name for alias in node.names]
            found += [name for name in names if name in POSIX_MODULES]
        elif (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.attr in POSIX_ONLY.get(node.value.id, ())
            and id(node) not in guarded
        ):
            found.append(f"{node.value.id}.{node.attr}")
    return found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("import os\ndef f():\n    return len(os.sched_getaffinity(0))", ["os.sched_getaffinity"]),
        ("import os\ndef f():\n    if hasattr(os, 'nice'):\n        os.nice(5)", []),
        ("import fcntl", ["fcntl"]),
        ("import os\nos.replace('a', 'b')", []),
    ],
)
def test_posix_calls_are_found(text, expected):
    assert posix_calls(text) == expected


def test_nothing_is_of_posix_systems_alone():
    """The package runs on Windows and macOS: whatever they lack is asked for first."""
    for path in (ROOT / "src").rglob("*.py"):
        assert not posix_calls(path.read_text(encoding="utf-8")), path


def test_files_are_opened_with_an_encoding():
    """Windows' own is not UTF-8."""
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            given = {keyword.arg for keyword in node.keywords}
            least = {"read_text": 1, "write_text": 2}.get(node.func.attr)
            if least is not None and isinstance(node.func.value, ast.Name | ast.BinOp | ast.Call):
                assert "encoding" in given or len(node.args) >= least, f"{path}:{node.lineno}"


def test_style():
    run = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "."], cwd=ROOT, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stdout


def test_import_alone_loads_nothing_heavy():
    code = (
        "import sys, habitus; print(sorted({'torch', 'numba', 'ezc3d', 'numpy'} & "
        "set(sys.modules)))"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip()
        == "[]"
    )


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    names = {_normal(re.match(r"[A-Za-z0-9._-]+", line)[0]) for line in wanted}
    assert names and names <= set(_pins())


def test_what_is_installed_is_what_is_pinned():
    pins = _pins()
    off = []
    for package in _needed("habitus", {"test"}):
        if package.startswith(("nvidia-", "cuda-", "triton")):
            continue  # they belong to a torch wheel, which pins them itself
        version = importlib.metadata.version(package)
        if pins.get(package) != version.split("+")[0]:
            off.append(f"{package} {version}, pinned {pins.get(package)}")
    assert not off


def test_readme_example_runs(tmp_path, monkeypatch, capsys):
    example = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert example, "README.md has no Python example"
    monkeypatch.chdir(tmp_path)
    _write_walk(tmp_path / "walk.c3d")
    exec(compile(example.group(1), "README.md", "exec"), {})
    said = capsys.readouterr().out
    assert (
        1.4 < float(said.split()[0]) < 2.1 and "mm from the body on average" in said
    )  # how tall; how well it fits
    assert (
        len([line for line in example.group(1).splitlines() if line]) <= 13
    )  # a body in 3 lines, all else in 10
    assert {path.name for path in tmp_path.iterdir()} == {
        "walk.c3d",
        "posed.ply",
        "walk.glb",
        "results",
    }
    assert {path.name for path in (tmp_path / "results" / "walk").iterdir()} >= {
        "body.npz",
        "report.html",
    }


def test_readme_rendering_example_finds_the_position_with_the_public_face_alone(capsys):
    text = (ROOT / "README.md").read_text()
    example = re.search(r"## Rendering.*?```python\n(.*?)```", text, re.DOTALL)
    assert example and set(re.findall(r"^import (\w+)", example[1], re.MULTILINE)) == {
        "habitus",
        "torch",
    }
    assert "from habitus" not in example[1]
    names: dict = {}
    exec(compile(example[1], "README.md", "exec"), names)
    found = names["found"].values["translation"].numpy()
    assert np.allclose(found, [0.3, -0.2, 3.0], atol=1e-4), capsys.readouterr().out


def _write_walk(path: Path) -> None:
    """A synthetic capture, as long as the example asks for."""

    from habitus.body.prior import shipped_prior
    from habitus.io.captures.c3d_write import write_c3d
    from habitus.io.captures.read import Capture
    from habitus.io.layouts.files import load_layout
    from habitus.io.models.bodies import load_body
    from habitus.observe.simulated_markers import Faults, simulate_capture, smooth_motion

    body = load_body("default")
    layout = load_layout("cmu-41")
    rng = np.random.default_rng(1)
    prior = shipped_prior().for_joints(body.joint_names)
    pose, trans = smooth_motion(prior.mean, np.sqrt(np.diag(prior.covariance)), 210, 120.0, rng)
    places = layout.vertices(body), layout.distances()
    truth = simulate_capture(body, np.zeros(body.num_betas), pose, trans, *places, Faults(), rng)
    write_c3d(Capture("walk", layout.labels, truth.observed, 120.0, "+y"), path)


def test_readme_names_the_two_commands_and_the_main_subcommands():
    text = (ROOT / "README.md").read_text()
    assert all(f"make {name}" in text for name in ("demo", "test"))
    shown = set(re.findall(r"`habitus ([a-z-]+) [A-Z]", text))
    assert shown == {
        "mosh", "archive", "label", "rgbd", "cameras", "gait", "register", "measure", "export",
        "retarget", "train",
    }  # fmt: skip
    rules = (ROOT / "Makefile").read_text()
    assert all(re.search(rf"^{name}:", rules, re.MULTILINE) for name in ("demo", "test"))
    assert "make test" in (ROOT / ".ci" / "run").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in _anchors(file.read_text()), f"{page.name}: {target}"


def test_the_index_links_every_page():
    index = (ROOT / "docs" / "index.md").read_text()
    missing = [
        page.name
        for page in (ROOT / "docs").glob("*.md")
        if page.name != "index.md" and page.name not in index
    ]
    assert not missing


def test_benchmarks_are_all_told():
    told = (ROOT / "benchmarks" / "README.md").read_text()
    files = {path.name for path in (ROOT / "benchmarks").glob("*.py")} - {"common.py"}
    assert files <= set(re.findall(r"`(\w+\.py)`", told))


def test_pictures_are_small():
    large = [
        path.name
        for path in (ROOT / "docs" / "images").iterdir()
        if path.stat().st_size > 1_000_000
    ]
    assert not large


def test_files_are_short():
    long = {}
    for path in (*(ROOT / "src").rglob("*.py"), *(ROOT / "lab").rglob("*.py")):
        lines = len(path.read_text().splitlines())
        most = 500
        if lines > most:
            long[str(path.relative_to(ROOT))] = lines
    assert not long


def _pins() -> dict[str, str]:
    lines = (line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    return {_normal(name): version for name, version in lines}


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _needed(package: str, extras: set[str]) -> set[str]:
    """All that is installed because ``package`` needs it, by normal names."""
    found: set[str] = set()
    todo = [(package, extras)]
    while todo:
        name, wanted = todo.pop()
        for line in importlib.metadata.requires(name) or []:
            need = Requirement(line)
            applies = need.marker is None or any(
                need.marker.evaluate({"extra": x}) for x in {"", *wanted}
            )
            if applies and _normal(need.name) not in found:
                found.add(_normal(need.name))
                todo.append((need.name, need.extras))
    return found


def _anchors(text: str) -> set[str]:
    """GitHub's anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }
