"""Memory of the C library, kept for the next step instead of returned after each operator."""

import ctypes
import platform

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # as malloc.h numbers them
_LARGEST_BLOCK = 32 << 20  # bytes: the most glibc lets lie in its heap
_KEPT = 1 << 30  # bytes free at the heap's end, up to which they stay


def keep_freed_memory() -> None:
    """Make glibc keep freed blocks of up to 32 MiB; no other C library is touched.

    Otherwise each feature map of some MiB is mapped again, and the kernel clears its pages one by
    one, which costs up to a third of a cheap convolution's time. Peak memory stays about what it
    was; freed memory stays with this process.
    """
    if platform.libc_ver()[0] == "glibc":
        c_library = ctypes.CDLL(None)
        c_library.mallopt(_MMAP_THRESHOLD, _LARGEST_BLOCK)
        c_library.mallopt(_TRIM_THRESHOLD, _KEPT)
