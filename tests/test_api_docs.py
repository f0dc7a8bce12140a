"""The documentation that is built from the docstrings."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
COMMAND = re.search(r"pdoc (.*) -o (\S+) cotarget\b", (ROOT / "README.md").read_text(encoding="utf-8"))


def test_it_is_built_where_git_does_not_look():
    assert COMMAND is not None
    assert f"/{COMMAND[2]}/" in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()


@pytest.mark.slow
def test_it_is_built_without_a_warning(tmp_path):
    pytest.importorskip("pdoc")
    assert COMMAND is not None
    run = [sys.executable, "-m", "pdoc", *COMMAND[1].split(), "-o", str(tmp_path), "cotarget"]
    built = subprocess.run(run, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (built.returncode, built.stdout, built.stderr) == (0, "", "")
    front = (tmp_path / "cotarget.html").read_text(encoding="utf-8")
    assert "cotarget/pipeline.html#follow" in front  # names in docstrings are links
    loop = (tmp_path / "cotarget" / "loop.html").read_text(encoding="utf-8")
    assert re.search(r"<h6[^>]*>Arguments:</h6>", loop)  # Google's sections are sections
