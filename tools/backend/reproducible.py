"""Setuptools' build backend, with archives that hold the same bytes whenever and wherever they are
built.

Setuptools writes the times and owners of the files into the source archive. Here every time is
``SOURCE_DATE_EPOCH`` (https://reproducible-builds.org/specs/source-date-epoch/), or the first day
of 2020 where it is not set, and files have no owner. Wheels take the times from the variable by
themselves, but the permissions from the process that builds them: here all may read.
"""

import gzip
import os
import tarfile
import zipfile
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403  every other hook of PEP 517 and PEP 660

os.environ.setdefault("SOURCE_DATE_EPOCH", "1577836800")


def build_sdist(
    sdist_directory: str, config_settings: dict[str, object] | None = None
) -> str:
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


def build_wheel(
    wheel_directory: str,
    config_settings: dict[str, object] | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Build the wheel; the name of its file."""
    name = build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)
    path = Path(wheel_directory) / name
    part = path.with_suffix(".part")
    with (
        zipfile.ZipFile(path) as old,
        zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for member in old.infolist():
            member.external_attr = 0o100644 << 16
            new.writestr(member, old.read(member))
    part.replace(path)
    return name
