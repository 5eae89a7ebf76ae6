"""Where numba keeps the code that it compiles."""

import os
import sys
import warnings
from pathlib import Path

from lidar_synth.errors import FileError


def keep_compiled_code() -> None:
    """Name numba a temporary folder if it may write neither beside this package nor into the user's
    cache: it would raise instead of compiling.

    Raises:
        FileError: if no folder may be written to.
    """
    # Path raises without a home.
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111
    own = Path(__file__).parent / "__pycache__"
    named = "NUMBA_CACHE_DIR" in os.environ
    if named or _may_write(own) or _may_write(Path(user, "numba")):
        return
    import atexit
    import shutil
    import tempfile

    try:
        folder = tempfile.mkdtemp(prefix="lidar_synth-")
    except OSError as error:
        raise FileError(
            "no folder may be written to", "NUMBA_CACHE_DIR=FOLDER, a writable one"
        ) from error
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:  # it has read the environment
        sys.modules["numba"].config.CACHE_DIR = folder
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    warnings.warn(
        "no folder for compiled code may be written to, so every start compiles it again; to keep "
        "it: NUMBA_CACHE_DIR=FOLDER",
        stacklevel=2,
    )


def _may_write(path: Path) -> bool:
    """Whether files may be written into a folder, which may have to be made."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path.is_dir() and os.access(path, os.W_OK)
