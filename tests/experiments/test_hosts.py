"""A sweep by workers on two hosts, which are network namespaces of this machine, found by name."""

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.command import main
from tests.support.tiny_experiments import KNOWN, pids

ROOT = Path(__file__).parents[2]
HOSTS = {"cotarget-lab": "10.211.7.1", "cotarget-one": "10.211.7.2", "cotarget-two": "10.211.7.3"}
BRIDGE = "cotarget-br"
DEADLINE_S = 120.0
CLIENT = "from tests.support.tiny_experiments import KNOWN; from experiments.command import main; main({}, KNOWN)"


def ip(*words):
    subprocess.run(["ip", *words], check=True, capture_output=True)


@pytest.fixture
def hosts():
    """Three hosts on one network, each of which knows the others' names."""
    if os.geteuid() or shutil.which("ip") is None:
        pytest.skip("network namespaces need ip and root")
    folders = [Path("/etc/netns") / name for name in HOSTS]
    with contextlib.ExitStack() as undo:
        try:
            ip("link", "add", BRIDGE, "type", "bridge")
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no network may be made here: {error.stderr.decode().strip()}")
        undo.callback(ip, "link", "del", BRIDGE)
        ip("link", "set", BRIDGE, "up")
        for number, (folder, (name, address)) in enumerate(zip(folders, HOSTS.items(), strict=True)):
            ip("netns", "add", name)
            undo.callback(ip, "netns", "del", name)
            ip("link", "add", f"cotarget{number}", "type", "veth", "peer", "name", "eth0", "netns", name)
            ip("link", "set", f"cotarget{number}", "master", BRIDGE, "up")
            ip("-n", name, "addr", "add", f"{address}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
            ip("-n", name, "link", "set", "lo", "up")
            folder.mkdir(parents=True)
            undo.callback(shutil.rmtree, folder)
            (folder / "hosts").write_text("".join(f"{to} {of}\n" for of, to in HOSTS.items()) + "127.0.0.1 localhost\n")
        yield


@contextlib.contextmanager
def on(host, *command):
    """Run a program on a host during the block."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        ["ip", "netns", "exec", host, sys.executable, *command],
        cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.terminate()


@pytest.mark.slow
def test_workers_on_two_hosts_give_the_same_rows(hosts, tmp_path):
    address = "tcp://cotarget-lab:8786"
    settings = ["--set", f"tiny.notes='{tmp_path}'", "--seeds", "12"]
    command = ["tiny", *settings, "--scheduler", address, "--out", str(tmp_path / "hosts")]
    with contextlib.ExitStack() as running:
        running.enter_context(on("cotarget-lab", "-m", "distributed.cli.dask_scheduler", "--no-dashboard"))
        for host in ("cotarget-one", "cotarget-two"):
            worker = ("-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard")
            running.enter_context(on(host, *worker, "--host", host))
        waiting = f"from distributed import Client; Client({address!r}, timeout=60).wait_for_workers(2, 60)"
        client = running.enter_context(on("cotarget-lab", "-c", f"{waiting}; {CLIENT.format(command)}"))
        client.wait(DEADLINE_S)
    assert len(pids(tmp_path)) == 2
    assert main(["tiny", *settings, "--processes", "1", "--out", str(tmp_path / "here")], KNOWN, tmp_path) == 0
    (ours,), (theirs,) = ((tmp_path / out).glob("tiny*/rows.csv") for out in ("here", "hosts"))
    assert ours.read_bytes() == theirs.read_bytes()
