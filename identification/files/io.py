"""Reading and writing whole files; every error names the file, the place in it, and what is allowed."""

from __future__ import annotations

import io
import os
import re
import secrets
import shutil
import sys
import tomllib
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, Union

from identification.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PathLike = str | os.PathLike[str]
AnyPath = TypeVar("AnyPath", bound=PathLike)
Content: TypeAlias = Union[str, bytes, "Figure", Callable[[], "Figure"]]  # of a file; a picture, or what draws it
PARTS = 100  # of a dotted key; the library keeps every prefix of one, so that its memory grows with their square
# Each part is looked at once from each of the `PARTS` before it; from inside a word or a text no search begins.
_PART = r"""(?:[A-Za-z0-9_-]++|"(?:\\.|[^"\\\n])*+"|'[^'\n]*+')"""
TOO_LONG_KEY = re.compile(rf"(?<![\w\\-])(?:{_PART}[ \t]*+\.[ \t]*+){{{PARTS}}}")
EXISTS = "the file exists, allowed: a new file name, or --force to replace it"


def read_bytes(path: PathLike) -> bytes:
    """The whole file. Raises `InputError` for a missing file, a directory, an unreadable or an empty file."""
    try:
        if Path(path).is_block_device() or Path(path).is_char_device():  # /dev/zero never ends
            raise InputError(f"{path}: is a device, allowed: a file")
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file, allowed: the name of an existing file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a directory, allowed: a file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), allowed: a readable file") from None
    except ValueError:  # a null character
        raise InputError(f"{path}: is no name of a file, allowed: the name of an existing file") from None
    if not content.strip():
        raise InputError(f"{path}: the file is empty, allowed: a file with content")
    return content


def decode(path: PathLike, content: bytes) -> str:
    """`content` of `path` as text, line ends kept, a byte-order mark dropped; raises `InputError` if not UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = f"byte 0x{content[error.start]:02x} on line {line}"
        raise InputError(f"{path}: not a text file in UTF-8: found {byte}, allowed: UTF-8") from None


def read_text(path: PathLike) -> str:
    """The text of a UTF-8 file; raises `InputError` as `read_bytes` and `decode` do."""
    return decode(path, read_bytes(path))


def read_toml(path: PathLike) -> dict[str, Any]:
    """The tables of a TOML file. Raises `InputError` as `read_text` does; a syntax error has line and column."""
    text, allowed = read_text(path), "TOML 1.0"
    if key := TOO_LONG_KEY.search(text):
        line, allowed = text.count("\n", 0, key.start()) + 1, "TOML 1.0, less nested"
        reason = f"line {line} has a key of more than {PARTS} parts"
    else:
        try:
            return tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            reason = " ".join(str(error).split())
        except ValueError:  # as Python says it of its own limit
            reason = f"a whole number of more than {sys.get_int_max_str_digits()} digits"
        except RecursionError:
            reason, allowed = "nested too deeply", "TOML 1.0, less nested"
    raise InputError(f"{path}: not valid TOML: {reason}, allowed: {allowed}")


def named_file(folder: PathLike, name: str, key: str, whose: str) -> Path:
    """The file that another file in `folder` names under `key`; `whose` says which file that is.

    Raises `InputError` for a name that leads out of the folder, also by a link.
    """
    path = Path(folder) / name
    try:
        inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except ValueError:  # a null character
        inside = False
    if not inside:
        raise InputError(f"{key}: {name!r} is outside the folder of {whose}, allowed: a file beside it or below")
    return path


def write_together(contents: Mapping[AnyPath, Content], force: bool = False) -> None:
    """Writes texts, bytes and pictures, all files or none: every one is complete beside its target before the first
    target is touched, and if a later one cannot take its place the earlier ones are put back.

    Raises `InputError` if a file exists and `force` is false, or its folder is missing or not writable.
    """
    targets = {_checked_target(path, force): _in_bytes(path, content) for path, content in contents.items()}
    try:
        with ExitStack() as temporary, ExitStack() as undo:

            def beside(target: Path) -> Path:
                path = target.with_name(f".{secrets.token_hex(8)}.tmp")
                temporary.callback(path.unlink, missing_ok=True)
                return path

            staged = {target: beside(target) for target in targets}
            for target, new in staged.items():
                _write_new(new, targets[target], mode_of=target)
            for target, new in staged.items():
                if target.exists() and not force:  # another command has written it meanwhile
                    raise FileExistsError
                if not target.exists():
                    undo.callback(target.unlink, missing_ok=True)
                elif len(targets) > 1:
                    undo.callback(os.replace, shutil.copy2(target, beside(target)), target)
                os.replace(new, target)
            undo.pop_all()
    except FileExistsError:
        raise InputError(f"{target}: {EXISTS}") from None
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}), allowed: a writable place") from None


def check_writable(path: PathLike | None, force: bool = False, *, picture: bool = False) -> None:
    """Raises the `InputError` of `write_together` before long work starts, not after it. None: nothing to write."""
    if path is not None:
        _checked_target(path, force)
        if picture:
            _picture_format(path)


def _picture_format(path: PathLike) -> str:
    """The format of a picture. Raises `InputError` for a name whose ending is no format."""
    if (ending := Path(path).suffix).lower() not in (".png", ".svg", ".pdf"):
        raise InputError(f"{path}: ending {ending!r}, allowed: .png, .svg, .pdf")
    return ending.lower().removeprefix(".")


def _in_bytes(path: PathLike, content: Content) -> bytes:
    if isinstance(content, str | bytes):
        return content.encode() if isinstance(content, str) else content
    picture, buffer = _picture_format(path), io.BytesIO()
    (content() if callable(content) else content).savefig(buffer, format=picture, dpi=150)
    return buffer.getvalue()


def _checked_target(path: PathLike, force: bool) -> Path:
    target = Path(os.path.realpath(path))  # a link stays a link: its target is replaced
    try:
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:  # a name that is too long, links that lead in a circle
        raise InputError(f"{path}: cannot be written ({error.strerror}), allowed: another file name") from None
    folder = str(Path(path).parent)
    for wrong, sentence in (
        (not target.parent.is_dir(), f"there is no folder {folder!r}, allowed: a file in an existing folder"),
        (target.is_dir(), "is a directory, allowed: a file name"),
        # the pipe behind /dev/stdout has no path
        (os.path.exists(path) and not os.path.isfile(path), "is not a regular file, allowed: a new file name"),
        (not os.access(target.parent, os.W_OK), "the folder cannot be written to, allowed: a writable one"),
        (target.exists() and not force, EXISTS),
    ):
        if wrong:
            raise InputError(f"{path}: {sentence}")
    return target


def _write_new(path: Path, content: bytes, mode_of: Path) -> None:
    """A complete file of a new name; by way of a file without one, of which a killed process leaves nothing, where the
    system has such files."""
    descriptors, unnamed = "/proc/self/fd", None
    if hasattr(os, "O_TMPFILE") and os.path.isdir(descriptors):
        with suppress(OSError):
            unnamed = os.open(path.parent, os.O_TMPFILE | os.O_WRONLY, 0o666)
    with open(path, "xb") if unnamed is None else open(unnamed, "wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())  # so that a crash leaves the old file or the new one, not an empty one
        if unnamed is not None:
            os.link(f"{descriptors}/{unnamed}", path, src_dir_fd=unnamed)  # else Python links the link
    if mode_of.exists():
        path.chmod(mode_of.stat().st_mode & 0o777)
