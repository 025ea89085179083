"""Draw what is left of the glare in the nadir view of Delft: `python tests/benchmarks/remaining_error.py`.

Run `tscorr run configs/delft.toml` first. Writes samples/delft/remaining_error.png.
"""

from pathlib import Path

import numpy as np
import rasterio
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tscorr import PixelFlag

ROOT = Path(__file__).parent.parent.parent
SAMPLE, RESULT = ROOT / "samples" / "delft", ROOT / "out" / "delft" / "nadir"
NOTABLE = 0.02


def read(path):
    with rasterio.open(path) as dataset:
        return dataset.read()


def main():
    image, corrected = read(SAMPLE / "nadir.tif") * 1e-4, read(RESULT / "corrected.tif") * 1e-4
    truth, sunlit = read(SAMPLE / "truth" / "diffuse_nadir.tif"), read(SAMPLE / "truth" / "shadow.tif")[0] == 1
    flags = read(RESULT / "flags.tif")[0]
    valid = sunlit & (image > 0).all(axis=0) & (image < 0.9).all(axis=0)
    error = np.where(valid, np.abs(corrected - truth).max(axis=0), 0)

    figure = Figure(figsize=(10, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.imshow(0.4 + 0.5 * np.clip(4 * corrected[1], 0, 1), cmap="gray", vmin=0, vmax=1)
    row, col = np.nonzero(error > NOTABLE)
    flagged = (flags[row, col] & PixelFlag.NORMAL_UNRELIABLE) > 0
    axes.scatter(col, row, c=flagged, cmap="coolwarm", s=6 + 60 * error[row, col])
    axes.set_title(f"Left wrong by more than {NOTABLE} (red: flagged NORMAL_UNRELIABLE; size: error)", fontsize=9)
    axes.set_axis_off()
    figure.savefig(SAMPLE / "remaining_error.png", dpi=100)


if __name__ == "__main__":
    main()
