"""Write a page on how far a calibration can be trusted: `cotarget report calibration.json --out report.html`."""

import argparse
from pathlib import Path

from cotarget.cli.common import add_file, add_insist, check_outputs, load_plausible
from cotarget.files import behind_link


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    add_file(parser, "calibration", "calibration.json")
    add_file(parser, "--out", "file to write (report.html)", "PAGE", default=Path("report.html"))
    add_insist(parser)


def run(options: argparse.Namespace) -> None:
    """Write the report page of a calibration."""
    from cotarget.report.page import write_report

    check_outputs([options.out], [options.calibration])
    calibration = load_plausible(options.calibration, insist=options.insist)
    page = behind_link(options.out)
    print(write_report(page, calibration, options.calibration.name).text)
    print(f"the page is {page}, and its pictures are in {page.stem}_pictures beside it")
