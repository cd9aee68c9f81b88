"""Files that are either complete or absent."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchvo360.checks import InputError


@contextmanager
def atomic_path(final: str | Path) -> Iterator[Path]:
    """Yield a temporary path to write to, which gets the final name on success and is removed on failure.

    It lies in the final file's folder, so that the renaming is one step, and has its suffix, by which many writers
    choose a format. A file that bears the final name is replaced only then.

    Raises:
        OSError: The file cannot be renamed: nothing was written, or the final name is that of a folder.
    """
    final = Path(final)
    temporary = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.part{final.suffix}")
    try:
        yield temporary
        os.replace(temporary, final)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a whole file at once, which replaces an older one in one step.

    Raises:
        InputError: It cannot be written; then an older file is as it was.
    """
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise InputError(f"{path.name}: expected a folder to write to, got {path.parent}: {error.strerror}.") from None
