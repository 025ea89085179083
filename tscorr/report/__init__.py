"""The report of a scene: where the glare is, how wide, how it would move.

`facts` is what a run hands in, `totals` makes the stable keys of report.json of it, `words` says them in
plain sentences, `plots` draws them and `layout` puts one self-contained page together. `overview` is the page of
a batch.
"""

from tscorr.report.facts import SceneFacts
from tscorr.report.layout import page
from tscorr.report.overview import Difference, Overlap, SceneLine, batch_page
from tscorr.report.totals import summary, write_json

__all__ = [
    "Difference",
    "Overlap",
    "SceneFacts",
    "SceneLine",
    "batch_page",
    "page",
    "summary",
    "write_json",
]
