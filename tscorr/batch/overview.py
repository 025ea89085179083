"""What stands at the top of the output folder: batch.json, index.html and the STAC collection."""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tscorr import __version__, config, stac
from tscorr.batch.outcome import BatchResult
from tscorr.errors import TscorrError
from tscorr.publish import read_manifest, write_whole
from tscorr.report import Difference, Overlap, SceneLine, batch_page
from tscorr.scene.correct import target_of
from tscorr.scene.overlap import overlaps
from tscorr.scene.plan import Scene

log = logging.getLogger("tscorr")


def write_overview(settings: config.Config, result: BatchResult, planned: Sequence[Scene]) -> None:
    """batch.json, index.html and the STAC collection at the top of the output folder."""
    rows = [
        {
            "scene": scene.name,
            "state": scene.state,
            "folder": scene.folder.name,
            "error": scene.error,
            "key": _key(scene.folder),
        }
        for scene in result.scenes
    ]
    shared = _overlaps(result, planned)
    batch = {
        "title": settings.title,
        "tscorr": __version__,
        "scenes": rows,
        "overlaps": [asdict(overlap) for overlap in shared],
    }
    page = batch_page(settings.title, _lines(settings, result), shared, __version__)
    try:
        write_whole(result.folder / "batch.json", json.dumps(batch, indent=1) + "\n")
        write_whole(result.folder / "index.html", page)
        items = _items(result.folder)
        if items:
            collected = stac.collection(title=settings.title or "tscorr", items=items)
            write_whole(result.folder / "collection.json", json.dumps(collected, indent=1) + "\n")
    except OSError as error:
        log.warning("the overview in %s could not be written: %s", result.folder, error)


def _items(folder: Path) -> list[dict[str, Any]]:
    """The STAC items of the results in a folder; what else lies there is left alone."""
    found = [_read(path) for path in sorted(folder.glob("*/item.json")) if read_manifest(path.parent) is not None]
    return [item for item in found if item is not None]


def _read(path: Path) -> dict[str, Any] | None:
    """The content of a JSON file of a result; None where somebody damaged it."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        log.warning("%s cannot be read, and is left out of the overview: %s", path, error)
        return None
    return content if isinstance(content, dict) else None


def _key(folder: Path) -> str | None:
    """The key that a published result was made with; None where there is none."""
    manifest = read_manifest(folder)
    return None if manifest is None else manifest.get("key")


def _lines(settings: config.Config, result: BatchResult) -> list[SceneLine]:
    """The scenes of this run, and those of the configuration that earlier runs have published."""
    lines = [
        SceneLine(scene.name, scene.state, scene.folder.name, scene.error, _brief(scene.report))
        for scene in result.scenes
    ]
    known = {scene.name for scene in result.scenes}
    for name in (str(scene.name) for scene in settings.scenes):
        path = result.folder / name / "report.json"
        if name not in known and path.exists() and (report := _read(path)) is not None:
            lines.append(SceneLine(name, "earlier", name, report=_brief(report)))
    return lines


def _brief(report: dict[str, Any] | None) -> dict[str, Any] | None:
    """A report without its tables, which no page of a batch shows: of many scenes they fill the memory."""
    if report is None:
        return None
    tables = {"heading": [], "materials": {name: {**m, "width_at": []} for name, m in report["materials"].items()}}
    return {**report, **tables}


def _overlaps(result: BatchResult, planned: Sequence[Scene]) -> list[Overlap]:
    """The differences of scenes that share ground; those of the last run where it had the same results."""
    states = {scene.name: scene.state for scene in result.scenes}
    if set(states.values()) == {"current"} and (known := _known_overlaps(result)) is not None:
        return known
    try:
        return overlaps([(scene, target_of(scene)) for scene in planned if states[scene.name] != "failed"])
    except (TscorrError, OSError) as error:
        log.warning("the overlaps of the scenes could not be compared: %s", error)
        return []


def _known_overlaps(result: BatchResult) -> list[Overlap] | None:
    """The overlaps in batch.json if it is of the same results, none of which failed."""
    try:
        batch = json.loads((result.folder / "batch.json").read_text(encoding="utf-8"))
        results = [(scene.name, _key(scene.folder)) for scene in result.scenes]
        same = [(row["scene"], row["key"]) for row in batch["scenes"]] == results
        if not same or any(row["state"] == "failed" for row in batch["scenes"]):
            return None
        return [
            Overlap(row["first"], row["second"], {name: Difference(*d) for name, d in row["materials"].items()})
            for row in batch["overlaps"]
        ]
    except (OSError, ValueError, KeyError, TypeError):  # missing, or of another version
        return None
