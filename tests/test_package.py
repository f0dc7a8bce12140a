"""What the project says of itself is the same everywhere."""

import ast
import graphlib
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

import cotarget
from cotarget.errors import install_extra

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


@pytest.mark.parametrize("extra", ["hardware", "onnx", "experiments"])
def test_an_extra_is_installed_by_what_it_needs(extra):
    """No index has cotarget, and `pip` alone may be another Python's."""
    words = shlex.split(install_extra(extra))
    assert words[:4] == [sys.executable, "-m", "pip", "install"]
    assert sorted(words[4:]) == sorted(PROJECT["optional-dependencies"][extra]) != []


def test_version_licence_and_authors_are_the_same_everywhere():
    cited = dict(re.findall(r"^([a-z-]+): (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE))
    assert PROJECT["version"] == cotarget.__version__ == cited["version"]
    assert PROJECT["license"] == cited["license"] == "Apache-2.0"
    assert f"name: {PROJECT['authors'][0]['name']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert PROJECT["license-files"] == ["LICENSE"]
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").split()[:4] == ["Apache", "License", "Version", "2.0,"]
    assert "Apache-2.0" in (ROOT / "sim_assets" / "SOURCES.md").read_text(encoding="utf-8")


def imports_of(path, modules):
    """The project's modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            wanted = {f"{node.module}.{alias.name}" for alias in node.names} & modules.keys()
            yield from wanted or {node.module} & modules.keys()


def test_no_modules_import_each_other_in_a_circle():
    """Not even inside a function, or for types alone; a package is what its __init__ imports."""
    paths = [path for folder in ("cotarget", "experiments", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in paths}
    imported = {name: set(imports_of(path, modules)) for name, path in modules.items()}
    order = list(graphlib.TopologicalSorter(imported).static_order())  # a circle raises CycleError
    assert order.index("experiments.tables") < order.index("experiments.engine")
    assert len(order) == len(modules) > 100
