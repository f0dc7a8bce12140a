"""Names that users' files and scripts hold keep their spelling: keys, options, exit statuses, ids: tests/formats."""

import contextlib
import dataclasses
import fnmatch
import inspect
import itertools
import json
import re
import signal
import socket
import sys
import threading
import tomllib
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import cotarget
import experiments
from cotarget.backends import load_config
from cotarget.cli.main import main
from cotarget.config import config_table, parse_config
from cotarget.control.policy import TASK_FEATURES
from cotarget.drivers import DRIVERS
from cotarget.drivers.board import BoardSettings, make_board
from cotarget.drivers.rig import board_settings, devices
from cotarget.env import SchedulingPolicy
from cotarget.env.common import RIG_FEATURES
from cotarget.env.follow import TRACK_FEATURES
from cotarget.env.schedule import CANDIDATE_FEATURES
from cotarget.env.schedule_v1 import SLOT_FEATURES
from cotarget.errors import ConfigError
from cotarget.geometry import pose
from cotarget.schema import as_table
from cotarget.sim.world import SimWorld
from tests.formats.lists import (
    DEADLINE_S,
    KEYS,
    OLD,
    RIG_TOML,
    TABLES,
    UNKNOWN,
    assert_listed,
    command_lines,
    copy_old,
    keys_in,
    last_list,
    leaves,
    listed,
    parser_of,
    program,
    read,
    run,
    statuses,
    subcommands,
)


@pytest.mark.parametrize("line", listed("reserved.txt"))
def test_no_listed_name_takes_a_reserved_one(line):
    name, _, reserved = line.partition(": ")
    assert not fnmatch.filter(listed(name), reserved)


@pytest.fixture
def old(tmp_path, monkeypatch):
    return copy_old(tmp_path, monkeypatch)


# --- rig.toml ---
def refusal(tmp_path, text):
    """The error of a rig.toml."""
    path = tmp_path / "refused.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    return str(caught.value)


@pytest.mark.parametrize("table", TABLES)
def test_a_table_of_rig_toml_has_the_listed_keys(table, tmp_path):
    head = f"[{table}]\n" if table else ""
    message = refusal(tmp_path, f"{head}{UNKNOWN} = 1\n")
    depth = table.count(".") + 1 if table else 0
    here = {".".join(key.split(".")[: depth + 1]) for key in KEYS if not table or key.startswith(f"{table}.")}
    if not table:  # `targets` is a table of tables
        assert "targets" in here
    begins = f"{table}." if table else ""
    found = {f"{begins}{name}" for name in last_list(message)}
    gone, new = sorted(here - found), sorted(found - here)
    assert not gone, f"rig.toml does not know {gone} any more: users' files hold them; keep them as aliases"
    assert not new, f"rig.toml knows {new}: if they are added on purpose, write them into tests/formats/rig_toml.txt"


def same_default(text, value):
    """Whether a default is the listed one; angles are kept in radians, and rounded by that."""
    if text == "none" or value is None:
        return (text == "none") == (value is None)
    wanted = json.loads(text)
    is_vector = isinstance(value, list) and value and isinstance(value[0], int | float)
    return wanted == pytest.approx(value, rel=1e-12) if is_vector else wanted == value


def test_rig_toml_defaults_to_what_is_listed():
    config = parse_config({})
    table, found = config_table(config), devices(config.hardware)
    table["hardware"] = {name: {"driver": next(iter(DRIVERS[name]))} | as_table(found[name].settings) for name in found}
    table["hardware"]["board"] = as_table(board_settings(config.hardware))
    table["follow"] = as_table(config.follow)  # a recording has one key of it
    for key, default, _ in RIG_TOML:
        value = table
        for part in key.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if key.endswith(".template") and value is not None:
            value = Path(value).name
        if key == "sim.effects.all":
            continue  # stands for all others
        assert same_default(default, value), f"{key} is by default {json.dumps(value)}, not {default} as listed"


@pytest.mark.parametrize(("key", "names"), [(key, names) for key, _, names in RIG_TOML if names])
def test_a_key_of_rig_toml_has_the_listed_choices(key, names, tmp_path):
    table, _, name = key.rpartition(".")
    wrong = "1" if name == "baud" else '"?"'
    message = refusal(tmp_path, f"[{table}]\n{name} = {wrong}\n" if table else f"{name} = {wrong}\n")
    found = re.findall(r"'([^'?]+)'", message.partition(" should be ")[2]) or last_list(message)
    assert sorted(found) == sorted(names), f"{key} has other choices than tests/formats/rig_toml.txt"


