"""Kernels compile when they are first called, and again when any file of kernels changes."""

import gc
import importlib
import pickle
import re
from pathlib import Path

import pytest
from numba import njit, types
from numba.core.errors import TypingError
from numba.extending import intrinsic

from habitus.fit.markers import sequence_kernels
from habitus.kernels.jit import FILES, HERE, jit


def test_every_file_of_kernels_is_watched():
    marked = re.compile(r"^@(jit|jit_noalloc|jit_inline)\b", re.MULTILINE)
    found = {
        str(path.relative_to(HERE))
        for path in HERE.rglob("*.py")
        if marked.search(path.read_text())
    }
    assert found <= set(FILES)
    assert all((HERE / name).exists() for name in FILES)


def test_the_stamp_of_a_kernel_covers_all_of_them():
    def kernel():
        return 1

    kernel.__module__, version = __name__, jit(kernel)._cache._cache_file._version
    assert len(version[1]) == len(FILES)


def test_an_index_of_other_files_is_not_even_unpickled(tmp_path, monkeypatch):
    """What it names may be gone since: the fields of a tuple that a kernel took, say."""
    source = tmp_path / "kernel_of_a_test.py"
    source.write_text("def kernel(x):\n    return x + 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    kernel = jit(importlib.import_module("kernel_of_a_test").kernel)
    assert kernel(1.0) == 2.0
    cache = kernel._cache._cache_file
    index = Path(cache._index_path)
    assert len(cache._load_index()) == 1
    index.write_bytes(pickle.dumps(("another", ())) + b"no pickle")
    assert cache._load_index() == {}


@pytest.mark.parametrize("damaged", ["*.nbi", "*.nbc"])
def test_a_damaged_cache_is_compiled_anew(damaged, tmp_path, monkeypatch):
    name = f"kernel_of_{damaged[-3:]}"
    (tmp_path / f"{name}.py").write_text("def kernel(x):\n    return x + 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    function = importlib.import_module(name).kernel
    assert jit(function)(1.0) == 2.0
    (file,) = (tmp_path / "__pycache__").glob(damaged)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert jit(function)(1.0) == 2.0
    again = jit(function)
    assert again(1.0) == 2.0 and sum(again.stats.cache_hits.values()) == 1


def test_kernels_run_where_no_cache_can_be_written(tmp_path, monkeypatch):
    (tmp_path / "kernel_alone.py").write_text("def kernel(x):\n    return x + 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(
        "numba.core.caching._CacheLocator.ensure_cache_path", raising(OSError("read-only"))
    )
    assert jit(importlib.import_module("kernel_alone").kernel)(1.0) == 2.0


def test_a_full_disk_does_not_end_a_run_that_compiles(tmp_path, monkeypatch):
    (tmp_path / "kernel_full.py").write_text("def kernel(x):\n    return x + 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    kernel = jit(importlib.import_module("kernel_full").kernel)
    monkeypatch.setattr(kernel._cache._cache_file, "_save_data", raising(OSError("no space left")))
    assert kernel(1.0) == 2.0


def raising(error: Exception):
    def fail(*_: object) -> None:
        raise error

    return fail


def test_importing_compiles_nothing():
    import subprocess
    import sys

    asks = (
        "import habitus.fit.markers.sequence_kernels as k; print(len(k.visit.signatures), "
        "len(k.costs.signatures))"
    )
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "0"]
    assert sequence_kernels.visit.targetoptions["nogil"]


def test_no_garbage_is_collected_while_numba_compiles():
    """What a caller chose is chosen again afterwards, also where compiling fails."""
    states = []
    for before in (True, False):

        @intrinsic
        def look(typingctx):
            states.append(gc.isenabled())
            return types.void(), lambda context, *_: context.get_dummy_value()

        (gc.enable if before else gc.disable)()
        try:
            njit(lambda: look())()
            with pytest.raises(TypingError):
                njit(lambda: 1.0 + "no number")()
            assert gc.isenabled() == before
        finally:
            gc.enable()
    assert len(states) == 2 and not any(states)
