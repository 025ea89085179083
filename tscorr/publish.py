"""Publishing a result: an output folder is whole or absent.

Work happens in a hidden sibling folder on the same file system; the manifest is written last, everything is
flushed to disk, and one rename puts the folder in its place. A folder that stands there already is renamed first, to
be hidden, and deleted last: where a run was killed between the two renames, `recover` puts it back.
"""

import hashlib
import json
import os
import re
import shutil
import threading
import uuid
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

from blake3 import blake3

from tscorr.errors import InputError, OutputError

MANIFEST = "manifest.json"
SEALED = ',\n "manifest_sha256": "'
"""stands before the hash that ends a manifest"""
HASHES: dict[str, Callable[[], Any]] = {"blake3": blake3, "sha256": hashlib.sha256}
"""of files, by the name that stands in the manifest; BLAKE3 takes a third of the time of SHA-256"""
READ_BYTES = 2 << 20
HIDDEN = re.compile(r"\.(?P<name>.+)\.[0-9a-f]{8}\.(?P<kind>part|old)")
"""names of what is being made and of what is being replaced"""
UNFINISHED = re.compile(r"\..+\.(?:part|old|strips)")


def hidden_name(target: Path, kind: str) -> Path:
    """A hidden sibling of `target` that nobody has: of the kind "part" (being made) or "old" (being replaced)."""
    return target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.{kind}")


def recover(folder: Path) -> list[str]:
    """Clear up after runs that were killed: put back what was being replaced, delete what was not finished.

    Only for who holds the lock of the folder. Returns what was done, one sentence each.
    """
    done = []
    for path in sorted(folder.iterdir()):
        found = HIDDEN.fullmatch(path.name)
        if found is None:
            continue
        target = folder / found["name"]
        if found["kind"] == "old" and read_manifest(path) is not None and not target.exists():
            path.rename(target)
            done.append(f"{target} is put back: a killed run was about to replace it")
        elif path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
            done.append(f"{path} of a killed run is deleted")
        else:
            path.unlink()
            done.append(f"{path} of a killed run is deleted")
    return done


