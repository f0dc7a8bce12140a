"""What the project says of itself is the same everywhere."""

import re
import tomllib
from pathlib import Path

import cotarget

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_version_licence_and_authors_are_the_same_everywhere():
    cited = dict(re.findall(r"^([a-z-]+): (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE))
    assert PROJECT["version"] == cotarget.__version__ == cited["version"]
    assert PROJECT["license"] == cited["license"] == "Apache-2.0"
    assert f"name: {PROJECT['authors'][0]['name']}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert PROJECT["license-files"] == ["LICENSE"]
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").split()[:4] == ["Apache", "License", "Version", "2.0,"]
    assert "Apache-2.0" in (ROOT / "sim_assets" / "SOURCES.md").read_text(encoding="utf-8")
