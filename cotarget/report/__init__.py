"""The report on a calibration: one page that tells whether to trust it; `cotarget.report.page` writes it."""

from cotarget.report.text import verdict

__all__ = ["verdict"]
