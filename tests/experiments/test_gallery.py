"""The documentation's pictures: copied from results, all or none, and all of them shown."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from experiments.paper.gallery import PICTURES, SHOWN, WIDEST_PX, main

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def results(tmp_path):
    """A folder as a full run leaves it, of grey pictures."""
    for each in SHOWN:
        path = tmp_path / "results" / each.experiment / f"{each.picture}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((900, 2 * WIDEST_PX, 3), 127, np.uint8))
    return tmp_path / "results"


def test_each_picture_is_taken_at_the_width_of_a_page(results, tmp_path, capsys):
    assert main(["--results", str(results), "--out", str(tmp_path / "out")]) == 0
    written = sorted((tmp_path / "out").iterdir())
    assert [path.stem for path in written] == sorted(each.name for each in SHOWN)
    assert {cv2.imread(str(path)).shape for path in written} == {(450, WIDEST_PX, 3)}
    assert len(capsys.readouterr().out.splitlines()) == len(written)


def test_the_results_page_shows_them_all_and_no_other():
    page = ROOT / "docs" / "results.md"
    shown = re.findall(r"\]\((pictures/\S+\.jpg)\)", page.read_text(encoding="utf-8"))
    assert sorted(page.parent / path for path in shown) == sorted(PICTURES / f"{each.name}.jpg" for each in SHOWN)
    assert all((page.parent / path).is_file() for path in shown)
