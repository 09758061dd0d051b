"""Digest of the package's sources, which identifies the code that computed a number.

Two states of a checkout have one version number, so results that are to be continued later hold it as well.
"""

import hashlib
from pathlib import Path

_ROOT = Path(__file__).parents[1]


def _list_files() -> list[Path]:
    """Source files of this package and the files of its missions."""
    return sorted(path for path in _ROOT.rglob("*") if path.suffix in (".py", ".toml"))


def _file_stamps() -> dict[Path, tuple[int, int]]:
    """Time of change and size of each of the files."""
    stats = {path: path.stat() for path in _list_files()}
    return {path: (stat.st_mtime_ns, stat.st_size) for path, stat in stats.items()}


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
    digest = hashlib.sha256()
    for path in _list_files():
        content = path.read_bytes()
        digest.update(f"{path.relative_to(_ROOT).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.hexdigest()[:16]
