"""What became of a batch and of its scenes."""

import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tscorr.scene.plan import Scene
from tscorr.scene.run import silent

SceneProgress = Callable[[Scene], Callable[[int], None]]
"""given a scene that starts, a function that is told of pixels done"""


def silent_scene(scene: Scene) -> Callable[[int], None]:
    """Progress that nobody watches."""
    del scene
    return silent


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """What became of one scene: `done`, `current` (nothing had to be done) or `failed`."""

    name: str
    state: str
    folder: Path
    error: str = ""
    packed_report: bytes = field(default=b"", repr=False)
    """report.json, compressed: a batch holds those of all its scenes"""

    @classmethod
    def of(cls, name: str, state: str, folder: Path, report: Mapping[str, Any]) -> "SceneOutcome":
        """The outcome of a scene that has a report."""
        return cls(name, state, folder, packed_report=zlib.compress(json.dumps(report).encode(), 1))

    @property
    def report(self) -> dict[str, Any] | None:
        """The content of report.json, a copy at each call; None where the scene failed."""
        return json.loads(zlib.decompress(self.packed_report)) if self.packed_report else None


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The outcomes of a batch, in the order of the configuration."""

    folder: Path
    scenes: tuple[SceneOutcome, ...] = field(default_factory=tuple)

    @property
    def exit_code(self) -> int:
        """0 all done, 1 some scenes failed, 3 all failed."""
        failed = [scene for scene in self.scenes if scene.state == "failed"]
        return 0 if not failed else 3 if len(failed) == len(self.scenes) else 1
