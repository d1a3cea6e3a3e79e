"""How far does one call walk through the source? Files, functions and crossings of five jobs, and the
size of the source.

    python benchmarks/walks.py [--walks mosh forward ...] [--capture 85_02.c3d] [--scan demo_scan.ply]
        [--json walks.json]

A file counts where one of its functions runs (what runs during an import or a compilation does
not); a crossing is the first call of a function from a function of another file. Compiled kernels
and other threads do not count. Each walk runs in a process of its own. Walks:

    mosh       a capture to its files and report, as `habitus mosh`
    register   a scan to its files and report, as `habitus register`
    rgbd       two rendered depth views of a person to files and report, as `habitus rgbd`
    forward    shape and pose to a surface
    gradient   the derivative of an image of a cube by its vertices

`mosh` and `register` need real data: where the files are missing they are left out.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import CodeType, FrameType

import numpy as np
from common import CAPTURES, ROOT, parser, run, show_table
from numba.core import event

GOALS = {"mosh": 100, "register": 70, "rgbd": 80, "forward": 8, "gradient": 15}
"""Files: those of the project's plan."""
SOURCE = ROOT / "src" / "habitus"
LISTENER = str(SOURCE / "kernels" / "jit.py")
"""Compiles kernels and reads them from their cache, which does not count."""
SCANS = ROOT.parent / "shared" / "scans"


class Walk(event.Listener):
    """Counts functions of the source that run, and first calls between its files; not while a
    module is imported or numba compiles a kernel.

    A tracer (`sys.settrace`): unlike a profiler it is not called for built-in functions, and it
    declines the lines of every frame, so a call seen before costs one look into a set.
    """

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.functions: set[tuple[str, str, int]] = set()
        self.crossings: set[tuple[str, tuple[str, str, int]]] = set()
        self._paused = 0
        self._foreign: set[CodeType] = set()
        self._calls: set[tuple[CodeType, CodeType | None]] = set()

    def on_start(self, event: event.Event) -> None:
        """A compilation begins."""
        self._paused += 1

    def on_end(self, event: event.Event) -> None:
        """It is done."""
        self._paused -= 1

    def __call__(self, frame: FrameType, event: str, _: object) -> Callable | None:
        """The tracer's callback at a call."""
        code = frame.f_code
        if code in self._foreign:
            return None
        if code.co_filename == LISTENER:
            return None
        if code.co_name == "<module>":
            self._paused += 1
            frame.f_trace_lines = False
            return self._module_end
        if not code.co_filename.startswith(str(SOURCE)):
            self._foreign.add(code)
            return None
        call = (code, frame.f_back.f_code if frame.f_back else None)
        if self._paused or call in self._calls:
            return None
        self._calls.add(call)
        function = (code.co_filename, code.co_qualname, code.co_firstlineno)
        self.files.add(code.co_filename)
        self.functions.add(function)
        caller = _caller(frame)
        if caller is not None and caller != code.co_filename:
            self.crossings.add((caller, function))
        return None

    def _module_end(self, _: FrameType, event: str, __: object) -> Callable:
        """The tracer of a module's frame, whose lines are off."""
        if event == "return":
            self._paused -= 1
        return self._module_end

    def numbers(self) -> dict[str, object]:
        """What was counted."""
        lines = sum(len(Path(name).read_text("utf-8").splitlines()) for name in self.files)
        return {
            "files": len(self.files),
            "lines": lines,
            "functions": len(self.functions),
            "crossings": len(self.crossings),
            "names": sorted(str(Path(name).relative_to(SOURCE)) for name in self.files),
        }


def _caller(frame: FrameType) -> str | None:
    """The file of the source that the call comes from, past frames of other packages."""
    above = frame.f_back
    while above is not None and not above.f_code.co_filename.startswith(str(SOURCE)):
        above = above.f_back
    return None if above is None else above.f_code.co_filename


def mosh(capture: Path, folder: Path) -> Callable[[], object]:
    """`habitus mosh` of one capture."""
    return _command("mosh", str(capture), "--out", str(folder / "mosh"))


