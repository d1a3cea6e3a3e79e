"""Long captures: windows cover them, and what comes out is what one solve of all frames gives."""

from dataclasses import replace

import numpy as np
import pytest
from marker_scene import scene
from planted import person, plant, prior_of_poses

from habitus.export.npz import write_npz
from habitus.fit.markers.causal import fit_causally
from habitus.fit.markers.recipe import Recording, fit_markers
from habitus.fit.markers.sequence import fit_long, fit_sequence, windows
from habitus.fit.markers.settings import (
    WINDOWS,
    MoshSettings,
    SequenceSettings,
    WindowSettings,
)
from habitus.fit.markers.start import start_long, start_sequence
from habitus.parallel import blocks
from habitus.solve.sequence import SequenceOptions

GRID = WINDOWS.grid
OVERLAP = WINDOWS.overlap
LONGEST = 2 * OVERLAP + 5 * GRID


@pytest.fixture
def tiny_memory(monkeypatch):
    """Arrays of more than a kilobyte lie over files, and sixteen frames are worked on together."""
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)


@pytest.mark.parametrize("frames", [1, LONGEST, LONGEST + 1, 2345, 30_001])
def test_every_frame_is_kept_once_with_enough_around_it(frames):
    few = np.random.default_rng(frames).random(frames) < 0.1
    parts = windows(few, LONGEST)
    assert [k for part in parts for k in range(frames)[part.kept]] == list(range(frames))
    for part in parts:
        assert (
            part.solved.start == max(0, part.kept.start - OVERLAP) and part.kept.start % GRID == 0
        )
        assert part.solved.stop >= min(frames, part.kept.stop + OVERLAP)
        assert part.solved.stop - part.solved.start <= LONGEST + OVERLAP + 1
        assert range(frames)[part.solved][part.inside] == range(frames)[part.kept]


def test_windows_meet_where_markers_are_seen():
    few = np.zeros(60_000, bool)
    few[9000:10_000] = few[20_000:20_100] = True
    for part in windows(few, 10_000)[1:]:
        assert not few[part.kept.start - OVERLAP : part.kept.start + OVERLAP].any()


@pytest.fixture(scope="module")
def long():
    """A capture of five windows with gaps, ghosts and rough starts, where single frames have
    several optima.
    """
    s = scene(frames=1200, noise=0.003, seed=2)
    s.observed[s.rng.random(s.observed.shape[:2]) < 0.1] = np.nan
    s.observed[400:410] = np.nan
    s.observed[s.rng.random(s.observed.shape[:2]) < 0.05] += 0.3
    s.start = s.pose + np.radians(25) * s.rng.normal(size=s.pose.shape)
    return s


@pytest.mark.parametrize(
    "options",
    [
        SequenceOptions(),
        SequenceOptions(strides=(1,), damping=1.0),
        SequenceOptions((4, 1), coarse_sweeps=4, damping=1.0, corrects=True),
    ],
)
@pytest.mark.parametrize("soft", [False, True])
def test_windows_give_what_one_solve_gives(long, soft, options, tiny_memory):
    scales = np.full(25, 0.05)
    settings = SequenceSettings(options=options)
    given = (
        long.rig,
        long.observed,
        None,
        scales,
        long.prior,
        long.start,
        long.trans + 0.05,
        settings,
    )
    still = np.zeros((len(long.pose), 4)) if soft else None
    whole = fit_sequence(*given, still)
    cut = fit_long(*given, still, longest=LONGEST)
    assert len(windows(np.zeros(len(long.pose), bool), LONGEST)) >= 4
    assert (
        np.degrees(np.abs(cut.pose - whole.pose).max()) < 0.01
        and np.abs(cut.trans - whole.trans).max() < 1e-4
    )
    np.testing.assert_allclose(cut.frame_costs, whole.frame_costs, rtol=1e-4)
    np.testing.assert_allclose(cut.weights, whole.weights, atol=1e-3)
    for name, cost in whole.costs.items():
        np.testing.assert_allclose(cut.costs[name], cost, rtol=1e-4, atol=1e-9)
    assert cut.status == whole.status and (cut.soft_tissue is None) == (not soft)
    assert 1 < cut.iterations <= whole.iterations
    np.testing.assert_allclose(cut.history, [whole.history[0], whole.history[-1]], rtol=0.01)


