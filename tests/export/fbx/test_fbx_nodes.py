import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from read_fbx import Record, read_records

from habitus.errors import HabitusError
from habitus.export.fbx import nodes as writer
from habitus.export.fbx.nodes import Node, document, packed

ARRAYS = st.sampled_from(["f4", "f8", "i4", "i8"]).flatmap(
    lambda kind: arrays(kind, array_shapes(max_dims=2, max_side=40))
)
VALUES = st.one_of(
    st.booleans(),
    st.integers(-(2**31), 2**31 - 1),
    st.integers(-(2**63), 2**63 - 1).map(np.int64),
    st.floats(),
    st.text(max_size=20),
    st.binary(max_size=20),
    ARRAYS,
)
NAMES = st.text("abcXYZ_0", min_size=1, max_size=12)
TREES = st.recursive(
    st.builds(Node, NAMES, st.lists(VALUES, max_size=4).map(tuple)),
    lambda inner: st.builds(
        Node, NAMES, st.lists(VALUES, max_size=3).map(tuple), st.lists(inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(st.lists(TREES, max_size=4))
def test_a_reader_finds_what_was_written(trees):
    found = read_records(document(trees))
    assert len(found) == len(trees)
    for record, node in zip(found, trees, strict=True):
        _same(record, node)


def _same(record: Record, node: Node) -> None:
    assert record.name == node.name and len(record.values) == len(node.values)
    for found, known in zip(record.values, node.values, strict=True):
        if isinstance(known, np.ndarray):
            assert found.dtype == known.dtype and found.tobytes() == known.tobytes()
        else:
            assert found == known or (found != found and known != known)
    assert len(record.records) == len(node.nodes)
    for child, known in zip(record.records, node.nodes, strict=True):
        _same(child, known)


def test_what_has_no_form_is_refused(monkeypatch):
    for value in (np.zeros(2, np.float16), None):
        with pytest.raises(TypeError, match="no form in FBX"):
            document([Node("a", (value,))])
    monkeypatch.setattr(writer, "_LARGEST", 100)
    with pytest.raises(HabitusError, match="larger than 4 GB"):
        document([Node("a", (b"x" * 101,))])


def test_long_arrays_are_packed_once():
    times = packed(np.arange(1000))
    assert len(times) < 4000
    assert np.array_equal(
        read_records(document([Node("a", (times, times))]))[0].values[1], np.arange(1000)
    )


@pytest.mark.parametrize("name", ["AnimationStack", "AnimationLayer"])
def test_layers_of_animation_end_with_a_null_record(name):
    """As other writers have it; assimp does not follow links to them otherwise."""
    end = document([Node(name, (np.int64(7), "walk"))]).index(b"walk") + len("walk")
    with_null = document([Node(name, (np.int64(7), "walk"))])
    assert with_null[end : end + 13] == bytes(13) and with_null[27:31] == (end + 13).to_bytes(
        4, "little"
    )
