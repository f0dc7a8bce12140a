"""cotarget follow --page: the demo, the stop file of a simulation, and what is refused."""

import json
import re
import threading
from types import SimpleNamespace

import pytest

from cotarget.cli.page_run import announcement, paced
from cotarget.page.server import LOOPBACK, listen
from cotarget.pipeline import HeadRun
from tests.support.commands import call, refused
from tests.support.page_client import browser, picture, say, status, until

DEADLINE_S = 60.0  # a busy machine draws slowly


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("option", [("--page-port", 0), ("--page-host", "localhost")])
def test_options_of_the_page_need_a_page(folder, capsys, option):
    assert "needs --page" in refused(capsys, "follow", *option)


def test_a_port_that_is_taken_costs_one_line(folder, capsys):
    with listen(LOOPBACK, 0) as taken:
        said = refused_after_remark(capsys, "--page-port", taken.getsockname()[1])
    assert "--page-port" in said


@pytest.mark.parametrize(("address", "warns"), [("127.0.0.1", False), ("::1", False), ("192.0.2.1", True)])
def test_beyond_loopback_it_says_that_others_can_read_and_names_the_tunnel(address, warns):
    lines = announcement("http://rig:8081/#token", "follow", "rig", address, 8081)
    assert lines[0] == "open http://rig:8081/#token"
    assert any("no encryption" in line and "ssh -L 8081:127.0.0.1:8081 rig" in line for line in lines) == warns


def test_a_demo_without_its_target_is_refused(folder, capsys):
    assert "bird" in refused(capsys, "follow", "--page", "--target", "dragon")


def test_a_stop_survives_a_restart(folder, capsys):
    (folder / "rig.stop").write_text("a hand in the gears\n")
    said = refused_after_remark(capsys, "--page-port", 0)
    assert "a hand in the gears" in said
    assert "rig.stop" in said


@pytest.mark.parametrize("text", [None, 'backend = "sim"'], ids=["without rig.toml", "simulation"])
def test_what_a_refused_restart_names_clears_the_stop(folder, capsys, text):
    """A simulation has a stop file only by its page, and that of the demo has no rig.toml beside it."""
    if text is not None:
        (folder / "rig.toml").write_text(text)
    assert "rig.toml: " in refused(capsys, "clear", "--rig", "rig.toml")
    (folder / "rig.stop").write_text("a hand in the gears\n")
    assert call(capsys, "clear", "--rig", "rig.toml") == (0, "cleared: a hand in the gears\n", "")
    assert not (folder / "rig.stop").exists()


def refused_after_remark(capsys, *options):
    status, out, err = call(capsys, "follow", "--page", *options)
    assert (status, out) == (1, "")
    remark, line = err.splitlines()
    assert "simulated bird" in remark
    return line


def at_link(links):
    """What a browser needs, once the link is there."""
    until(lambda: links, DEADLINE_S)
    port, token = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/#(.+)", links[0]).groups()
    return SimpleNamespace(port=int(port), page=SimpleNamespace(token=token))


def steered(capsys, monkeypatch, steer, *options):
    """Status and stdout of a run that a thread steers, and that ends with it."""
    steering = threading.Thread(target=steer)

    def while_steered(steps, *pace):
        for step in paced(steps, *pace):
            yield step
            if not steering.is_alive():
                return

    monkeypatch.setattr("cotarget.cli.page_run.paced", while_steered)
    steering.start()
    code, out, _ = call(capsys, "follow", "--page", "--page-port", 0, *options)
    steering.join()
    return code, out


@pytest.mark.render
@pytest.mark.wire
def test_the_demo_needs_no_file_and_is_steered_from_the_page(folder, capsys, monkeypatch):
    """A browser that stops it: the file is there, the run goes on standing."""
    links, done = [], []
    monkeypatch.setattr("cotarget.cli.page_run.PageRun._announce", lambda self, link, unattended: links.append(link))

    def steer():
        with browser(at_link(links)) as mine:
            say(mine, do="take")
            status(mine, lambda message: message["control"] == "you")
            table, jpegs = picture(mine, DEADLINE_S)
            assert table["heads"]["head"]["state"] == "standing"
            assert set(jpegs) == {"fixed", "zoom"}
            say(mine, do="stop")
            status(mine, lambda message: message["stopped"] is not None)
            until((folder / "rig.stop").exists)  # which is written after the head is halted
            done.append((folder / "rig.stop").read_text())
            status(mine)

    code, out = steered(capsys, monkeypatch, steer, "--record", "run")
    assert code == 0
    assert done == ["stopped from the page\n"]
    assert set(json.loads(out)["states"]) >= {"standing"}
    log = (folder / "run" / "log.jsonl").read_text()
    assert '"order": "stop"' in log
    assert links[0].partition("#")[2] not in log  # nor the token
    assert links[0].partition("#")[2] not in (folder / "run" / "recording.json").read_text()
    assert call(capsys, "replay", "run", "--check")[0] == 0


@pytest.mark.render
@pytest.mark.wire
def test_a_recording_that_begins_in_the_middle_replays(folder, capsys, monkeypatch):
    links, seen = [], []
    monkeypatch.setattr("cotarget.cli.page_run.PageRun._announce", lambda self, link, unattended: links.append(link))

    def steer():
        with browser(at_link(links)) as mine:
            say(mine, do="take")
            status(mine, lambda message: message["control"] == "you")
            say(mine, do="follow", of="head")
            for on in (True, False, True):
                say(mine, do="record", on=on)
                seen.append(status(mine, lambda message: bool(message["recording"]) == on)["recording"])  # noqa: B023
                for _ in range(3):  # some steps of it
                    say(mine, do="drawn", n=0)
                    assert picture(mine, DEADLINE_S)

    code, _ = steered(capsys, monkeypatch, steer)
    assert code == 0
    assert seen == ["recording", "", "recording-2"]
    for name in ("recording", "recording-2"):
        code, out, err = call(capsys, "replay", name, "--check")
        assert code == 0, err
        assert json.loads(out)["steps"] >= 2
        lines = (folder / name / "log.jsonl").read_text().splitlines()
        assert json.loads(lines[-1])["end"] == "complete"


@pytest.mark.render
def test_a_ctrl_c_in_the_middle_of_a_step_is_the_end_of_its_recording(folder, capsys, monkeypatch):
    monkeypatch.setattr("cotarget.cli.page_run.PageRun._announce", lambda self, link, unattended: None)
    rest, calls = HeadRun.rest, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return rest(self)

    monkeypatch.setattr(HeadRun, "rest", interrupted)
    assert call(capsys, "follow", "--page", "--page-port", 0, "--record", "run")[0] == 0
    monkeypatch.setattr(HeadRun, "rest", rest)
    assert json.loads((folder / "run" / "log.jsonl").read_text().splitlines()[-1])["end"] == "KeyboardInterrupt"
    assert call(capsys, "replay", "run", "--check")[0] == 0
