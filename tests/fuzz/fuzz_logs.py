"""Coverage-guided fuzzing of one reader with atheris, where it is installed.

Run ``python tests/fuzz/fuzz_logs.py dataflash -max_total_time=600``; the options are libFuzzer's. A file that
breaks a promise is left as ``crash-...`` in the working directory.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMPILED = ("logparsers.telemetry.frames", "logparsers.ulog.messages")  # numba cannot compile what atheris instruments


def main() -> None:
    """Fuzz the format that the first argument names."""
    import atheris

    sys.path.insert(0, str(ROOT))
    with atheris.instrument_imports(include=["logparsers"], exclude=list(COMPILED)):
        from tests.fuzz.harness import SEEDS, outcome
        from tests.fuzz.mutate import mutated

    kind = sys.argv.pop(1) if len(sys.argv) > 1 else ""
    if kind not in SEEDS:
        sys.exit(f"which format? one of {', '.join(SEEDS)}")
    outcome(SEEDS[kind])  # compiles: not to be counted as a slow input

    def read(content: bytes) -> None:
        outcome(content)

    def mutate(content: bytes, most: int, seed: int) -> bytes:
        """One time in four as the seeded tests do, which know what these files are made of."""
        rng = random.Random(seed)  # noqa: S311 - a seed, not a secret
        broken = mutated(rng, content) if content and rng.random() < 0.25 else atheris.Mutate(content, most)
        return bytes(broken[:most])

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / kind).write_bytes(SEEDS[kind])
        options = ["-timeout=20", "-rss_limit_mb=2048", "-max_len=20000"]
        atheris.Setup([sys.argv[0], *options, *sys.argv[1:], folder], read, custom_mutator=mutate)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
