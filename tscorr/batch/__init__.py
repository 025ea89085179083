"""Many scenes: plan all, then correct them, small ones side by side; resume what is done, go on where one fails.

`planning` checks all scenes before work starts, `lock` keeps a second batch out of the output folder, `local` corrects
the scenes on this machine, `cluster` has the workers of a Dask cluster do the `tasks`, `overview` writes what stands
at the top of the folder, `runner` puts them together, and `outcome` is what comes back.
"""

from tscorr.batch.outcome import BatchResult, SceneOutcome, SceneProgress, silent_scene
from tscorr.batch.planning import library_of, plan
from tscorr.batch.runner import run

__all__ = ["BatchResult", "SceneOutcome", "SceneProgress", "library_of", "plan", "run", "silent_scene"]
