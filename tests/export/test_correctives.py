import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from habitus.errors import HabitusError
from habitus.export.correctives import WORST, Block, check_correctives, morphs_of

VERTICES, FRAMES = 40, 30


def made(seed: int, scale: float) -> list[Block]:
    rng = np.random.default_rng(seed)
    blocks = []
    for name, count in (("hip", 9), ("knee", 9)):
        some = np.sort(rng.choice(VERTICES, 12, replace=False))
        terms = rng.normal(size=(FRAMES, 2)) @ rng.normal(size=(2, count)) * 0.3  # two ways of moving
        shapes = scale * rng.normal(size=(12, 3, count))
        ends = tuple("abcdefghi")
        blocks.append(Block(name, some, shapes, (np.clip(terms, -2, 2),), ends, live=True))
    soft = scale * rng.normal(size=(VERTICES, 3, 4))
    blocks.append(Block("soft_tissue", np.arange(VERTICES), soft, (rng.normal(size=(FRAMES, 4)),)))
    return blocks


def whole(blocks: list[Block]) -> np.ndarray:
    out = np.zeros((FRAMES, VERTICES, 3))
    for block in blocks:
        out[:, block.vertices] += np.einsum("vcn,tn->tvc", block.shapes, block.coefficients[0])
    return out


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1e-6, 1e-4, 1e-2]), st.sampled_from(["auto", "all", "none", "pca:3"]))
def test_what_is_left_out_is_told(seed, scale, wanted):
    blocks = made(seed, scale)
    found = morphs_of(blocks, VERTICES, [FRAMES], wanted)
    shown = np.einsum("kvc,tk->tvc", found.shapes, found.weights[0])
    away = np.linalg.norm(shown - whole(blocks), axis=-1)
    assert away.max() == pytest.approx(found.worst, rel=1e-6, abs=1e-9)
    assert np.abs(found.weights[0]).max(initial=0) < 1 + 1e-9
    assert len(found.names) == len(set(found.names)) == len(found.shapes)
    count, most = len(found.shapes), {"auto": WORST, "all": 1e-9}.get(wanted, np.inf)
    assert found.worst <= most
    assert count == {"none": 0, "pca:3": 3, "all": 18 + 4}.get(wanted, count)
    if wanted == "auto":
        assert count <= 9 + 9 + 4 and (scale > 1e-6 or count == 0)


def test_local_ones_stay_local_and_live_ones_keep_their_measure():
    blocks = made(1, 1e-2)
    found = morphs_of(blocks, VERTICES, [FRAMES], "all")
    assert found.names[:2] == ("hip_a", "hip_b") and found.names[-1].startswith("soft_tissue_")
    assert np.allclose(found.shapes[0, blocks[0].vertices], 2 * blocks[0].shapes[..., 0])
    assert np.allclose(found.weights[0][:, 0], blocks[0].coefficients[0][:, 0] / 2)
    assert found.live.tolist() == 18 * [True] + 4 * [False]
    auto = morphs_of(blocks, VERTICES, [FRAMES], "auto")
    elsewhere = np.setdiff1d(np.arange(VERTICES), blocks[0].vertices)
    for name, shape in zip(auto.names, auto.shapes, strict=True):
        assert not name.startswith("hip") or not shape[elsewhere].any()


@pytest.mark.parametrize("text", ["", "pca", "pca:", "pca:0", "pca:x", "all:3", "some", "pca:99999"])
def test_other_words_are_refused(text):
    with pytest.raises(HabitusError, match="expected auto, all, none"):
        check_correctives(text)