@pytest.mark.parametrize("frames, gap", [(1200, 15), (1185, 16), (1186, 1)])
def test_the_coarsest_level_knows_how_far_its_last_frame_is_from_the_one_before(
    long, monkeypatch, frames, gap
):
    part = slice(0, frames)
    gaps = []
    monkeypatch.setattr(
        "habitus.fit.markers.sequence.solve_coarsest",
        lambda problem, start, gap, *_: gaps.append(gap),
    )
    given = (
        long.rig,
        long.observed[part],
        None,
        None,
        long.prior,
        long.start[part],
        long.trans[part],
    )
    with pytest.raises(TypeError):  # nothing was solved
        fit_long(
            *given, SequenceSettings(options=SequenceOptions(strides=(16, 4, 1))), longest=LONGEST
        )
    assert gaps == [gap]


def test_a_start_in_windows_is_the_start_of_the_whole(long):
    given = (long.rig, long.pose[::400], tuple("abcde"), long.observed)
    for found, expected in zip(start_long(*given, LONGEST), start_sequence(*given), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_capture_of_one_window_is_solved_as_ever(long):
    part = slice(0, 60)
    given = (
        long.rig,
        long.observed[part],
        None,
        None,
        long.prior,
        long.start[part],
        long.trans[part],
    )
    one = fit_long(*given, SequenceSettings(), longest=60)
    other = fit_sequence(*given, SequenceSettings())
    assert (
        np.array_equal(one.pose, other.pose)
        and one.costs == other.costs
        and one.history == other.history
    )


def test_the_causal_mode_is_the_same_where_memory_is_short(long, monkeypatch):
    given = (
        long.rig,
        long.observed[:64],
        long.prior,
        (long.pose[:1], long.trans[:1]),
        np.full(25, 0.1),
    )
    plenty = fit_causally(*given, SequenceSettings())
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 16)
    short = fit_causally(*given, SequenceSettings())
    assert np.array_equal(plenty.pose, short.pose) and np.array_equal(plenty.weights, short.weights)


def test_every_stage_of_a_fit_uses_the_windows_of_its_settings(monkeypatch):
    planted = plant(frames=40)
    recording = Recording("short", planted.observed, 30.0, "+y")
    cut = WindowSettings(overlap=48)
    settings = MoshSettings(annealing=(1.0,), frames=3, soft_tissue=True, windows=cut)
    used = []

    def recorded(*values, **options):
        used.append(options.get("cut"))
        return fit_long(*values, **options)

    monkeypatch.setattr("habitus.fit.markers.recipe.fit_long", recorded)
    fit_markers(person(), prior_of_poses(), planted.layout, [recording], settings)
    assert used == [cut, cut, cut]  # the pose stage twice, the soft-tissue stage


def test_a_recipe_that_is_short_of_memory_gives_the_same_fit(monkeypatch, tmp_path):
    """One whole recipe, arrays over files and all: the bodies, the suspects and the files are the
    same.
    """
    planted = plant(frames=640)
    observed = planted.observed.copy()
    observed[200:260, [3, 7]] = observed[200:260, [7, 3]]
    observed[300:302, 5] = observed[320:400, 6] = observed[450:470] = np.nan
    observed[500:505, 2] += 2000.0
    recording = Recording("long", observed, 30.0, "+y")
    settings = MoshSettings(annealing=(1.0,), frames=3, longest=2 * OVERLAP + 3 * GRID)

    def fit(settings):
        return fit_markers(person(), prior_of_poses(), planted.layout, [recording], settings)[0]

    plenty = fit(replace(settings, longest=640))
    monkeypatch.setattr(blocks, "IN_MEMORY", 1000)
    monkeypatch.setattr(blocks, "BLOCK", 100)
    short = fit(settings)
    assert blocks.is_file_backed(short.pose) and not blocks.is_file_backed(plenty.pose)
    assert np.degrees(np.abs(short.pose - plenty.pose).max()) < 0.01
    assert short.suspects == plenty.suspects and any(
        "swapped" in one.reason for one in short.suspects
    )
    assert short.verdict == plenty.verdict
    np.testing.assert_allclose(short.errors_mm, plenty.errors_mm, atol=0.05)
    np.testing.assert_array_equal(short.visible, plenty.visible)
    write_npz(short, tmp_path / "short.npz")
    with np.load(tmp_path / "short.npz") as file:
        np.testing.assert_array_equal(file["poses"].reshape(short.pose.shape), short.pose)
        np.testing.assert_array_equal(file["markers_obs"], np.float32(short.observed_markers))
