"""Mutators of containers of files: zips (``.npz``; ``.pth`` and ``.ckpt`` of PyTorch) and tars
(``.tar``, ``.tgz``). A member is mutated as a file of its own suffix."""

import gzip
import struct
import tarfile
import zipfile
import zlib
from functools import cache
from io import BytesIO
from random import Random

from fuzzing.mutators import INTEGERS, LIMIT, mutate, mutates

Members = list[tuple[str, bytes]]

NAMES = (
    "",
    "x.npy",
    "points.npy",
    "range.npy",
    "sensor.npy",
    "label.npy",
    "allow_pickle.npy",
    "../../x.npy",
    "/x.npy",
    "points.npy/",
    "a" * 60_000,
    "\u00e4.npy",
    "box_values.npy",
    "box_.npy",
    "pose.npy",
    "image.npy",
    "json",
    "a/data.pkl",
    "model/data/0",
    "model/byteorder",
)
"""What a member may be called."""


def unzip(content: bytes) -> Members:
    with zipfile.ZipFile(BytesIO(content)) as opened:
        if sum(info.file_size for info in opened.infolist()) > LIMIT:
            raise ValueError("a bomb, which is not unpacked here")
        return [(name, opened.read(name)) for name in opened.namelist()]


def rezip(members: Members, method: int = zipfile.ZIP_STORED) -> bytes:
    """A zip of the members; the same bytes at any time."""
    file = BytesIO()
    with zipfile.ZipFile(file, "w", method) as opened:
        for name, content in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            opened.writestr(info, content)
    return file.getvalue()


def edit_members(members: Members, rng: Random) -> Members:
    """Members are mutated, dropped, renamed, repeated, swapped or foreign."""
    i = rng.randrange(len(members))
    j = rng.randrange(len(members))
    (name, content), other = members[i], members[j]
    change = rng.randrange(12)
    if change < 6:
        members[i] = (name, mutate(name, content, rng))
    elif change == 6:
        del members[i]
    elif change == 7:
        members[i] = (rng.choice(NAMES), content)
    elif change == 8:
        members.append((name, mutate(name, content, rng)))
    elif change == 9:
        members[i], members[j] = (name, other[1]), (other[0], content)
    elif change == 10:
        members.append((rng.choice(NAMES), rng.choice((content, b"", b"x" * 1000))))
    else:
        members[i], members[j] = members[j], members[i]
    return members


@mutates(".npz", ".pth", ".ckpt")
def edit_zip(content: bytes, rng: Random) -> bytes:
    """The members of the zip change."""
    members = edit_members(unzip(content), rng)
    stored = zipfile.ZIP_STORED
    deflated = zipfile.ZIP_DEFLATED
    return rezip(
        members,
        rng.choice(
            (
                stored,
                stored,
                stored,
                deflated,
                deflated,
                zipfile.ZIP_BZIP2,
                zipfile.ZIP_LZMA,
            )
        ),
    )


