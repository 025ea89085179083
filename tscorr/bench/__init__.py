"""Run time against error: every way in which the program evaluates the lobe, on this machine.

`bench` measures, `table` and `plot` show, `broken_promises` judges; `draw_figures` draws the figures of the paper.
"""

from tscorr.bench.figures import draw_figures
from tscorr.bench.output import plot, table
from tscorr.bench.run import bench, broken_promises

__all__ = ["bench", "broken_promises", "draw_figures", "plot", "table"]
