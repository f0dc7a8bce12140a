"""Numbers of the source are found by name, and changed where a module is loaded."""

import ast
import subprocess
import sys

import pytest

from experiments.following.numbers import all_numbers, changed, numbers_of


def test_constants_fields_and_entries_of_tables_are_numbers():
    source = """
A, B = 3 / 640, "text"
SIZE = (32, 24)
ON, _HIDDEN = True, 5.0
@dataclass
class S:
    gate: float = 16.3
TABLE = {"auto": {"score": 0.5}, "motion": A}
"""
    assert [each.name for each in numbers_of("", ast.parse(source))] == [
        "A", "SIZE", "S.gate", "TABLE['auto']['score']",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("value", "times", "expected"),
    [(2.0, 1.5, 3.0), (2.0, 0.5, 1.0), (3, 1.1, 4), (3, 0.9, 2), (1, 0.5, 1), ((10, 1.0), 2.0, (20, 2.0))],
)
def test_a_whole_number_changes_by_one_at_least(value, times, expected):
    assert changed(value, times) == expected


def test_a_number_is_changed_where_its_module_is_loaded_and_all_that_is_computed_from_it():
    """AFTER_CUT_S of the finder is an entry of AGES_S, another module's."""
    (ages,) = (each for each in all_numbers() if each.name == "AGES_S")
    read = "from cotarget.detection.small_target import finder, change; print(*change.AGES_S, finder.AFTER_CUT_S)"
    change = f"from experiments.following.numbers import change_when_loaded as c; c({ages.path!r}, 'AGES_S', 2.0); "
    before, after = (
        [float(word) for word in subprocess.check_output([sys.executable, "-c", code], text=True).split()]
        for code in (read, change + read)
    )
    assert after == [2 * each for each in before]
