"""What a run of a study has found, as its file keeps it."""

from typing import Any

Record = dict[str, Any]


def outcome(record: Record) -> Record:
    """Whether a record that was made is one of a refusal, and why."""
    refused = record["refused"]
    return {"status": "done" if refused is None else "refused", "reason": refused or ""}
