"""File formats: arm, measurements, targets; read with error messages that say where, written whole or not at all."""

from importlib.resources import files


def formats() -> str:
    """The page on file formats and JSON keys (README.md of this package), in Markdown."""
    return files(__name__).joinpath("README.md").read_text(encoding="utf-8")
