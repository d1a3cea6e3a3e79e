"""A pytest plugin: which tests execute which lines, and only the tests that are asked for.

    PYTHONPATH=tools python -m pytest -p who_executes --record lines.json --record-of src/habitus/fit  tests/fit
    PYTHONPATH=tools python -m pytest -p who_executes --chosen tests.json  tests/fit

The record holds seconds and lines of each test and of each fixture that several tests share; a test
answers for the lines of its fixtures as for its own. Lines of compiled kernels and of other
processes are not seen.
"""

import json
import time
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """The options of both uses."""
    parser.addoption("--record", type=Path, help="file to write")
    parser.addoption(
        "--record-of",
        type=str,
        nargs="+",
        default=["src"],
        help="folders whose lines are of interest",
    )
    parser.addoption(
        "--chosen", type=Path, help="a JSON list of tests: these are run, in this order"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Begin to record before anything of interest is imported."""
    if config.getoption("--record"):
        config.pluginmanager.register(Recorder(config))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the chosen tests, in their order."""
    if config.getoption("--chosen"):
        place = {
            name: k for k, name in enumerate(json.loads(config.getoption("--chosen").read_text()))
        }
        items[:] = sorted(
            (item for item in items if item.nodeid in place), key=lambda item: place[item.nodeid]
        )


class Recorder:
    """Has coverage note lines under the name of the test or of the shared fixture that is being
    made.
    """

    def __init__(self, config: pytest.Config):
        self.root = Path(config.rootpath)
        self.out = config.getoption("--record")
        folders = [str(self.root / folder) for folder in config.getoption("--record-of")]
        self.coverage = coverage.Coverage(data_file=None, source=folders, config_file=False)
        self.coverage.start()
        self.names = [""]  # what is being made now, last: a fixture may be made inside another
        self.seconds: dict[str, float] = defaultdict(float)
        self.fixtures: dict[str, list[str]] = {}
        self.began = time.perf_counter()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """A test with its own fixtures."""
        known = getattr(item, "_fixtureinfo", None)
        definitions = (
            [each for several in known.name2fixturedefs.values() for each in several]
            if known
            else []
        )
        self.fixtures[item.nodeid] = sorted(
            {_name(each) for each in definitions if each.scope != "function"}
        )
        return (yield from self._under(item.nodeid))

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef
    ) -> Generator[None, object, object]:
        """A fixture that other tests use too has a name of its own."""
        if fixturedef.scope == "function":
            return (yield)
        return (yield from self._under(_name(fixturedef)))

    def _under(self, name: str) -> Generator[None, object, object]:
        self._turn()
        self.names.append(name)
        self.coverage.switch_context(name)
        try:
            return (yield)
        finally:
            self._turn()
            self.names.pop()
            self.coverage.switch_context(self.names[-1])

    def _turn(self) -> None:
        now = time.perf_counter()
        self.seconds[self.names[-1]] += now - self.began
        self.began = now

    def pytest_sessionfinish(self) -> None:
        """Write the record: names and their seconds, fixtures by test, places in the list of names
        by file and line.
        """
        self.coverage.stop()
        data = self.coverage.get_data()
        number = {name: k for k, name in enumerate(self.seconds)}
        lines = {
            str(Path(file).relative_to(self.root)): {
                line: [number[name] for name in names if name]
                for line, names in data.contexts_by_lineno(file).items()
            }
            for file in data.measured_files()
        }
        spent = {"names": list(self.seconds), "seconds": list(self.seconds.values())}
        self.out.write_text(json.dumps({**spent, "fixtures": self.fixtures, "lines": lines}))


def _name(fixture: pytest.FixtureDef) -> str:
    return f"fixture {fixture.argname} of {fixture.baseid}"
