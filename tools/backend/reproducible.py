"""Setuptools' build backend, with archives that hold the same bytes whenever and wherever they are
built.

Setuptools writes the times and owners of the files into the source archive. Here every time is
``SOURCE_DATE_EPOCH`` (https://reproducible-builds.org/specs/source-date-epoch/), or the first day
of 2020 where it is not set, and files have no owner. Wheels follow the variable by themselves.
"""

import gzip
import os
import tarfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  every other hook of PEP 517 and PEP 660

os.environ.setdefault("SOURCE_DATE_EPOCH", "1577836800")


def build_sdist(sdist_directory: str, config_settings: dict[str, object] | None = None) -> str:
    """Build the source archive; the name of its file."""
    name = build_meta.build_sdist(sdist_directory, config_settings)
    path = Path(sdist_directory) / name
    part = path.with_suffix(".part")
    time = int(os.environ["SOURCE_DATE_EPOCH"])
    with (
        tarfile.open(path) as old,
        part.open("wb") as file,
        gzip.GzipFile("", "wb", fileobj=file, mtime=time) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as new,
    ):
        for member in sorted(old.getmembers(), key=lambda member: member.name):
            member.mtime = time
            member.mode = 0o755 if member.mode & 0o100 else 0o644
            member.uid = 0
            member.gid = 0
            member.uname = ""
            member.gname = ""
            member.pax_headers = {}
            new.addfile(member, old.extractfile(member) if member.isfile() else None)
    part.replace(path)
    return name
