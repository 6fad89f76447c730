"""Keeps compiled kernels as new as the sources they were made from.

numba renews a kernel that it cached on disk when the kernel's own file changes, and not when the file of a function
or constant that it uses does: after an edit, results would silently stay those of the old source.
"""

from __future__ import annotations

import os
from pathlib import Path


def forget_stale_kernels(package: Path) -> int:
    """Delete the cached kernels below `package` that are older than its newest source; returns how many.

    A package that cannot be written to holds no cache of its own, and nobody edits it.
    """
    if not os.access(package, os.W_OK):
        return 0
    newest_ns = max((source.stat().st_mtime_ns for source in package.rglob("*.py")), default=0)
    stale = [kernel for kernel in package.rglob("*.nb[ic]") if _age_ns(kernel) < newest_ns]
    for kernel in stale:
        kernel.unlink(missing_ok=True)
    return len(stale)


def _age_ns(path: Path) -> int:
    """Time of the last change; 0 if another process has just deleted it."""
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:
        return 0
