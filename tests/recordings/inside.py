"""Everything that a recording says, in one text: files are compressed, so their bytes tell nothing."""

from __future__ import annotations

from pathlib import Path

__all__ = ["everything"]


def everything(path: Path) -> str:
    """All values of all chunks, those of the layout included."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    said = []
    for store in (*reader.recordings(), *reader.blueprints()):
        said.append(repr(store))
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            said.append(f"{chunk.entity_path} {batch.schema.names} {batch.to_pylist()}")
    return "\n".join(said)
