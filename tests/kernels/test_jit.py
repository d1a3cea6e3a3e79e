"""Kernels compile when they are first called, and again when any file of kernels changes."""

import re

from habitus.fit.mosh import sequence_kernels
from habitus.kernels.jit import FILES, HERE, jit


def test_every_file_of_kernels_is_watched():
    marked = re.compile(r"^@(jit|jit_noalloc|jit_inline)\b", re.MULTILINE)
    found = {str(path.relative_to(HERE)) for path in HERE.rglob("*.py") if marked.search(path.read_text())}
    assert found <= set(FILES)
    assert all((HERE / name).exists() for name in FILES)


def test_the_stamp_of_a_kernel_covers_all_of_them():
    def kernel():
        return 1

    kernel.__module__, stamp = __name__, jit(kernel)._cache._cache_file._source_stamp
    assert len(stamp[1]) == len(FILES)


def test_importing_compiles_nothing():
    import subprocess
    import sys

    asks = "import habitus.fit.mosh.sequence_kernels as k; print(len(k.visit.signatures), len(k.costs.signatures))"
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "0"]
    assert sequence_kernels.visit.targetoptions["nogil"]
