"""`habitus register`: what is refused, in one line; and a real scan as it comes."""

from pathlib import Path

import numpy as np
import pytest

from habitus.cli.main import main
from habitus.files import locked
from habitus.fit.points.scan import cleaned
from habitus.io.scans import read_scan

SCAN = Path(__file__).resolve().parents[3] / "shared" / "scans" / "demo_scan.ply"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["nothing.ply"], "nothing.ply"),
        (["a.txt"], "expected a scan"),
        (["nothing.ply", "--separate", "--sequence"], "expected one"),
        (["a.xyz", "--texture"], "expected two"),
        (["a.xyz", "b.xyz", "--texture"], "no colours"),
        (["a.xyz", "b.xyz", "--texture", "--separate"], "expected one"),
        (["a.xyz", "b.xyz", "--coregister", "--separate"], "expected one"),
        (["a.xyz", "a.xyz", "--coregister"], "several people are called a"),
        (["a.xyz", "--coregister"], "expected two people or more"),
    ],
)
def test_bad_input_gives_one_line_and_code_2(tmp_path, capsys, monkeypatch, given, said):
    monkeypatch.chdir(tmp_path)
    for name in ("a.xyz", "b.xyz"):
        (tmp_path / name).write_text("0 0 0\n1 1 1\n0 1 0\n")
    with pytest.raises(SystemExit) as found:
        main(["register", *given, "--out", "out"])
    error = capsys.readouterr().err
    assert found.value.code == 2 and said in error and error.count("\n") == 1
    assert not Path("out").exists()


def test_a_folder_in_which_another_run_works_is_refused(tmp_path, capsys):
    scan = tmp_path / "scan.xyz"
    scan.write_text("0 0 0\n1 1 1\n0 1 0\n")
    with locked(tmp_path / "out"), pytest.raises(SystemExit) as end:
        main(["register", str(scan), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert end.value.code == 2 and "out" in error and "points" not in error


@pytest.mark.skipif(not SCAN.exists(), reason="the scan lies beside a checkout, in ../shared")
def test_a_real_scan_is_ready_as_it_comes():
    one = cleaned(read_scan(SCAN))
    assert one.scale == 1.0 and one.floor_up is None and one.kept.mean() > 0.99
    out = one.cloud.points - one.cloud.points.mean(0)
    assert ((out * one.cloud.normals).sum(1) > 0).mean() > 0.6
    assert np.ptp(one.cloud.points[:, 1]) == pytest.approx(1.82, abs=0.02)
