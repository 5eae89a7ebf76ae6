"""Object stores for tests: fsspec's memory, and an S3 server on this machine."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import fsspec
import pytest

from lidar_synth.bank.folder import open_folder


def empty_memory() -> str:
    """The URL of a bank in an empty memory of this process."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    return "memory://bucket/bank"


@contextmanager
def s3_server() -> Iterator[str]:
    """An S3 server until the block ends; its URL is in the environment, which s3fs reads."""
    server = pytest.importorskip("moto.server").ThreadedMotoServer(port=0)
    s3fs = pytest.importorskip("s3fs")
    server.start()
    host, port = server.get_host_and_port()
    values = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem.clear_instance_cache()
        yield values["AWS_ENDPOINT_URL"]
        s3fs.S3FileSystem.clear_instance_cache()
    server.stop()


def new_bucket(name: str) -> str:
    """The URL of a bank in a new bucket of the server."""
    fsspec.filesystem("s3").mkdir(name)
    return f"s3://{name}/bank"


def files_at(url: str) -> dict[str, bytes]:
    """The files of a complete bank at a URL, after a check that no record is left."""
    folder = open_folder(url)
    names = folder.sizes()
    assert not [name for name in names if "/" in name], names
    assert os.sep not in "".join(names)
    return {name: folder.read(name) for name in names}