@mutates(".npz", ".pth", ".ckpt")
def lie_in_zip(content: bytes, rng: Random) -> bytes:
    """Headers of the zip say another size, method, flag, checksum or place."""
    values = bytearray(content)
    directory = content.index(b"PK\x01\x02")
    starts = [
        i
        for i in range(directory, len(content) - 46)
        if content[i : i + 4] == b"PK\x01\x02"
    ]
    start = rng.choice(starts)
    # Offsets in a central header: flags 8, method 10, CRC 16, sizes 20 and 24, name 28, extra 30,
    # local header 42.
    at, size = rng.choice(
        ((8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (42, 4))
    )
    number = rng.choice((*INTEGERS, 8, 9, 12, 14, 93, 97, 99)) % 256**size
    values[start + at : start + at + size] = number.to_bytes(size, "little")
    return bytes(values)


@cache
def zeros(megabytes: int) -> bytes:
    """That many megabytes of zeros, deflated, in the format of zip."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return (
        b"".join(packer.compress(bytes(1_000_000)) for _ in range(megabytes))
        + packer.flush()
    )


@mutates(".npz", ".pth", ".ckpt")
def bomb_zip(content: bytes, rng: Random) -> bytes:
    """A member that unpacks into far more than the file is long."""
    members = unzip(content)
    name = rng.choice([name for name, _ in members])
    megabytes = rng.choice((1, 1, 700))
    header = bytes.fromhex("934e554d50590100") + (118).to_bytes(2, "little")
    told = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({megabytes * 250_000 - 32},), }}"
    begin = header + told.ljust(117).encode() + b"\n"
    file = BytesIO()
    with zipfile.ZipFile(file, "w") as opened:
        for member, data in members:
            opened.writestr(zipfile.ZipInfo(member), b"" if member == name else data)
    # The bomb is entered by hand: its member's data are a deflated stream that was made once.
    packed = zlib.compressobj(9, zlib.DEFLATED, -15)
    body = packed.compress(begin) + packed.flush(zlib.Z_FULL_FLUSH) + zeros(megabytes)
    return replace_member(
        file.getvalue(), name, body, len(begin) + megabytes * 1_000_000
    )


def replace_member(content: bytes, name: str, body: bytes, size: int) -> bytes:
    """A zip whose empty member ``name`` holds a deflated body that claims to unpack into ``size``
    bytes."""
    with zipfile.ZipFile(BytesIO(content)) as opened:
        info = opened.getinfo(name)
        directory = opened.start_dir
    at = info.header_offset + 30 + len(name.encode())
    values = bytearray(content)
    central = values.index(name.encode(), directory) - 46
    for start, method, sizes in ((info.header_offset, 8, 18), (central, 10, 20)):
        values[start + method : start + method + 2] = (8).to_bytes(2, "little")
        values[start + sizes : start + sizes + 8] = len(body).to_bytes(
            4, "little"
        ) + size.to_bytes(4, "little")
    moved = bytearray(values)
    for start in [
        i
        for i in range(directory, len(values) - 46)
        if values[i : i + 4] == b"PK\x01\x02"
    ]:
        offset = int.from_bytes(values[start + 42 : start + 46], "little")
        if offset > info.header_offset:
            moved[start + 42 : start + 46] = (offset + len(body)).to_bytes(4, "little")
    end = moved.rindex(b"PK\x05\x06")
    moved[end + 16 : end + 20] = (directory + len(body)).to_bytes(4, "little")
    return bytes(moved[:at]) + body + bytes(moved[at:])


def untar(content: bytes) -> Members:
    with tarfile.open(fileobj=BytesIO(content)) as opened:
        return [(m.name, opened.extractfile(m).read()) for m in opened]  # type: ignore[union-attr]


LARGEST = 16 * LIMIT
"""Bytes that a mutator unpacks."""


def gunzip(content: bytes) -> bytes:
    """The bytes in a gzip file."""
    with gzip.open(BytesIO(content)) as opened:
        found = opened.read(LARGEST + 1)
    if len(found) > LARGEST:
        raise ValueError("a bomb, which is not unpacked here")
    return found


def retar(
    members: Members,
    kinds: dict[int, bytes] | None = None,
    form: int = tarfile.PAX_FORMAT,
) -> bytes:
    """A tar of the members; some may be of another kind than a file."""
    file = BytesIO()
    with tarfile.open(fileobj=file, mode="w", format=form) as opened:
        for i, (name, content) in enumerate(members):
            info = tarfile.TarInfo(name)
            info.size = len(content)
            info.type = (kinds or {}).get(i, tarfile.REGTYPE)
            info.linkname = members[0][0]
            opened.addfile(info, BytesIO(content))
    return file.getvalue()


@mutates(".tar")
def edit_tar(content: bytes, rng: Random) -> bytes:
    """The members of the tar change."""
    members = untar(content)
    i = rng.randrange(len(members))
    if rng.random() < 0.25:
        stem, dot, kind = members[i][0].partition(".")
        ends = ("json", "points.npy", "ring.npy", "pose.npy", f"{kind}.npy", kind)
        name = (
            rng.choice(
                ("x", "../../" + stem, "%2E%2E/x", "/x", "", "a" * 300, "\udcff", stem)
            )
            + dot
            + rng.choice(ends)
        )
        members[i] = (name, members[i][1])
    else:
        members = edit_members(members, rng)
    return retar(members, form=rng.choice((tarfile.PAX_FORMAT, tarfile.GNU_FORMAT)))


@mutates(".tar")
def change_kinds(content: bytes, rng: Random) -> bytes:
    """Members that are links, folders, devices or sparse files."""
    members = untar(content)
    kinds = (
        tarfile.LNKTYPE,
        tarfile.SYMTYPE,
        tarfile.CHRTYPE,
        tarfile.DIRTYPE,
        tarfile.FIFOTYPE,
        tarfile.CONTTYPE,
        tarfile.GNUTYPE_LONGNAME,
        tarfile.GNUTYPE_SPARSE,
        tarfile.XHDTYPE,
        tarfile.XGLTYPE,
        b"Z",
    )
    return retar(members, {rng.randrange(len(members)): rng.choice(kinds)})


@mutates(".tar")
def lie_in_tar(content: bytes, rng: Random) -> bytes:
    """A header says another size, or name, with a checksum that fits."""
    with tarfile.open(fileobj=BytesIO(content)) as opened:
        start = rng.choice([member.offset for member in opened])
    header = bytearray(content[start : start + 512])
    if rng.random() < 0.7:
        size = rng.choice((0, 1, 511, 10**6, 8**11 - 1, 2**40, 2**62, 2**63 - 1, 2**80))
        header[124:136] = (
            b"%011o\x00" % size if size < 8**11 else b"\x80" + size.to_bytes(11, "big")
        )
    else:
        header[:100] = rng.randbytes(rng.choice((1, 10, 100))).ljust(100, b"\x00")
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\x00 " % sum(header)
    return content[:start] + bytes(header) + content[start + 512 :]


@mutates(".tgz")
def edit_packed_tar(content: bytes, rng: Random) -> bytes:
    """The tar inside changes."""
    change = rng.choice((edit_tar, edit_tar, change_kinds, lie_in_tar))
    return gzip.compress(change(gunzip(content), rng), 1, mtime=0)


@mutates(".tgz")
def bomb_tar(content: bytes, rng: Random) -> bytes:
    """A member unpacks into far more than the file is long."""
    members = untar(gunzip(content))
    name = rng.choice([name for name, _ in members])
    megabytes = rng.choice((1, 1, 700))
    info = tarfile.TarInfo(name)
    info.size = megabytes * 1_000_000
    return gzip.compress(info.tobuf(), 1, mtime=0) + gzipped_zeros(megabytes) + content


@cache
def gzipped_zeros(megabytes: int) -> bytes:
    """That many megabytes of zeros and the rest of a tar's last block, as gzip writes them."""
    packer = zlib.compressobj(9, wbits=31)
    body = b"".join(packer.compress(bytes(1_000_000)) for _ in range(megabytes))
    return body + packer.compress(bytes(-megabytes * 1_000_000 % 512)) + packer.flush()


@mutates(".mcap")
def change_record(content: bytes, rng: Random) -> bytes:
    """The length of a record of an MCAP file, or a number at its beginning, is another one."""
    starts = [8]
    while starts[-1] + 9 <= len(content):
        [length] = struct.unpack_from("<Q", content, starts[-1] + 1)
        starts.append(starts[-1] + 9 + length)
    at = rng.choice(starts[:-1] or [0]) + 1 + rng.choice((0, 8, 16, 24, 32))
    number = rng.choice(INTEGERS) % 2**64
    return content[:at] + number.to_bytes(8, "little") + content[at + 8 :]
