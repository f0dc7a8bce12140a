"""Calibration report: an HTML page on how well a calibration points; `cotarget.report.page` writes it."""