def test_v010_rig_files_name_every_key():
    found = set()
    for path in OLD.glob("rig_*.toml"):
        found |= keys_in(tomllib.loads(path.read_text(encoding="utf-8")))
    free = ("sim.models.", "sim.paths.", "hardware.zoom.settings.")  # whose keys are names
    found = {next((start[:-1] for start in free if key.startswith(start)), key) for key in found}
    found = {re.sub(r"^targets\.\w+\.", "targets.book.", key) for key in found}
    newer = {
        "targets.book.shape",
        "targets.book.network",
        "hardware.fixed.password_env",
        "follow.target",
        "follow.calibration",
        "follow.ignored",
        "follow.when_idle",
        "follow.idle_s",
        "follow.unattended",
        *(f"hardware.{name}.driver" for name in DRIVERS),
    }
    assert {re.sub(r"^targets\.\w+\.", "targets.book.", key) for key in KEYS} - newer == found


def test_config_prints_every_listed_key_with_its_default(capsys):
    assert main(["config"]) == 0
    text = capsys.readouterr().out
    printed = keys_in(tomllib.loads(re.sub(r"^#(\w+) = .*$", r"\1 = 0", text, flags=re.MULTILINE)))
    whole = r"(sim\.T_\w+|targets\.\w+\.network)\.\w+$"  # tables in one line
    assert printed == {re.sub(whole, r"\1", key) for key in KEYS} - {"sim.effects.all"}
    is_set = re.sub(r"^#(\w+ = (?!\.\.\.|\[[a-z]).*)$", r"\1", text, flags=re.MULTILINE)
    assert "\nseed = 0\n" in is_set
    default = dict(leaves(config_table(parse_config({}))))
    for each in (text, is_set):
        found = dict(leaves({**config_table(config := parse_config(tomllib.loads(each))), "hardware": {}}))
        for key, value in default.items():
            assert same_default(json.dumps(value), found[key]), key
        assert devices(config.hardware) == devices(parse_config({}).hardware)


# --- rig.toml of v0.1.0 ---
FILES = ("sim.scene", "sim.models.dog", "safety.stop_file", "targets.book.template")  # relative to the rig.toml


def assert_loaded(name, table, found):
    """Every key of a file has the value there that it has in the file."""
    found = dict(leaves(found))
    for key, value in leaves(table):
        value = str(OLD / value) if key in FILES else value
        assert same_default(json.dumps(value), found[key]), f"{name}: {key} is {found[key]}, and not {value}"


def test_v010_simulated_rig_loads():
    table, config = tomllib.loads((OLD / "rig_sim.toml").read_text()), load_config(OLD / "rig_sim.toml")
    assert config.safety.stop_file == OLD / table["safety"].pop("stop_file")
    del table["sim"]["effects"]["all"]  # all others are named
    assert_loaded("rig_sim.toml", table, config_table(config))
    assert config.target("person2") == config.target("person")
    assert (config.target("person").size, config.target("dog").shape) == (1.75, None)


def test_v010_scene_and_model_make_a_world():
    config = load_config(OLD / "rig_sim.toml")
    only_dog = dataclasses.replace(config, sim=dataclasses.replace(config.sim, targets=("dog",)))
    world = SimWorld(only_dog, rendered=())
    with world.rig as rig:
        assert rig.fixed.size == (320, 240)
        # The fixed camera stands at (0, 0, 1.6) m and looks along the world's y.
        assert world.truth().T_world_fixed.translation == pytest.approx([0, 0, 1.6])
        assert world.truth().T_world_fixed.rotation.apply([0, 0, 1]) == pytest.approx([0, 1, 0], abs=1e-9)


def test_v010_hardware_rigs_load():
    for name in ("rig_hardware.toml", "rig_hardware_network.toml"):
        table, config = tomllib.loads((OLD / name).read_text()), load_config(OLD / name)
        found = {each: as_table(device.settings) for each, device in devices(config.hardware).items()}
        found["board"] = as_table(board_settings(config.hardware))
        assert_loaded(name, table.pop("hardware"), found)
        assert_loaded(name, {key: table[key] for key in ("backend", "board")}, config_table(config))


