"""What the base install promises works without the packages of any extra: here they cannot be
imported.
"""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BLOCKED = """
import sys

class Nothing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Nothing())
from habitus.cli.main import main
for path in sys.argv[1:]:
    main(["body", "--height", "1.7", "--out", path])
    main(["measure", path])
"""


def extras_alone() -> set[str]:
    """Modules of packages that only extras ask for."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    name = lambda line: re.match(r"[A-Za-z0-9._-]+", line)[0].lower().replace("_", "-")  # noqa: E731
    extras = {name(line) for lines in project["optional-dependencies"].values() for line in lines}
    wanted = extras - {name(line) for line in project["dependencies"]}
    owners = importlib.metadata.packages_distributions()
    return {
        module
        for module, packages in owners.items()
        if {one.lower().replace("_", "-") for one in packages} <= wanted
    }


def test_meshes_that_body_wrote_are_measured(tmp_path):
    blocked = extras_alone()
    assert {"torch", "viser"} <= blocked
    paths = [tmp_path / f"her.{ending}" for ending in ("obj", "ply")]
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED.format(modules=blocked), *paths],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert len(re.findall(r"^height_m +170\.\d cm +sole to crown", done.stdout, re.M)) == 2
