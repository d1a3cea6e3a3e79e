"""Memory for images: kept between calls instead of given back to the system and faulted in again
page by page.
"""

from functools import lru_cache

import torch

LARGEST = 31 << 20
"""Bytes: a little under the 32 MB above which glibc gives every block back."""


@lru_cache(maxsize=1)
def keep_memory() -> None:
    """Let glibc keep freed blocks up to `LARGEST`, and twice that in all, for the rest of the
    process.

    It keeps blocks no larger than the largest that was freed before (`man mallopt`,
    M_MMAP_THRESHOLD), so one is freed; it is never touched and takes no memory. Other libraries of
    C are not changed.
    """
    torch.empty(LARGEST, dtype=torch.uint8)
