"""Check that the tests catch known faults: python tests/check_faults.py [NAME...]

Each entry of faults.toml replaces one text of one file by a wrong one, and names the tests that catch it. This script
copies the project to a temporary folder, applies one fault there, runs the named tests and prints a line:

- caught: a named test fails, by an assertion or by an error that the project's code raises;
- MISSED: the named tests pass;
- NOT APPLIED: the file does not contain the text exactly once, so that the entry needs an update;
- BROKEN: the tests do not run, or fail because the fault is no valid code.

The exit status is 1 if any fault is not caught. A full run takes a minute.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "out")
TESTS_FAILED = 1  # pytest's exit status; 2 to 5 say that it could not run the tests
FAILED = re.compile(r"^(?:FAILED|ERROR) (.+?) - (.*)$", re.MULTILINE)
# A fault that no longer fits the code raises one of these, and then the tests notice nothing of what it stands for.
NO_VALID_CODE = ("ImportError", "ModuleNotFoundError", "SyntaxError", "IndentationError", "NameError", "AttributeError")


def run_tests(folder: Path, tests: list[str]) -> tuple[int, str]:
    """Run tests of the project in a folder; return pytest's exit status and output."""
    command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", "--tb=line", *tests]
    # Two versions of a file may have the same size and time, by which Python knows bytecode: keep none.
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def check(fault: dict, folder: Path) -> tuple[bool, str]:
    """Apply one fault in a copy of the project; return whether it is caught, and what to print."""
    path = folder / fault["file"]
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    if text.count(fault["was"]) != 1:
        return False, f"NOT APPLIED: {fault['file']} contains the `was` text {text.count(fault['was'])} times"
    path.write_text(text.replace(fault["was"], fault["is"]), encoding="utf-8")
    try:
        status, output = run_tests(folder, fault["tests"])
    finally:
        path.write_text(text, encoding="utf-8")
    if status == 0:
        return False, "MISSED: " + " ".join(fault["tests"])
    found = FAILED.search(output)
    if status != TESTS_FAILED or found is None:
        return False, "BROKEN: " + output.strip().splitlines()[-1]
    test, reason = found.groups()
    valid = not reason.startswith(NO_VALID_CODE)
    return valid, f"{'caught' if valid else 'BROKEN'}: {test}: {reason}"


def main(names: list[str]) -> int:
    """Check the named faults, or all; return the exit status."""
    faults = {fault["name"]: fault for fault in tomllib.loads((ROOT / "tests/faults.toml").read_text())["fault"]}
    if unknown := [name for name in names if name not in faults]:
        sys.exit(f"check_faults.py: there is no fault '{unknown[0]}' in faults.toml; there are: {', '.join(faults)}")
    with tempfile.TemporaryDirectory(prefix="cotarget-faults-") as temporary:
        folder = Path(shutil.copytree(ROOT, Path(temporary) / "project", ignore=NOT_COPIED))
        results = []
        for name in names or faults:
            caught, said = check(faults[name], folder)
            results.append(caught)
            print(f"{name}: {said}", flush=True)
    print(f"{sum(results)} of {len(results)} faults are caught")
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
