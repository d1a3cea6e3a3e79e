"""The page "Your own term" says what works: its code runs, and lifts feet out of the floor."""

import re
from pathlib import Path

import numpy as np
import pytest
from planted import fit, plant, settings

import habitus as hb
from habitus.jobs.results import MarkerResult

PAGE = Path(__file__).resolve().parents[1] / "docs" / "your-own-term.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A fitted walk whose markers are two centimetres too low: the feet sink into the floor at
    height 0.
    """
    planted = plant(frames=20)
    soles = np.asarray(planted.body(planted.betas, planted.pose, planted.trans).vertices)[
        ..., 1
    ].min()
    found = fit(
        planted, planted.observed - [0.0, soles + 0.02, 0.0], settings(annealing=(10.0, 1.0))
    )
    folder = tmp_path_factory.mktemp("walk")
    MarkerResult.of(found).save(folder / "results" / "walk")
    return folder


def test_the_code_of_the_page_lifts_the_feet(folder, monkeypatch, capsys):
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert code
    monkeypatch.chdir(folder)
    names: dict = {}
    monkeypatch.setattr(hb, "load_fit", lambda path: loaded(path))
    exec(compile(code.group(1), str(PAGE), "exec"), names)
    before = names["fit"].state(names["frames"])
    after = names["found"].values
    sunk = [
        -names["floor"](s["pose"], s["trans"], s["soft_tissue"]).min()
        for s in (vars(before), after)
    ]
    assert sunk[0] > 0.005 and sunk[1] < 0.2 * sunk[0]
    assert set(names["found"].costs) >= {"data", "pose", "acceleration", "soft_tissue", "floor"}
    assert "floor" in capsys.readouterr().out


def test_the_page_puts_a_term_among_sensors(folder, monkeypatch, capsys):
    """The second piece of code goes on from the first: wrists come to be 30 cm apart."""
    pieces = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    found = loaded(folder / "results" / "walk" / "body.npz")
    names: dict = {"hb": hb, "np": np, "fit": found, "layout": plant(frames=20).layout}
    exec(compile(pieces[1], str(PAGE), "exec"), names)
    assert "wrists" in capsys.readouterr().out

    def apart(fit):
        joints = [fit.joints(k)[names["joints"]] for k in (0, 1)]
        return np.array([np.linalg.norm(left - right) for left, right in joints])

    before = [found.joints(k)[names["joints"]] for k in (0, 10)]
    before = np.array([np.linalg.norm(left - right) for left, right in before])
    assert (np.abs(apart(names["both"]) - 0.30) < 0.3 * np.abs(before - 0.30)).all()


def loaded(path):
    from planted import person

    from habitus.jobs.results import load_fit

    return load_fit(path, body=person())
