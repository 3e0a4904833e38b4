"""Where a page comes from: the files it was made of with their hashes, versions, seed and command."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from doe.report.page import Section, Sheet
from identification.files.io import read_bytes, read_toml

PACKAGES = ("armcal", "numpy", "scipy", "casadi")


@dataclass(frozen=True)
class Origin:
    """command : as it was typed;  seed : of all that is random;  files : that were read"""

    command: str
    seed: int
    files: Sequence[Path]


def with_parts(paths: Iterable[Path]) -> list[Path]:
    """The files, each once, and the URDF files that arm files among them name."""
    found = dict.fromkeys(paths)
    for path in list(found):
        urdf = read_toml(path).get("urdf") if path.suffix == ".toml" else None
        if isinstance(urdf, str) and not urdf.lstrip().startswith("<"):
            found[path.parent / urdf] = None
    return list(found)


def hashes(paths: Sequence[Path]) -> list[tuple[str, int, str]]:
    """Name, size and SHA-256 of each file."""
    contents = ((path, read_bytes(path)) for path in paths)
    return [(str(path), len(content), hashlib.sha256(content).hexdigest()) for path, content in contents]


def origin_section(origin: Origin) -> Section:
    """The last part of a page."""
    files = [[name, str(size), digest] for name, size, digest in hashes(with_parts(origin.files))]
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    facts = [["command", origin.command], ["seed", str(origin.seed)]]
    facts.append(["versions", f"{versions}, Python {platform.python_version()}"])
    sheets = [Sheet(["file", "bytes", "SHA-256"], files), Sheet(["", ""], facts)]
    return Section("Where this page comes from", "", sheets)
