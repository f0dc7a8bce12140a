"""Where the files that come with cotarget lie."""

from pathlib import Path


def assets_dir() -> Path:
    """The folder sim_assets: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    inside = package / "sim_assets"
    return inside if inside.is_dir() else package.parent / "sim_assets"
