"""Digest of the package's sources, which identifies the code that computed a number.

Two states of a checkout have one version number, so results that are to be continued later hold it as well.
"""

import hashlib
import os
from functools import cache
from pathlib import Path

_ROOT = Path(__file__).parents[1]


def _file_stamps() -> dict[str, tuple[int, int]]:
    """Time of change and size of each source file of this package and of each file of its missions."""
    stamps = {}
    for folder, _, names in os.walk(_ROOT):
        for name in names:
            if name.endswith((".py", ".toml")):
                path = os.path.join(folder, name)
                stat = os.stat(path)
                stamps[path] = stat.st_mtime_ns, stat.st_size
    return stamps


_STAMPS_AT_IMPORT = _file_stamps()


def source_digest() -> str:
    """Digest of the sources of this package that this process has imported.

    Raises:
        SettingError: a source file was changed after the package was imported, so that the files
            are not the code that runs.
    """
    if changed := _file_stamps().items() ^ _STAMPS_AT_IMPORT.items():
        from .errors import SettingError  # imports JAX, which the package's root does not

        raise SettingError(
            f"{min(changed)[0]} was changed after this process imported stmuav_jax, so that the version "
            f"of the running code is unknown: start a new process."
        )
    return _digest_content()


@cache
def _digest_content() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(path) for path in _STAMPS_AT_IMPORT):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(_ROOT).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]
