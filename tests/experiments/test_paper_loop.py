"""The paper's own way to follow, and experiments on a rig of one's own."""

import json
import pickle
from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest

from cotarget.config import parse_config
from cotarget.errors import ConfigError
from cotarget.evaluation import TruthDetector, TruthNoise, true_calibration
from cotarget.pantilt import shortcut
from cotarget.pipeline import FollowSettings
from cotarget.sim.world import SimWorld
from experiments.calibration import pointing
from experiments.command import choose
from experiments.engine import identity, known_experiments
from experiments.following.field import calibrated
from experiments.paper import fig4_book, table2_table3
from experiments.paper.paper_loop import follow_as_the_paper


@pytest.fixture(scope="module")
def run():
    """A person who walks past 10 m away, seen exactly; what was known of the rig, and all Steps."""
    sim = {
        "scene": "indoor",
        "targets": ["person"],
        "effects": {"axes": False, "steps": False, "optics": False, "lens": False, "scatter": False},
        "paths": {"person": [[0, -3, 10, 0.875], [1, -3, 10, 0.875], [5, 3, 10, 0.875], [9, 3, 10, 0.875]]},
    }
    config = parse_config({"sim": sim})
    world = SimWorld(config, rendered=())
    detector = TruthDetector(world.truth(), 0, TruthNoise(0.0, 0.0, 0.0))
    known, how = true_calibration(world), FollowSettings()
    with world.rig as rig:
        steps = list(follow_as_the_paper(rig, known, config.target("person"), detector, seconds=6.0, settings=how))
    return known, steps


def test_the_papers_way_aims_by_its_shortcut_at_where_the_target_was_seen(run):
    known, steps = run
    aimed = [step for step in steps if step.aim is not None]
    assert len(aimed) > 3
    for step in aimed:
        np.testing.assert_allclose(known.fixed.project(step.aim.x_fixed), step.target.box.center_px, atol=1e-6)
        by_hand = shortcut(step.aim.x_fixed, known.zoom_head.T_zoom0_fixed, known.zoom_head.hand_eye(), "table")
        assert (step.aim.pan, step.aim.tilt) == pytest.approx((float(by_hand.pan), float(by_hand.tilt)))
        assert step.commanded[:2] == pytest.approx((step.aim.pan, step.aim.tilt))


def test_the_papers_way_sends_one_command_at_a_time(run):
    """None while head or lens moves, nor before the last command has begun to be done."""
    _, steps = run
    aimed = [step for step in steps if step.aim is not None]
    assert not any(step.head.moving or step.lens.moving for step in aimed)
    assert any(step.head.moving for step in steps)
    assert np.diff([step.t for step in aimed]).min() > 0.04 + 0.04  # the delay of commands, and a frame
    assert [step.head_commands for step in aimed] == list(range(1, len(aimed) + 1))
    assert steps[-1].head_commands == len(aimed)


# ---------------------------------------------------------------- a rig of one's own
@pytest.fixture
def own(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(
        "[sim]\nscene = 'outdoor'\ntargets = ['bird']\nT_zoom0_fixed = "
        "{ translation = [-0.8, 0.1, 0.2], rotvec_deg = [1, 6, 2] }\n[sim.fixed]\nfocal_px = [600, 601]\n"
    )
    return path


def test_an_experiment_is_tried_with_a_rig_of_ones_own(own):
    for module in (fig4_book, pointing, table2_table3):
        name = module.__name__.rpartition(".")[2]
        given = Namespace(names=[name], set=[f"{name}.rig={own}"], quick=True, seeds=None, seed_base=None)
        (case,) = choose(known_experiments(), given)
        config = case.settings.config("indoor", ("book",), 7)
        assert (config.sim.scene, config.sim.targets, config.sim.seed) == ("indoor", ("book",), 7)
        assert config.sim.T_zoom0_fixed.translation.tolist() == [-0.8, 0.1, 0.2]
        assert config.sim.fixed.focal_px == (600, 601)
        assert json.loads(identity(case))["settings"]["rig_toml"] == own.read_text()


def test_a_worker_has_the_rig_as_it_was_read_wherever_it_is(tmp_path, own, monkeypatch):
    """Also while the file is changed meanwhile, or where it is not to be found."""
    own.write_text(own.read_text() + "[targets.book]\ntemplate = 'book.png'\n", encoding="utf-8-sig")
    monkeypatch.chdir(tmp_path)
    settings = replace(fig4_book.SETTINGS, rig="rig.toml", calibrated=False)
    sent = pickle.dumps(settings)
    own.write_text("[sim.fixed]\nfocal_px = [500, 500]\n")
    assert replace(settings, rig_toml="") != settings  # results of another rig in the same file are told apart
    own.unlink()
    (elsewhere := tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(elsewhere)
    settings = pickle.loads(sent)
    config = settings.config("indoor", ("book",), 7)
    assert config.sim.fixed.focal_px == (600, 601)
    assert config.target("book").template == tmp_path / "book.png"
    assert calibrated(settings).fixed.lens.focal_px == (600, 601)


def test_wrong_rigs_are_refused_in_one_line(tmp_path, own):
    with pytest.raises(ConfigError, match="no such file"):
        pointing.Settings(rig=str(tmp_path / "none.toml"))
    with pytest.raises(ConfigError, match="is not what rig = '' says"):
        pointing.Settings(rig_toml="[sim]")
    own.write_text("backend = 'replay'\nrecording = '.'\n")
    with pytest.raises(ConfigError, match="backend = 'replay' cannot be tried here"):
        pointing.Settings(rig=str(own))