def register(scan: Path, folder: Path) -> Callable[[], object]:
    """`habitus register` of one scan."""
    return _command("register", str(scan), "--out", str(folder / "register"))


def rgbd(_: Path, folder: Path) -> Callable[[], object]:
    """The work of `habitus rgbd` on two rendered views of a small body."""
    sys.path.insert(0, str(ROOT / "tests" / "helpers"))
    from rgbd_scene_small import small_scene

    import habitus
    from habitus.io.rgbd.write import write_views

    body, scene = small_scene()
    write_views(scene.capture, folder / "views")
    return lambda: habitus.fit_rgbd(habitus.read_views(folder / "views"), body).save(folder / "out")


def forward(_: Path, __: Path) -> Callable[[], object]:
    """A body's surface from NumPy arrays."""
    from habitus.io.models.bodies import load_body

    body = load_body("default")
    pose = np.zeros((body.num_joints, 3))
    return lambda: body(np.zeros(body.num_betas), pose)


def gradient(_: Path, __: Path) -> Callable[[], object]:
    """The derivative of the sum of an image's pixels by the vertices of a cube."""
    import torch

    from habitus.mesh.shapes import cube
    from habitus.observe.camera import Camera
    from habitus.render.draw import draw

    shape = cube()
    points = (shape.vertices.double() + torch.tensor([0.0, 0.0, 4.0])).requires_grad_()
    camera = Camera.of(64, 48)
    colours = torch.ones(len(points), 3, dtype=torch.float64)
    return lambda: draw(camera, points, shape.faces).image(colours).sum().backward()


def _command(*arguments: str) -> Callable[[], object]:
    from habitus.cli.main import main

    return lambda: main(list(arguments))


WALKS = {each.__name__: each for each in (mosh, register, rgbd, forward, gradient)}


def count(name: str, data: Path) -> dict[str, object]:
    """The walk in this process."""
    with tempfile.TemporaryDirectory() as folder:
        work = WALKS[name](data, Path(folder))
        walk = Walk()
        with event.install_listener("numba:compile", walk):
            sys.settrace(walk)
            try:
                work()
            finally:
                sys.settrace(None)
    return walk.numbers()


def counted_elsewhere(name: str, data: Path) -> dict[str, object]:
    """The same in a fresh process, where nothing is imported or cached yet."""
    command = [sys.executable, __file__, "--child", name, str(data)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"walk {name} failed:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def size_of_source() -> dict[str, int]:
    """Files and lines of the package."""
    files = [path for path in SOURCE.rglob("*.py") if path.stat().st_size]
    lines = sum(len(path.read_text("utf-8").splitlines()) for path in files)
    return {"files": len(files), "lines": lines}


def measure(options: object) -> dict[str, object]:
    """All walks asked for, and the size of the source."""
    data = {"mosh": options.capture, "register": options.scan}
    walks = {}
    for name in options.walks:
        path = data.get(name, ROOT)
        if not path.exists():
            print(f"{name}: {path.name} is missing; left out")
            continue
        walks[name] = counted_elsewhere(name, path)
        print(f"{name}: {walks[name]['files']} files", flush=True)
    return {"goals": GOALS, "walks": walks, "source": size_of_source()}


def show(found: dict) -> None:
    """Print the table."""
    keys = ("files", "lines", "functions", "crossings")
    rows = [
        {"walk": name, **{key: walk[key] for key in keys}, "goal, files": GOALS[name]}
        for name, walk in found["walks"].items()
    ]
    show_table("walks through the source", rows)
    source = found["source"]
    print(f"src/habitus: {source['files']} files, {source['lines']:,} lines")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(count(sys.argv[2], Path(sys.argv[3]))))
    else:
        arguments = parser(__doc__)
        arguments.add_argument("--walks", nargs="+", choices=WALKS, default=list(WALKS))
        arguments.add_argument("--capture", type=Path, default=CAPTURES / "85_02.c3d")
        arguments.add_argument("--scan", type=Path, default=SCANS / "demo_scan.ply")
        arguments.add_argument("--json", type=Path, default=Path("walks.json"), dest="out")
        run(arguments, measure, show)
