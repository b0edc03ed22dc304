"""Versions that belong into a report."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

_LIBRARIES = ("tiptrace", "numpy", "scipy", "opencv-python-headless", "onnxruntime")


def library_versions() -> dict[str, str]:
    """Version of Python and of each library that has a part in the numbers."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