# --- commands ---
def test_the_commands_have_the_listed_options(monkeypatch):
    parser = parser_of(main, monkeypatch)
    lines = list(command_lines("cotarget", parser))
    for name, command in subcommands(parser).items():
        lines += command_lines(f"cotarget {name}", command)
    assert_listed("commands.txt", lines, begins="cotarget")


# --- exit statuses ---
def test_a_command_ends_with_the_listed_status(old, capsys):
    assert main(["stop", "--rig", "rig_recording.toml"]) == statuses()["a command has done what was asked"]
    assert main(["point", "--rig", "rig_recording.toml"]) == statuses()["a device, or the rig, fails"]
    assert main(["point", "--rig", "no.toml"]) == statuses()["a file is wrong or missing"]
    with pytest.raises(SystemExit) as ended:
        main(["point", "--no-such-option"])
    assert ended.value.code == statuses()["an argument is wrong"]
    log = old / "recording" / "log.jsonl"
    other = re.sub(r'("head.move", "at": [0-9.]+, "args": \[)[-0-9.]+', r"\g<1>0.1", log.read_text(), count=1)
    log.write_text(other)
    assert main(["replay", "recording"]) == 0
    differs = statuses()["replay --check finds other commands than were recorded"]
    assert main(["replay", "recording", "--check"]) == differs


@pytest.mark.parametrize("what", ["SIGHUP", "Ctrl-C", "SIGTERM"])
def test_a_signal_ends_a_command_with_the_listed_status(what, old):
    with program([sys.executable, "-m", "cotarget.cli", "reset-head", "--rig", "rig_hardware.toml"], old) as process:
        assert "yes" in process.stdout.readline()  # it asks, and waits for an answer
        process.send_signal(signal.SIGINT if what == "Ctrl-C" else signal.Signals[what])
        process.communicate(timeout=DEADLINE_S)
    assert process.returncode == statuses()[what]


# --- what commands print and write ---
@pytest.mark.render
def test_point_prints_and_writes_what_is_listed(old, capsys):
    Path("taken").mkdir()
    for _ in range(2):
        arguments = ["--pan-deg", 5, "--focal-mm", 8, "--pictures", "taken"]
        now = run(capsys, "point", "--rig", "rig_recording.toml", *arguments)
    assert_listed("printed.txt", {f"point: {key}" for key in keys_in(now)}, begins="point:")
    assert now["pan_deg"] == pytest.approx(5, abs=0.0514286)  # a step of the head
    there = run(capsys, "home", "--rig", "rig_recording.toml")
    assert (there["pan_deg"], there["tilt_deg"]) == (0.0, 0.0)
    assert_listed("printed.txt", {f"home: {key}" for key in keys_in(there)}, begins="home:")
    found = run(capsys, "where", "--rig", "rig_recording.toml")
    assert_listed("printed.txt", {f"where: {key}" for key in keys_in(found)}, begins="where:")
    assert_listed("files.txt", {f"point --pictures: {path.name}" for path in Path("taken").iterdir()}, begins="point")


def test_the_keys_that_latency_printed_are_those_of_rig_toml():
    found = keys_in(read(OLD / "printed" / "latency.json"))
    wanted = {line.removeprefix("latency: ") for line in listed("printed.txt") if line.startswith("latency: ")}
    assert found <= wanted
    assert {key.removeprefix("measured.") for key in wanted if key.startswith("measured.")} <= set(KEYS)


def test_the_report_of_a_calibration_writes_what_is_listed(old, capsys):
    """Of a calibration without a head, which cannot point, and has fewer pictures."""
    assert main(["report", "calibration_photos.json", "--out", "page.html"]) == 0
    assert Path("page.html").is_file()
    found = {f"report: {path.name}" for path in Path("page_pictures").iterdir()}
    assert found == {f"report: {name}.png" for name in ("coverage", "histogram", "residuals", "situation")}
    assert found < set(listed("files.txt"))


