import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from habitus.errors import HabitusError
from habitus.export.correctives import WORST, Block, Drivers, check_correctives, furthest, morphs_of

VERTICES = 40
FRAMES = 30
WANTED = ["auto", "all", "none", "live:7", "pca:3"]


def made(seed: int, scale: float) -> list[Block]:
    rng = np.random.default_rng(seed)
    blocks = []
    for name, count in (("hip", 9), ("knee", 9)):
        some = np.sort(rng.choice(VERTICES, 12, replace=False))
        terms = (
            rng.normal(size=(FRAMES, 2)) @ rng.normal(size=(2, count)) * 0.3
        )  # two ways of moving
        shapes = scale * rng.normal(size=(12, 3, count))
        ends = tuple("abcdefghi")
        sample = rng.normal(size=(50, count)) * 0.3
        driven = Drivers.linear(np.eye(9))
        blocks.append(Block(name, some, shapes, (np.clip(terms, -2, 2),), ends, driven, sample))
    soft = scale * rng.normal(size=(VERTICES, 3, 4))
    blocks.append(Block("soft_tissue", np.arange(VERTICES), soft, (rng.normal(size=(FRAMES, 4)),)))
    return blocks


def whole(blocks: list[Block]) -> np.ndarray:
    out = np.zeros((FRAMES, VERTICES, 3))
    for block in blocks:
        out[:, block.vertices] += np.einsum("vcn,tn->tvc", block.shapes, block.coefficients[0])
    return out


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1e-6, 1e-4, 1e-2]), st.sampled_from(WANTED))
def test_what_is_left_out_is_told(seed, scale, wanted):
    blocks = made(seed, scale)
    found = morphs_of(blocks, VERTICES, [FRAMES], wanted)
    shown = np.einsum("kvc,tk->tvc", found.shapes, found.weights[0])
    away = np.linalg.norm(shown - whole(blocks), axis=-1)
    assert away.max() == pytest.approx(found.worst, rel=1e-6, abs=1e-8)  # of float32, as in files
    if wanted != "live:7":  # coefficients here are no rotation's, whose weights alone are bounded
        assert np.abs(found.weights[0]).max(initial=0) < 1 + 1e-9
    assert len(found.names) == len(set(found.names)) == len(found.shapes)
    count = len(found.shapes)
    most = {"auto": WORST, "all": 1e-9}.get(wanted, np.inf)
    assert found.worst <= most
    assert count == {"none": 0, "pca:3": 3, "live:7": 7 + 4, "all": 18 + 4}.get(wanted, count)
    if wanted == "auto":
        assert count <= 9 + 9 + 4 and (scale > 1e-6 or count == 0)


def test_local_ones_stay_local_and_live_ones_keep_their_measure():
    blocks = made(1, 1e-2)
    found = morphs_of(blocks, VERTICES, [FRAMES], "all")
    assert found.names[:2] == ("hip_a", "hip_b") and found.names[-1].startswith("soft_tissue_")
    assert np.allclose(found.shapes[0, blocks[0].vertices], 2 * blocks[0].shapes[..., 0])
    assert np.allclose(found.weights[0][:, 0], blocks[0].coefficients[0][:, 0] / 2)
    assert found.drivers.live.tolist() == 18 * [True] + 4 * [False]
    auto = morphs_of(blocks, VERTICES, [FRAMES], "auto")
    elsewhere = np.setdiff1d(np.arange(VERTICES), blocks[0].vertices)
    for name, shape in zip(auto.names, auto.shapes, strict=True):
        assert not name.startswith("hip") or not shape[elsewhere].any()


def test_rows_give_the_weights_of_any_pose_and_many_of_them_the_whole_surface():
    blocks = made(2, 1e-2)
    for wanted in ("all", "live:5", "live:18"):
        found = morphs_of(blocks, VERTICES, [FRAMES], wanted)
        for block in blocks[:2]:
            own = [k for k, name in enumerate(found.names) if name.startswith(f"{block.name}_")]
            assert np.allclose(
                found.weights[0][:, own], block.coefficients[0] @ found.drivers.rows[own].T
            )
        known = sum(
            (
                np.linalg.norm(b.shapes, axis=1).max() * np.abs(b.sample).sum(1).max()
                for b in blocks[:2]
            ),
            0.0,
        )
        assert (1e-4 < found.elsewhere < known) == (wanted == "live:5")
    assert found.worst < 1e-9  # all 18 of them


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_no_rotation_reaches_further(seed):
    rng = np.random.default_rng(seed)
    row = rng.normal(size=9)
    most = furthest(row)
    turns = Rotation.random(500, rng).as_matrix()
    found = ((turns - np.eye(3)).reshape(-1, 9) @ row).max()
    assert found <= most + 1e-9
    best = (
        Rotation.align_vectors(row.reshape(3, 3), np.eye(3))[0].inv().as_matrix()
    )  # the same, by another way
    assert ((best - np.eye(3)).ravel() @ row).max() == pytest.approx(most, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    "text", ["", "live", "live:0", "pca", "pca:", "pca:0", "pca:x", "all:3", "some", "pca:99999"]
)
def test_other_words_are_refused(text):
    with pytest.raises(HabitusError, match="expected auto, all, none"):
        check_correctives(text)
