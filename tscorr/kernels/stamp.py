"""A stamp of sources, for numba's cache: that looks at the file of a cached function, and not at those it calls."""

from hashlib import sha256
from pathlib import Path


def sources_of(folder: Path) -> int:
    """A number that changes with any source in a folder.

    As the default of an argument it is part of a compiled function's signature, by which numba looks for what it
    has compiled before.
    """
    digest = sha256()
    for path in sorted(folder.glob("*.py")):
        digest.update(path.read_bytes())
    return int.from_bytes(digest.digest()[:7])


SOURCES = sources_of(Path(__file__).parent)