def write_whole(path: Path, text: str) -> None:
    """Write a text file that is never seen half written."""
    part = hidden_name(path, "part")
    try:
        part.write_text(text, encoding="utf-8")
        _flush(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


class Publication:
    """A folder in the making: write into `.folder`, then `commit`. Leaving without a commit deletes it.

    algorithm : one of HASHES. early : hash files as soon as they are whole, beside other work.
    """

    def __init__(self, target: Path, *, algorithm: str = "blake3", early: bool = False) -> None:
        self.target = target
        self._algorithm = algorithm
        self.folder = hidden_name(target, "part")
        self._early = early
        self._hasher = ThreadPoolExecutor(1)
        self._hashes: dict[Path, Future[str]] = {}

    def __enter__(self) -> Self:
        try:
            self.folder.mkdir(parents=True)
        except OSError as error:
            raise OutputError(f"the output folder {self.folder.parent} cannot be written: {error}") from None
        return self

    def __exit__(self, *_: object) -> None:
        self._hasher.shutdown(cancel_futures=True)
        shutil.rmtree(self.folder, ignore_errors=True)

    def hash_early(self, path: Path) -> None:
        """Start to hash a file of the folder that is whole, if that is to be done while others are still written."""
        if self._early:
            self._hash(path)

    def _hash(self, path: Path) -> None:
        if path not in self._hashes:
            self._hashes[path] = self._hasher.submit(digest, path, self._algorithm)

    def commit(self, manifest: Mapping[str, Any]) -> None:
        """Write the manifest with the hashes of all files, flush, and take the target's place."""
        try:
            files = sorted(path for path in self.folder.iterdir() if path.name != MANIFEST)
            for path in files:
                self._hash(path)
            outputs = {
                path.name: {self._algorithm: self._hashes[path].result(), "bytes": path.stat().st_size}
                for path in files
            }
            path = self.folder / MANIFEST
            path.write_text(_sealed(json.dumps({**manifest, "outputs": outputs}, indent=1)), encoding="utf-8")
            for file in (*files, path):
                _flush(file)
            _flush(self.folder)
            self._replace()
        except OSError as error:
            raise OutputError(f"{self.target} cannot be published: {error}") from None

    def _replace(self) -> None:
        old = hidden_name(self.target, "old")
        if self.target.exists():
            self.target.rename(old)
        self.folder.rename(self.target)
        _flush(self.target.parent)
        shutil.rmtree(old, ignore_errors=True)


class EarlyHashes:
    """Hashes of the inputs, found by a thread of its own while they are worked on.

    algorithm : one of HASHES.
    """

    def __init__(self, paths: Iterable[Path], algorithm: str = "blake3") -> None:
        self._paths, self._algorithm = list(paths), algorithm
        self._stop = threading.Event()
        self._pool = ThreadPoolExecutor(1)
        self._hashes = [self._pool.submit(_digest_of_input, path, algorithm, self._stop) for path in self._paths]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown(cancel_futures=True)

    def entries(self) -> dict[str, dict[str, str]]:
        """The manifest's entry of each path; waits for those that are still being read."""
        found = (future.result() for future in self._hashes)
        return {str(path): {self._algorithm: digest} for path, digest in zip(self._paths, found, strict=True)}


def digest(path: Path, algorithm: str, stop: threading.Event | None = None) -> str:
    """Hash of a file, as hexadecimal digits; of no more than its beginning once `stop` is set.

    algorithm : one of HASHES.
    """
    content, buffer = HASHES[algorithm](), memoryview(bytearray(READ_BYTES))
    with path.open("rb", buffering=0) as file:
        while (size := file.readinto(buffer)) and not (stop is not None and stop.is_set()):
            content.update(buffer[:size])
    return str(content.hexdigest())


_Version = tuple[str, Path, int, int]

_KNOWN: dict[_Version, str] = {}
"""hashes of the inputs of late, by algorithm, path, size and time of change; a surface model serves all scenes"""
MOST_KNOWN = 64
_reading: dict[_Version, threading.Lock] = {}
"""of inputs that are being read: of what several scenes share, by the first of them, while the others wait"""
_knowing = threading.Lock()


def _digest_of_input(path: Path, algorithm: str, stop: threading.Event) -> str:
    """Hash of an input that is read once, unless it changes."""
    status = path.stat()
    version = algorithm, path, status.st_size, status.st_mtime_ns
    with _knowing:
        own = _reading.setdefault(version, threading.Lock())
    try:
        with own:
            found = _KNOWN.get(version) or digest(path, algorithm, stop)
            with _knowing:
                if not stop.is_set():
                    _KNOWN.pop(version, None)
                    _KNOWN[version] = found  # behind those that were asked for before
                while len(_KNOWN) > MOST_KNOWN:
                    del _KNOWN[next(iter(_KNOWN))]
    finally:
        _reading.pop(version, None)
    return found


def identities(paths: Iterable[Path]) -> dict[str, dict[str, int]]:
    """What tells one version of each input from another without reading it: size and time of change, by path.

    Raises InputError where one is gone.
    """
    found = {}
    for path in paths:
        try:
            status = path.stat()
        except OSError as error:
            raise InputError(f"the input {path} cannot be read: {error.strerror}") from None
        found[str(path.resolve())] = {"bytes": status.st_size, "changed_ns": status.st_mtime_ns}
    return found


def key(settings: Mapping[str, Any], inputs: Mapping[str, Any], version: str) -> str:
    """Digest of everything that a result depends on; equal keys mean that nothing has to be done.

    inputs : their `identities`.
    """
    content = {"settings": settings, "inputs": inputs, "version": version}
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def is_current(target: Path, wanted: str, products: Iterable[str] = ()) -> bool:
    """Whether a published folder is whole, was made with this key, and has these products at least."""
    manifest = read_manifest(target)
    if manifest is None or manifest.get("key") != wanted or not set(products) <= set(manifest.get("products", ())):
        return False
    return all(
        (target / name).is_file() and (target / name).stat().st_size == entry["bytes"]
        for name, entry in manifest["outputs"].items()
    )


def read_manifest(target: Path) -> dict[str, Any] | None:
    """The manifest of a published folder, or None where there is none, or not as it was written."""
    try:
        text = (target / MANIFEST).read_text(encoding="utf-8")
        manifest = json.loads(text)
    except (OSError, ValueError):
        return None
    return manifest if isinstance(manifest, dict) and text == _sealed(text.rpartition(SEALED)[0] + "\n}") else None


def damaged(target: Path) -> list[str]:
    """What is wrong with a published folder: files missing, added or changed since; empty where all is well."""
    manifest = read_manifest(target)
    if manifest is None:
        return [f"{target / MANIFEST} is missing, or has changed since it was published"]
    problems = []
    for name, entry in manifest["outputs"].items():
        path = target / name
        if not path.is_file():
            problems.append(f"{path} is missing")
        elif not (known := [algorithm for algorithm in HASHES if algorithm in entry]):
            problems.append(f"{path} has no hash that this version of tscorr knows: {', '.join(entry)}")
        elif any(digest(path, algorithm) != entry[algorithm] for algorithm in known):
            problems.append(f"{path} has changed since it was published")
    expected = {MANIFEST, *manifest["outputs"]}
    problems += [f"{path} was not published" for path in sorted(target.iterdir()) if path.name not in expected]
    return problems


def published(folder: Path) -> list[Path]:
    """The published folders under a folder, itself included; not what is hidden until it is whole."""
    found = (path.parent for path in folder.glob(f"**/{MANIFEST}"))
    return sorted(path for path in found if not any(map(UNFINISHED.fullmatch, path.relative_to(folder).parts)))


def _sealed(content: str) -> str:
    """The text of a manifest, which ends in a hash of its content as a JSON object, indented by one."""
    seal = hashlib.sha256(content.encode()).hexdigest()
    return f'{content[:-2]}{SEALED}{seal}"\n}}\n'


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
