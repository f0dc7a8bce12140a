"""Make the pages: one file each, of a layout that they share, under a policy that lets nothing else in."""

import base64
import hashlib
import re
from pathlib import Path

from jinja2 import Environment, FileSystemLoader


def render(name: str) -> str:
    """Render a page of this folder with the style, the markup and the drawing of layout.html."""
    # No value is filled in, so that there is nothing to escape.
    return Environment(loader=FileSystemLoader(Path(__file__).parent), trim_blocks=True).get_template(name).render()


def policy(page: str) -> str:
    """Make the Content-Security-Policy of a page: its own script and style by hash, and nothing else."""

    def hashes(tag: str) -> str:
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in texts)
        return " ".join(f"'sha256-{each}'" for each in digests)

    return (
        f"default-src 'none'; script-src {hashes('script')}; style-src {hashes('style')}; base-uri 'none'; "
        "form-action 'none'"
    )
