"""The README as a package index shows it: a hook of the build.

A package index has no access to pictures and pages of the tree, and the project has no URL yet: pictures are
removed, and links into the tree become plain text.
"""

from __future__ import annotations

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

_PICTURE_BLOCK = re.compile(r"<!-- picture -->.*?<!-- /picture -->\n*", re.DOTALL)
_COMMENT = re.compile(r"<!--.*?-->\n?", re.DOTALL)
_PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)|<(?:img|picture|video|source)\b")
_LINK = re.compile(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(((?!https?://)[^)\s]*)\)")
_CLOSING = """
The pages that are named here, and the pictures, are in the source distribution.
"""


def long_description(readme: str) -> str:
    """A README without pictures and without links into the tree."""
    text = _COMMENT.sub("", _PICTURE_BLOCK.sub("", readme))
    paragraphs = re.split(r"\n{2,}", text)
    kept = [
        _LINK.sub(r"\1", part) if "```" not in part else part
        for part in paragraphs
        if not _PICTURE.search(part)
    ]
    return "\n\n".join(kept).rstrip() + "\n" + _CLOSING


class Hook(MetadataHookInterface):
    """Build hook that sets the long description."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, object]) -> None:
        """Set `readme`, which `pyproject.toml` calls dynamic."""
        readme = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {"content-type": "text/markdown", "text": long_description(readme)}
