"""The documentation names what there is."""

import pkgutil
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted(path for path in DOCS.rglob("*.md") if path.name != "upgrading.md")  # which lists what there was


def exists(name):
    """Whether a dotted name is a module or leads to something in one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_name_exists(page):
    names = set(re.findall(r"`(cotarget(?:\.\w+)+)", page.read_text(encoding="utf-8")))
    assert [name for name in sorted(names) if not exists(name)] == []