# --- emulated devices, and programs that hold the board ---
def ask(address, *questions):
    """Send JSON objects to a socket, one a line; the answers."""
    host, _, port = address.removeprefix("socket://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as line, line.makefile("rw") as file:
        for question in questions:
            file.write(json.dumps(question) + "\n")
            file.flush()
            yield json.loads(file.readline())


T_JSON = {"translation": [0.0, 0.0, 3.0], "rotvec_deg": [0.0, 0.0, 0.0]}


@pytest.mark.render
@pytest.mark.wire
def test_the_emulator_writes_and_answers_what_is_listed(old):
    command = [sys.executable, "-m", "cotarget.cli", "emulate", "--rig", "rig_captures.toml", "--write", "rig.toml"]
    with program(command, old) as process:
        lines = [process.stdout.readline().split(maxsplit=1) for _ in range(7)]
        address = {name: rest.strip() for name, rest in lines[:6]}
        truth, *others = ask(
            address["control"],
            {"truth": True},
            {"fault": "head.silence", "on": True},
            {"fault": "head.silence", "on": False},
        )
        board = list(ask(address["board"], {"present": T_JSON}, {"swing": T_JSON}, {"present": None}, {"wave": None}))
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=DEADLINE_S)
    assert process.returncode == statuses()["emulate ends by Ctrl-C"]
    assert_listed("emulation.txt", {f"printed {name}" for name in address}, begins="printed ")
    assert_listed("emulation.txt", {f"truth {key}" for key in keys_in(truth)}, begins="truth ")
    assert others == [{"ok": True}] * 2
    assert board[:3] == [{"ok": True}] * 3
    assert set(board[3]) == {"error"}
    config = load_config(old / "rig.toml")  # and unknown keys are refused
    assert config.hardware.board["presenter"] == address["board"]
    assert config.hardware.zoom["port"] == address["zoom"]
    assert config.hardware.fixed["url"] == address["fixed"].removesuffix("/mjpg/video.mjpg")
    assert address["head"] == f"{config.hardware.head['port']} and {address['head'].split()[-1]}"


@pytest.mark.parametrize(("device", "begins", "options"), [
    ("head", "fault", []), ("fixed", "fault", []), ("zoom", "fault", []), ("fixed", "rtsp", ["--fixed", "rtsp"]),
    ("ptz", "onvif", ["--ptz", "onvif"]), ("ptz", "visca", ["--ptz", "visca"]),
])  # fmt: skip
def test_the_emulated_devices_have_the_listed_faults(device, begins, options, tmp_path, capsys):
    assert main(["emulate", "--write", str(tmp_path / "rig.toml"), "--fault", f"{device}.{UNKNOWN}", *options]) == 1
    names = last_list(capsys.readouterr().err.strip())
    begins = f"{begins} {device}."
    assert_listed("emulation.txt", {f"{begins}{name}" for name in names}, begins=begins)


def test_board_presenter_gets_the_listed_requests():
    said = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def hold():
            connection, _ = server.accept()
            with connection, connection.makefile("rw") as file:
                for line in file:
                    said.append(json.loads(line))
                    file.write('{"ok": true}\n')
                    file.flush()

        holder = threading.Thread(target=hold)
        holder.start()
        presenter = f"socket://127.0.0.1:{server.getsockname()[1]}"
        board = make_board(BoardSettings(presenter))
        board.present(pose([0.5, -0.25, 2.0], [0.0, 0.0, 90.0]))
        board.swing(pose([0.0, 0.0, 3.0], [0.0, 0.0, 0.0]))
        board.present(None)
        board.close()
        holder.join(timeout=DEADLINE_S)
    assert said[0].keys() == {"present"}
    assert said[0]["present"].keys() == T_JSON.keys()
    assert said[0]["present"]["translation"] == pytest.approx([0.5, -0.25, 2.0])
    assert said[0]["present"]["rotvec_deg"] == pytest.approx([0.0, 0.0, 90.0])
    assert said[1:] == [{"swing": T_JSON}, {"present": None}]


# --- environments ---
FOLLOW, FOLLOW_V1 = "cotarget/Follow-v0", "cotarget/Follow-v1"
SCHEDULE, SCHEDULE_V1 = "cotarget/Schedule-v0", "cotarget/Schedule-v1"


