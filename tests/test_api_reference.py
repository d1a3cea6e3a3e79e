"""The reference is built from the docstrings without a warning, and holds the whole public face."""

import importlib.util
import inspect
from pathlib import Path

import pytest

import habitus

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    if "class Trainer" not in (ROOT / "src/habitus/jobs/train.py").read_text():
        pytest.skip("jobs/train.py has no Trainer yet")
    spec = importlib.util.spec_from_file_location("build_reference", ROOT / "tools" / "build_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.build(tmp_path_factory.mktemp("reference"))


def test_the_reference_holds_the_public_face(pages):
    (text,) = (page.read_text() for page in pages if page.name == "habitus.html")
    missing = [name for name in habitus.__all__ if name != "terms" and f'id="{name}"' not in text]
    assert not missing
    assert any(page.parts[-2:] == ("residuals", "terms.html") for page in pages)


def test_public_methods_are_told():
    from habitus.fit.mosh.live import LiveFit
    from habitus.fit.mosh.result import MarkerFit

    for kind in (habitus.Mosh, habitus.MoshWeights, MarkerFit, LiveFit):
        members = {name: member for name, member in vars(kind).items() if not name.startswith("_")}
        untold = [name for name, one in members.items() if callable(one) and not inspect.getdoc(one)]
        assert not untold
