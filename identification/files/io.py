"""Reading and writing whole files; every error names the file, the place in it, and what is allowed."""

import io
import os
import secrets
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, Union

from identification.errors import InputError, require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PathLike = str | os.PathLike[str]
AnyPath = TypeVar("AnyPath", bound=PathLike)
Content: TypeAlias = Union[str, bytes, "Figure", Callable[[], "Figure"]]  # of a file; a picture, or what draws it
PICTURES = (".png", ".svg", ".pdf")  # endings
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
        raise InputError(f"{path}: is not a file name, allowed: the name of an existing file") from None
    require(content.strip(), f"{path}: the file is empty, allowed: a file with content")
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
    try:
        return tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # whole numbers of too many digits, nested too deeply
        raise InputError(f"{path}: not valid TOML: {' '.join(str(error).split())}, allowed: TOML 1.0") from None


def named_file(folder: PathLike, name: str, key: str, whose: str) -> Path:
    """The file that another file in `folder` names under `key`; `whose` says which file that is. Raises `InputError`
    for a name that leads out of the folder, also by a link."""
    path = Path(folder) / name
    try:
        inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    except ValueError:  # a null character
        inside = False
    require(inside, f"{key}: {name!r} is outside the folder of {whose}, allowed: a file beside it or below")
    return path


def write_together(contents: Mapping[AnyPath, Content], force: bool = False) -> None:
    """Writes texts, bytes and pictures, each whole or not at all: all are complete before the first takes its place.
    Raises `InputError` if a file exists and `force` is false, or its folder is missing or not writable."""
    targets: dict[Path, bytes] = {}
    for path, content in contents.items():
        target = check_writable(path, force, picture=not isinstance(content, str | bytes))
        if not isinstance(content, str | bytes):
            buffer, ending = io.BytesIO(), Path(path).suffix.lower().removeprefix(".")
            (content() if callable(content) else content).savefig(buffer, format=ending, dpi=150)
            content = buffer.getvalue()
        # names of files are in texts, and need not be of any encoding
        targets[target] = content.encode(errors="replace") if isinstance(content, str) else content
    staged = {target: target.with_name(f".{secrets.token_hex(8)}.tmp") for target in targets}
    try:
        for target, new in staged.items():
            with open(new, "xb") as stream:
                stream.write(targets[target])
                stream.flush()
                os.fsync(stream.fileno())  # so that a crash leaves the old file or the new one, not an empty one
            if target.exists():
                new.chmod(target.stat().st_mode & 0o777)
        for target in staged:
            require(not target.exists() or force, f"{target}: {EXISTS}")  # another command has written it meanwhile
        for target, new in staged.items():
            os.replace(new, target)
    except OSError as error:
        raise InputError(f"{target}: cannot be written ({error.strerror}), allowed: a writable place") from None
    finally:
        for new in staged.values():
            new.unlink(missing_ok=True)


def check_writable(path: PathLike, force: bool = False, *, picture: bool = False) -> Path:
    """The file that is then written; raises the `InputError` of `write_together` before long work starts, not after it;
    picture : its ending is that of a format"""
    target = Path(os.path.realpath(path))  # a link stays a link: its target is replaced
    folder, ending = str(Path(path).parent), Path(path).suffix
    try:
        os.stat(target)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:  # a name that is too long, links that lead in a circle
        raise InputError(f"{path}: cannot be written ({error.strerror}), allowed: another file name") from None
    for wrong, sentence in (
        (not os.path.isdir(target.parent), f"there is no folder {folder!r}, allowed: a file in an existing folder"),
        (os.path.isdir(target), "is a directory, allowed: a file name"),
        # the pipe behind /dev/stdout has no path
        (os.path.exists(path) and not os.path.isfile(path), "is not a regular file, allowed: a new file name"),
        (not os.access(target.parent, os.W_OK), "the folder cannot be written to, allowed: a writable one"),
        (os.path.exists(target) and not force, EXISTS),
        (picture and ending.lower() not in PICTURES, f"ending {ending!r}, allowed: {', '.join(PICTURES)}"),
    ):
        require(not wrong, f"{path}: {sentence}")
    return target
