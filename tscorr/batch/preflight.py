"""What the machine must have for a batch, looked at before any work starts."""

import logging
import math
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tscorr import config, publish
from tscorr.errors import ConfigError, OutputError, TscorrError
from tscorr.scene.correct import is_current, target_of
from tscorr.scene.cutting import BASE_MB, memory_mb
from tscorr.scene.forecast import available_mb, disk_bytes
from tscorr.scene.plan import Scene

log = logging.getLogger("tscorr")

LEAST_BLOCKS_MB = 5
"""what the blocks of any image take"""


def preflight(settings: config.Config, planned: Sequence[Scene], *, overwrite: bool) -> Iterator[TscorrError]:
    """Every reason why these scenes could not be computed and written here, as errors to be raised."""
    todo = [scene for scene in planned if overwrite or not is_current(scene)]
    if not overwrite:
        yield from _partial(todo)
    yield from _memory(todo)
    folder = Path(settings.output.directory)
    try:
        existing = _writable(folder)
    except ConfigError as error:
        yield error
    else:
        yield from _disk(todo, existing)


def _partial(todo: Sequence[Scene]) -> Iterator[TscorrError]:
    """Results of some materials must not take the place of whole ones unasked."""
    for scene in todo:
        manifest = publish.read_manifest(target_of(scene))
        if scene.only and manifest is not None and not manifest.get("materials"):
            yield ConfigError(
                f"scene '{scene.name}': {target_of(scene)} holds the result of all materials; a run with --material "
                f"would take its place: give another [output] directory, or --overwrite"
            )


def _memory(todo: Sequence[Scene]) -> Iterator[TscorrError]:
    """The limit must hold the smallest block of each image, and the machine the limit."""
    elsewhere = any(scene.config.run.scheduler is not None for scene in todo)
    free_mb = math.inf if elsewhere else available_mb()
    for scene in todo:
        need_mb, limit_mb = memory_mb(scene), scene.config.run.memory_limit_mb
        if need_mb > limit_mb:
            rows, cols = scene.image.tile
            stored = f"since the image {scene.image.path} is stored in blocks of {rows} x {cols} pixels"
            helps = limit_mb > BASE_MB + LEAST_BLOCKS_MB
            why, or_else = (stored, ", or store it in smaller tiles") if helps else ("as any scene does", "")
            yield ConfigError(
                f"scene '{scene.name}' takes about {need_mb:.0f} MB of memory, {why}; [run] memory_limit_mb = "
                f"{limit_mb}: allow more{or_else}"
            )
        elif need_mb > free_mb:
            yield OutputError(
                f"scene '{scene.name}' takes at least {need_mb:.0f} MB of memory; {free_mb:.0f} MB are available"
            )


def _writable(folder: Path) -> Path:
    """What exists of the way to the output folder; ConfigError where nothing can be written there."""
    existing = folder
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    said, real = f"[output] directory = {folder}: {existing}", folder.resolve()
    result = next((place for place in (real, *real.parents) if publish.read_manifest(place) is not None), None)
    if result is not None:
        raise ConfigError(
            f"[output] directory = {folder} lies in the published result {result}, which would no longer be what its "
            f"manifest says; allowed is a folder elsewhere: give one, or copy the configuration to another folder"
        )
    if not existing.is_dir():
        raise ConfigError(f"{said} is not a folder; allowed is a folder that can be made")
    try:
        with tempfile.TemporaryFile(dir=existing):  # asking for permissions does not tell: root has them all
            return existing
    except OSError as error:
        raise ConfigError(
            f"{said} cannot be written: {error.strerror}; allowed is a folder that can be made"
        ) from None


def _disk(todo: Sequence[Scene], folder: Path) -> Iterator[TscorrError]:
    """The results must fit on the disk, each beside the one that it replaces until that is deleted."""
    free = shutil.disk_usage(folder).free
    least, most = _peaks(todo)
    if least > free:
        yield OutputError(
            f"the results need {least / 1e6:.1f} MB on the disk of {folder}, or {most / 1e6:.1f} MB where they do not "
            f"compress; {free / 1e6:.1f} MB are free"
        )
    elif most > free:
        log.warning(
            "the results may need up to %.1f MB on the disk of %s; %.1f MB are free", most / 1e6, folder, free / 1e6
        )


def _peaks(todo: Sequence[Scene]) -> tuple[float, float]:
    """Bytes in use above those of now while the scenes are written one after the other, at the worst: least, most."""
    used = peak = np.zeros(2)
    for scene in todo:
        used = used + disk_bytes(scene)
        peak = np.maximum(peak, used)
        old = publish.read_manifest(target_of(scene))
        used = used - (0 if old is None else sum(entry["bytes"] for entry in old["outputs"].values()))
    return float(peak[0]), float(peak[1])
