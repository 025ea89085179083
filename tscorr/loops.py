"""How loops over pixels are compiled: without reference counts, since they allocate nothing; half as much to compile.

An edit here does not reach what numba has cached: it looks at the file of each function, and not at this one.
"""

from typing import Any

PART: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "_nrt": False,
    "no_cfunc_wrapper": True,
    "no_cpython_wrapper": True,
}
"""called from other compiled code only"""
LOOP: dict[str, Any] = {**PART, "no_cpython_wrapper": False, "cache": True}
"""called from Python"""
