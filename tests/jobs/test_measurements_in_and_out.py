"""Tapes in, tapes out: a body made from a pattern program's file has its measurements."""

import numpy as np
import pytest

from habitus.cli.main import main
from habitus.export.measurements import write_measurements
from habitus.fit.from_measurements import estimate_body
from habitus.io.models.bodies import load_body
from habitus.jobs.estimates import FROM_FILE, measurements_of

ENDINGS = {"garmentcode": ".yaml", "seamly": ".smis", "freesewing": ".json"}


@pytest.fixture(scope="module")
def body():
    return load_body("female")


@pytest.fixture(scope="module")
def people(body):
    draws = np.random.default_rng(11).normal(size=(3, body.num_betas))
    return [body.measure(body.people_mean + draw) for draw in draws]


@pytest.mark.parametrize("program", ENDINGS)
def test_within_five_millimetres(body, people, program, tmp_path):
    for k, truth in enumerate(people):
        path = tmp_path / f"{k}{ENDINGS[program]}"
        write_measurements(truth, path, program)
        given, notes = measurements_of(path)
        assert not notes
        estimate = estimate_body(body, given, FROM_FILE)
        assert min(estimate.weights.values()) > 0.9
        for name in given:
            if name.endswith("_m"):
                assert abs(estimate.measurements[name] - truth[name]) < 0.005, name


def test_what_was_not_measured_is_as_uncertain_as_it_says(body, people):
    """Of few tapes, in units of the reported standard deviation."""
    names = (
        "height_m",
        "chest_circumference_m",
        "hip_circumference_m",
        "natural_waist_circumference_m",
    )
    off = []
    for truth in people:
        estimate = estimate_body(body, {name: truth[name] for name in names})
        off += [
            (estimate.measurements[n] - truth[n]) / estimate.spread[n]
            for n in truth
            if n not in names
        ]
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.5


def test_a_wrong_tape_is_set_aside_and_said(body, people):
    truth = people[0]
    given = {
        name: truth[name]
        for name in truth
        if name.endswith("circumference_m") or name in ("height_m", "inseam_m", "arm_length_m")
    }
    wrong = given | {"calf_circumference_m": 1.3 * given["calf_circumference_m"]}
    estimate = estimate_body(body, wrong, FROM_FILE)
    assert [name for name, weight in estimate.weights.items() if weight < 0.5] == [
        "calf_circumference_m"
    ]
    found = estimate.measurements["calf_circumference_m"]
    assert found == pytest.approx(truth["calf_circumference_m"], abs=0.005)
    assert estimate.spread["calf_circumference_m"] > 0.001


def test_a_file_makes_a_body_and_options_go_before_it(body, tmp_path, capsys):
    path = tmp_path / "her.smis"
    write_measurements(body.measure(), path, "seamly", "female")
    out = tmp_path / "her.npz"
    main(["body", "--from", str(path), "--height", "1.66", "--out", str(out)])
    said = capsys.readouterr().out
    assert "the file says female" in said and "166.0 cm" in said and out.exists()
