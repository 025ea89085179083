"""Another interpreter, for what this process should not hold or do itself."""

import os
import sys
from typing import Any


def another(module: str) -> dict[str, Any]:
    """What `subprocess` needs to run a module in an interpreter that finds the same packages as this one."""
    path = os.pathsep.join(folder or os.curdir for folder in sys.path)
    return {"args": [sys.executable, "-P", "-m", module], "env": {**os.environ, "PYTHONPATH": path}}
