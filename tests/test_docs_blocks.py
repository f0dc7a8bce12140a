"""The Python and shell blocks of README and tutorials run as they are written.

The blocks of a page run in order, in one temporary folder and one Python namespace. In an HTML comment on the line
before a block, `file: NAME` makes it a file that is there from the beginning, and `no-run: REASON` leaves it out.
"""

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = (
    ROOT / "README.md",
    *sorted((ROOT / "docs" / "tutorials").glob("*.md")),
    *(ROOT / "docs" / f"{name}.md" for name in ("calibration", "drivers", "environments", "targets-and-scenes")),
)
BLOCK = re.compile(r"^(?:<!-- ([^\n]*?) -->\n)?```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SECONDS = 240  # for one shell block


def blocks_of(page):
    """(mark, language, text) of each fenced block."""
    return [(found[1] or "", found[2], found[3]) for found in BLOCK.finditer(page.read_text(encoding="utf-8"))]


@pytest.fixture
def shells():
    """Process groups of a page's shell blocks; what is left of them is ended with the page, passed or not."""
    started = []
    yield started
    for group in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, signal.SIGTERM)


def run_shell(text, folder, shells):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    # The package's checkout, so that `python -m experiments` is found.
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
    shell = subprocess.Popen(
        ["bash", "-euo", "pipefail", "-c", text],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    shells.append(shell.pid)
    output, _ = shell.communicate(timeout=SECONDS)
    assert shell.returncode == 0, f"{text}\n{output}"


def test_there_are_blocks_to_run():
    runnable = [block for page in PAGES for block in blocks_of(page) if block[1] in ("python", "sh") and not block[0]]
    assert len(runnable) >= 8


@pytest.mark.docs
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_run(page, tmp_path, monkeypatch, shells):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    names = {"__name__": "__main__"}
    blocks = blocks_of(page)
    for mark, _, text in blocks:
        if mark.startswith("file: "):
            (tmp_path / mark.removeprefix("file: ")).write_text(text, encoding="utf-8")
    for mark, language, text in blocks:
        if mark:
            continue
        if language == "python":
            exec(compile(text, f"{page.name}: a block of Python", "exec"), names)
        elif language == "sh":
            run_shell(text, tmp_path, shells)
