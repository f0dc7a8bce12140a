"""The documentation names what there is; `mkdocs build --strict` checks the links within it."""

import pkgutil
import re
import runpy
import sys
import types
from pathlib import Path

import pytest

from experiments.engine import experiment_of, pictured

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))


def exists(name):
    """Whether a dotted name is a module or leads to something in one."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_name_exists(page):
    text = page.read_text(encoding="utf-8")
    names = set(re.findall(r"`(cotarget(?:\.\w+)+)", text))
    names |= {f"cotarget.{name}" for name in re.findall(r"\bct\.(\w+)", text)}
    assert [name for name in sorted(names) if not exists(name)] == []


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md"])
def test_every_linked_file_exists(page):
    links = re.findall(r"\]\(([^)#\s]+)", (ROOT / page).read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (ROOT / link).exists()] == []


def test_the_experiment_that_the_documentation_adds_runs(monkeypatch):
    text = (ROOT / "docs/experiments.md").read_text(encoding="utf-8")
    (block,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "SETTINGS = " in block)
    module = types.ModuleType("rounding")
    monkeypatch.setitem(sys.modules, "rounding", module)  # dataclasses look there
    exec(block, module.__dict__)
    experiment = experiment_of(module)
    rows = [row for seed in experiment.quick.numbers for row in pictured(experiment.one(experiment.quick, seed)).rows]
    assert experiment.missed(experiment.summarise(rows)) == []


@pytest.mark.docs  # it needs the packages of the docs build
def test_reference_is_as_the_code_is_and_lists_options_keys_and_the_end_of_help():
    """`python docs/make_reference.py` writes both pages anew; versions of Python break usage lines differently."""
    pages = runpy.run_path(str(ROOT / "docs/make_reference.py"))["pages"]()
    keys, commands = pages.values()
    for page, text in pages.items():
        assert page.read_text("utf-8").split() == text.split()
    assert "| `--placements N` | with --rig: number of board placements" in commands
    assert "exit status: 0 the target was followed" in commands
    assert "faults: head.silence" in commands
    assert "| `watchdog_s` | number | s | `0.35` | > 0.04 and ≤ 60 |" in keys
