"""Loops over pixels, markers and frames, compiled at their first call.

Compiled loops run outside the interpreter's lock, so that two fingers keep two cores busy. The machine code is kept
beside the module or in the user's cache folder; where neither can be written, each process compiles anew. Compiled
functions call such of their own module only: a change in another would not be noticed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])

_RELAXED = {"contract", "reassoc", "nsz", "arcp"}  # sums in any order; NaN and infinity keep their meaning


def compiled(function: Function) -> Function:
    """Compile a function of arrays and numbers; it must hold no Python object."""
    with_options = functools.partial(numba.njit, nogil=True, fastmath=_RELAXED, error_model="numpy")
    try:
        return cast(Function, with_options(cache=True)(function))
    except RuntimeError:  # no folder to keep the machine code in
        return cast(Function, with_options()(function))
