"""The documentation names what there is, and the blocks of README and tutorials run as they are written.

The blocks of a page run in order, in one temporary folder and one Python namespace. In an HTML comment on the line
before a block, `file: NAME` makes it a file that is there from the beginning, and `no-run: REASON` leaves it out.
"""

import contextlib
import io
import os
import pkgutil
import re
import runpy
import signal
import subprocess
import sys
import types
from argparse import Namespace
from contextlib import redirect_stdout
from pathlib import Path

import pytest

from cotarget import cli
from cotarget.backends import load_config
from cotarget.sim.world import SimWorld
from experiments.command import choose, main
from experiments.engine import experiment_of, known_experiments, pictured
from tests.support.target_models import BOX

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


EXAMPLE = "rounding"  # the experiment that docs/experiments.md adds
HISTORY = ("upgrading.md", "CHANGELOG.md")  # these name what there was
ALL_PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in ALL_PAGES if page.name not in HISTORY)
# `cotarget NAME ... --option ...` up to where a line of code or of a shell ends.
COMMANDS = re.findall(r"(?<![\w/.-])cotarget ([a-z-]+)((?: [^`\n|#]*)?)", TEXT)
# `python -m experiments[.name] ...`, of which one line of code follows the other.
EXPERIMENTS = re.findall(r"python -m experiments((?:\.[a-z_]+)*)((?: (?:(?!python -m)[^`#\n])*)?)(?=[`#\n])", TEXT)


def asked(*arguments):
    """What a command's --help says."""
    with redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as ended:
        cli.main([*arguments, "--help"])
    assert ended.value.code == 0
    return out.getvalue()


def known(text):
    return set(re.findall(r"^    ([a-z-]+)", text, re.MULTILINE))


@pytest.fixture(scope="module")
def helps():
    existing = known(asked())
    return {name: asked(name) for name in sorted({name for name, _ in COMMANDS} & existing)}


def test_commands_and_their_options_exist(helps):
    for name, rest in COMMANDS:
        if name not in helps:
            assert not rest.strip().startswith("--"), name  # prose, such as "cotarget makes the two cooperate"
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest):
            assert option in helps[name], f"cotarget {name} {option}"


def test_experiments_and_their_options_exist():
    assert len(EXPERIMENTS) > 8
    known_names = known_experiments()
    with pytest.raises(SystemExit), redirect_stdout(io.StringIO()) as said:
        main(["--help"])
    for module, rest in EXPERIMENTS:
        if module:
            assert module.rpartition(".")[2] in {*known_names, "gallery", "teaser", "train", "score", EXAMPLE}
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", rest):
            assert option in said.getvalue(), f"python -m experiments {option}"
        names = [word for word in re.findall(r"^ ([a-z][a-z0-9_ ]+)(?= |$)", rest) for word in word.split()]
        names = [name for name in names if name != EXAMPLE]
        changes = re.findall(r"--set '?([^\s']+=[^\s']+)", rest)
        assert choose(known_names, Namespace(names=names, set=changes, quick=False, seeds=None, seed_base=None))


def test_every_command_is_documented(helps):
    assert known(asked()) <= set(helps)


def section(page, heading):
    """A section of a page."""
    (found,) = re.findall(rf"^## {heading}\n(.*?)^## ", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return found


def test_the_readmes_figures_are_those_of_the_results():
    shown, measured = (
        set(re.findall(r"\d[\d.]*", "\n".join(re.findall(r"^\|.*", section(ROOT / page, heading), re.MULTILINE))))
        for page, heading in (("README.md", "How well it does"), ("docs/results.md", "Summary"))
    )
    assert len(shown) > 10
    assert shown <= measured


def file_of(page, name):
    """The block that a page marks as a file."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    (found,) = re.findall(rf"<!-- file: {re.escape(name)} -->\n```\w+\n(.*?)```", text, re.DOTALL)
    return found


def test_own_target_and_scene_of_the_docs_appear(tmp_path):
    for name in ("rig.toml", "yard.xml"):
        (tmp_path / name).write_text(file_of("targets-and-scenes.md", name))
    (tmp_path / "dog.obj").write_text(BOX)
    world = SimWorld(load_config(tmp_path / "rig.toml"), rendered=())
    truth = world.truth()
    assert not 0 <= truth.center_px("dog", "fixed", 4.0)[0] < 640  # while the background is learnt
    assert truth.silhouette("dog", "fixed", 9.0).visible == 1.0
    world.close()


# The longest first, so that one process has it and another the rest.
PAGES_WITH_BLOCKS = (
    *sorted((ROOT / "docs" / "tutorials").glob("*.md"), key=lambda page: (page.stem != "cameras", page.stem)),
    *(ROOT / "docs" / f"{name}.md" for name in ("calibration", "drivers", "environments", "targets-and-scenes")),
    ROOT / "README.md",
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
    runnable = [
        block
        for page in PAGES_WITH_BLOCKS
        for block in blocks_of(page)
        if block[1] in ("python", "sh") and not block[0]
    ]
    assert len(runnable) >= 8


@pytest.mark.docs
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", PAGES_WITH_BLOCKS, ids=lambda page: page.stem)
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
