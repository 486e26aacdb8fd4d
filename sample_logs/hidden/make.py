"""Make the logs with hidden effects anew, byte for byte, from the sealed truth: ``python make.py [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent.parent / "benchmarks"))  # the generator is a part of the benchmarks

from hidden_logs import TRUTH, make  # noqa: E402

if __name__ == "__main__":
    for path in make(HERE / TRUTH, Path(sys.argv[1]) if len(sys.argv) > 1 else HERE):
        print(path)
