"""A scene in strips of whole rows, each by a process of its own, joined when all are done.

The strips are kept in a hidden folder beside that of the scene until they are joined:

    prepare       what a strip cannot know alone: shadow and sight over the whole scene, swept once
    correct_strip the rasters of one strip and its sums, published as a whole
    join          all files in the scene's folder, each product as a VRT of its strips, the report of all sums

Each step may be done twice, at the same time too, or be killed: what was done is found, what was not is done again.
"""

import json
import os
import re
import shutil
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from tscorr import publish, rasters
from tscorr.correction import Corrector, add_tally, new_tally
from tscorr.grid import Block, blocks
from tscorr.scene.correct import check_unchanged, finish, resume_key, target_of
from tscorr.scene.cutting import units_of
from tscorr.scene.ground import Ground
from tscorr.scene.memory import peak_rss_mb
from tscorr.scene.plan import Scene
from tscorr.scene.products import write_corrected_vrt, written_products
from tscorr.scene.run import Pipeline, Progress, silent
from tscorr.scene.sums import Sums

MASKS, SUMS = "masks", "sums.json"


@dataclass(frozen=True, slots=True)
class Strips:
    """The strips of a scene, and the hidden folder where they are kept until they are joined."""

    scene: Scene
    split_mpixel: float

    @property
    def key(self) -> str:
        """The scene's resume key."""
        return resume_key(self.scene)

    @property
    def blocks(self) -> list[Block]:
        """Whole rows of units of at most `split_mpixel`, or one row of units; they cover each pixel once.

        Their edges are those of the image's tiles. One for all where files of the format cannot be joined: ENVI.
        """
        rows, cols = self.scene.image.shape
        if self.scene.config.output.format == "envi":
            return [Block(0, 0, rows, cols)]
        unit = units_of(self.scene, workers=1)[0].height
        most = max(unit, int(self.split_mpixel * 1e6 / cols) // unit * unit)
        equal = -(-rows // -(-rows // most))
        return list(blocks((rows, cols), (-(-equal // unit) * unit, cols)))

    @property
    def folder(self) -> Path:
        """Of one version of the result, cut in one way: strips of another would not fit."""
        version = f"{self.key[:12]}-{self.blocks[0].height}"
        return target_of(self.scene).with_name(f"{hidden_prefix(self.scene)}{version}{HIDDEN_SUFFIX}")

    def part(self, number: int) -> Path:
        """The folder of one strip."""
        return self.folder / f"{number:04d}"


HIDDEN_SUFFIX = ".strips"


def hidden_prefix(scene: Scene) -> str:
    """How the names of the hidden folders of a scene's strips start."""
    return f".{scene.name}."


def clear(scene: Scene, keep: Path | None = None) -> None:
    """Delete the strips of a scene, but for those in the folder to keep."""
    own = re.compile(re.escape(hidden_prefix(scene)) + rf"[^.]*{re.escape(HIDDEN_SUFFIX)}")  # not of `name.2`
    for folder in target_of(scene).parent.glob(f".*{HIDDEN_SUFFIX}"):
        if folder != keep and own.fullmatch(folder.name):
            shutil.rmtree(folder, ignore_errors=True)


def prepare(strips: Strips) -> None:
    """Sweep the whole scene for what is in shadow or hidden, and keep the masks for its strips."""
    scene, masks = strips.scene, strips.folder / MASKS
    if masks.exists():
        return
    unfinished = masks.with_name(f"{MASKS}.{uuid4().hex[:8]}.part")
    unfinished.mkdir(parents=True)
    with closing(scene), Ground(scene, unfinished) as ground:
        if Corrector(scene.materials, scene.stored).peaks.any():
            ground.prepare()
            ground.save(unfinished)
    try:
        unfinished.rename(masks)
    except OSError:
        if not masks.exists():
            raise
        shutil.rmtree(unfinished)  # another process was faster


def correct_strip(strips: Strips, number: int, progress: Progress = silent) -> None:
    """Correct one strip and keep its rasters and sums."""
    scene, part, strip = strips.scene, strips.part(number), strips.blocks[number]
    products = scene.config.output.products
    if publish.is_current(part, strips.key, products):
        progress(strip.height * strip.width)
        return
    with closing(scene), publish.Publication(part) as publication:
        pipeline = Pipeline(scene, publication.folder, strip, strips.folder / MASKS)
        pipeline.run(progress)
        sums = json.dumps(plain_sums(pipeline.sums))
        (publication.folder / SUMS).write_text(sums, encoding="utf-8")
        check_unchanged(scene)
        publication.commit({"key": strips.key, "products": list(products)})


def join(strips: Strips, wall_s: float) -> dict[str, Any]:
    """Publish the scene's folder out of its strips; the content of its report.json."""
    scene, algorithm = strips.scene, strips.scene.config.output.hash
    parts = [strips.part(number) for number in range(len(strips.blocks))]
    with (
        closing(scene),
        publish.EarlyHashes(scene.inputs, algorithm) as hashes,
        publish.Publication(target_of(scene), algorithm=algorithm) as publication,
    ):
        sums = Sums(len(scene.materials), scene.image.bands)
        for part in parts:
            add_sums(sums, json.loads((part / SUMS).read_text(encoding="utf-8")))
        for product in sorted(written_products(scene)):
            files = [publication.folder / f"{product}.{part.name}.tif" for part in parts]
            for part, file in zip(parts, files, strict=True):
                _link(part / f"{product}.tif", file)
            rasters.join_rows(files, publication.folder / f"{product}.vrt")
        if scene.config.output.corrected == "vrt":
            write_corrected_vrt(scene, publication.folder)
        report = finish(scene, publication, hashes, sums, wall_s)
    shutil.rmtree(strips.folder, ignore_errors=True)
    return report


def _link(source: Path, target: Path) -> None:
    """A second name of a file, or a copy where the file system has none; the strip stays until all is published."""
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)


def plain_sums(sums: Sums) -> dict[str, Any]:
    """Sums as JSON has them; nothing is rounded."""
    used = np.flatnonzero(sums.flags)
    return {
        "tally": {name: values.tolist() for name, values in sums.tally._asdict().items()},
        "flags": {str(flags): int(sums.flags[flags]) for flags in used},
        "sigmas": {name: values.tolist() for name, values in sums.sigmas.arrays.items()},
        "skipped": sums.skipped,
        "seconds": sums.seconds,
        "peak_rss_mb": peak_rss_mb(),
    }


def add_sums(total: Sums, part: Mapping[str, Any]) -> None:
    """Add what `plain_sums` gave of a part of a scene."""
    empty = new_tally(len(total.tally.states), total.tally.removed.shape[1])
    tally = {name: np.array(part["tally"][name], values.dtype) for name, values in empty._asdict().items()}
    add_tally(total.tally, empty._replace(**tally))
    for name, sums in total.sigmas.arrays.items():
        np.add(sums, np.array(part["sigmas"][name], sums.dtype), out=sums)
    for flags, pixels in part["flags"].items():
        total.flags[int(flags)] += pixels
    for counts, more in ((total.skipped, part["skipped"]), (total.seconds, part["seconds"])):
        for name, value in more.items():
            counts[name] += value
    total.peak_rss_mb = max(total.peak_rss_mb, part["peak_rss_mb"])