def span(space, where, names=None):
    """Lines for a space: the range of each number, with its name where it has one."""
    if isinstance(space, gymnasium.spaces.Dict):
        for key, part in space.items():
            yield from span(part, f"{where}.{key}", names)
    elif isinstance(space, gymnasium.spaces.Discrete):
        yield f"{where} Discrete {space.n}, from {space.start}"
    elif len(space.shape) == 1:
        named = (names or {}).get(where.rpartition(".")[2]) or itertools.repeat("")
        for number, (low, high, name) in enumerate(zip(space.low, space.high, named, strict=False)):
            yield f"{where}[{number}] {low:g} to {high:g} {name}".rstrip()
    elif len(space.shape) == 2:
        assert (space.low == space.low[0]).all()
        assert (space.high == space.high[0]).all()
        row = gymnasium.spaces.Box(space.low[0], space.high[0], dtype=space.dtype)
        yield f"{where} {space.shape[0]} rows of {space.shape[1]}"
        yield from span(row, f"{where}[]", names)
    else:
        yield f"{where} {space.shape} {space.low.min()} to {space.high.max()}"
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) != 2:
        yield f"{where} {space.dtype}"


def kind_of(value):
    array = np.asarray(value)
    return f"{array.dtype}{list(array.shape) if array.shape else ''}"


def default_of(parameter):
    value = parameter.default
    return dataclasses.astuple(value) if dataclasses.is_dataclass(value) else value


FEATURES = {
    FOLLOW: {f"{FOLLOW} observation": [*TRACK_FEATURES, *RIG_FEATURES], "rig": [*RIG_FEATURES]},
    FOLLOW_V1: {f"{FOLLOW_V1} observation": [*TASK_FEATURES], "rig": [*RIG_FEATURES], "tracks": [*TASK_FEATURES]},
    SCHEDULE: {"tracks[]": [*CANDIDATE_FEATURES], "rig": [*RIG_FEATURES]},
    SCHEDULE_V1: {"tracks[]": [*SLOT_FEATURES], "rig": [*RIG_FEATURES]},
}


@pytest.mark.parametrize("name", [FOLLOW, FOLLOW_V1, SCHEDULE, SCHEDULE_V1])
def test_an_environment_is_as_listed(name):
    with contextlib.closing(gymnasium.make(f"cotarget.env:{name}")) as env:
        lines = [
            f"{name} argument {key} = {default_of(parameter)}"
            for key, parameter in inspect.signature(type(env.unwrapped)).parameters.items()
        ]
        observation, info = env.reset(seed=3)
        assert env.observation_space.contains(observation)
        action = 0 if name in (SCHEDULE, SCHEDULE_V1) else np.zeros(3, np.float32)
        _, reward, terminated, truncated, after = env.step(action)
        assert (type(reward), terminated, truncated) == (float, False, False)
        assert info.keys() == after.keys()
        lines += span(env.action_space, f"{name} action")
        lines += span(env.observation_space, f"{name} observation", FEATURES[name])
        lines += [f"{name} info.{key} {kind_of(value)}" for key, value in info.items()]
        lines += [f"{name} metadata.{key} = {value}" for key, value in env.metadata.items()]
        if name == SCHEDULE:
            with pytest.raises(ConfigError) as caught:
                SchedulingPolicy(env, UNKNOWN)
            assert_listed("policies.txt", last_list(str(caught.value)))
    with contextlib.closing(
        gymnasium.make(name, observation="both" if name in (FOLLOW_V1, SCHEDULE_V1) else "images")
    ) as env:
        lines += span(env.observation_space, f"{name} images", FEATURES[name])
    assert_listed("environments.txt", lines, begins=name)


def test_policies_of_commands_are_listed():
    (line,) = [line for line in listed("commands.txt") if line.startswith("cotarget follow --policy")]
    assert_listed("policies.txt", line[line.index("{") + 1 : line.index("}")].split(", "))


# --- environment variables ---
def test_environment_variables_are_listed():
    """Of this project's own all are listed; of others those that it reads."""
    found = {"COTARGET_AHEAD"}  # has no effect any more
    for folder in (Path(cotarget.__file__).parent, Path(experiments.__file__).parent):
        for path in folder.rglob("*.py"):
            found |= set(re.findall('"([A-Z]+_[A-Z_]+)"', path.read_text(encoding="utf-8")))
    own = {name for name in found if name.startswith("COTARGET_")}
    assert_listed("environment_variables.txt", own, begins="COTARGET_")
    assert set(listed("environment_variables.txt")) <= found
