"""The page docs/topics.md, made from the topic table: ``python -m echolume_messages.topics_page > docs/topics.md``."""

from __future__ import annotations

import sys

import numpy as np

from echolume_messages.topics import SHARDS, TOPICS, Topic


def _kind(dtype: np.dtype[np.generic]) -> str:
    return ", ".join(f"{name} {kind[0].str}" for name, kind in (dtype.fields or {}).items())


def _row(topic: Topic) -> str:
    shape = "(" + ", ".join("n" if s is None else str(s) for s in topic.shape) + ")"
    flags = ["yes" if flag else "no" for flag in (topic.recorded, topic.triggered)]
    cells = [f"`{topic.name}`", shape, f"{topic.rate_hz:g}", *flags, topic.about]
    return "| " + " | ".join(cells) + " |"


def page() -> str:
    """The topic table as Markdown."""
    structured = [t for t in TOPICS if t.dtype.names is not None]
    lines = [
        "# What is on the bus",
        "",
        "Made from `messages/echolume_messages/topics.py`; a test keeps both equal.",
        "",
        "Keys are `echolume/v1/<rig>/data/<service>/<stream>`; triggered streams end in one more chunk, "
        f"trigger mod {SHARDS}.",
        "Payloads are NPY 1.0 bytes, the attachment is a JSON header. Flat `uint8` streams hold JSON text.",
        "",
        "| stream | shape | nominal Hz | recorded | triggered | what |",
        "|---|---|---|---|---|---|",
        *(_row(t) for t in TOPICS),
        "",
        "## Structured types",
        "",
        *(f"- `{t.name}`: `{_kind(t.dtype)}`" for t in structured),
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.stdout.write(page())
