"""Export of the town to a dataset on disk, in the layout of KITTI-360, SemanticKITTI or KITTI;
parallel, resumable.

The unit of work is a stretch of road or a part of one, because each process has to build the world
of a stretch.
"""

from functools import partial
from pathlib import Path

from tqdm import tqdm

from lidar_synth.errors import ConfigError, check_count, choose
from lidar_synth.files.claims import claim, hold_writing
from lidar_synth.files.disk import read_text, write_file
from lidar_synth.files.markdown import escape_markdown
from lidar_synth.files.processes import map_in_processes
from lidar_synth.formats.kitti360 import KITTI360Writer
from lidar_synth.formats.kitti_object import KITTIObjectWriter
from lidar_synth.formats.semantic_kitti import SemanticKITTIWriter
from lidar_synth.formats.writer import Writer
from lidar_synth.lab.town.accumulate import (
    check_accumulation,
    window_paths,
    windows_of,
    write_window,
)
from lidar_synth.lab.town.town import Town
from lidar_synth.lab.town.world import STRETCH_FRAMES

LAYOUTS: dict[str, type[Writer]] = {
    "kitti360": KITTI360Writer,
    "semantic_kitti": SemanticKITTIWriter,
    "kitti_object": KITTIObjectWriter,
}
"""The writer of each layout by name."""

SEQUENCES = {"kitti360": 4, "semantic_kitti": 0}
"""The default drive or sequence of a layout: one that every split uses for training."""

SETTINGS = "town.json"
_README = """# Synthetic street scans

These scans are **synthetic**: rays cast into a procedural town by `lidar-synth town` (package
lidar_synth). They are not KITTI-360, SemanticKITTI or KITTI; only the layout of the files is
theirs, so that the same readers and trainers take them.

- layout: {layout}; sensor: {sensor}; seed: {seed}; {interval} s between neighbouring scans
- {frames} neighbouring scans share a stretch of road; instance numbers count within a stretch, and
  stretches lie at least 1 km apart in the poses
{skin}- `{settings}` holds the settings; `lidar-synth town` with the same settings resumes an
  interrupted run
"""


def export_town(
    town: Town,
    out: str | Path,
    layout: str,
    *,
    sequence: int | None = None,
    camera: bool = True,
    accumulate: bool = False,
    jobs: int = 1,
    progress: bool = True,
) -> tuple[int, int]:
    """Write the scans of a town to a dataset folder; a second call resumes an interrupted run.

    Args:
        town: the town to export.
        out: the folder to write to.
        layout: one of ``LAYOUTS``; ``kitti`` is another name of ``kitti_object``.
        sequence: number of the drive or sequence to write, 0 to 99; ``SEQUENCES`` by default.
        camera: whether to render and write the camera image of each scan.
        accumulate: whether to write accumulated clouds beside the scans of layout ``kitti360``, see
            accumulate.py.
        jobs: number of worker processes, at least 1.
        progress: whether to show a progress bar.

    Returns:
        The number of scans written by this call, and the number of scans that already existed.

    Raises:
        ConfigError: on an unknown layout, a sequence or number of jobs out of range, clouds of
            another layout or of too many scans, or a folder that holds another town.
        FileError: if the output cannot be written.
    """
    if layout == "kitti":
        layout = "kitti_object"
    choose("layout", layout, LAYOUTS)
    check_count("jobs", jobs, 1)
    number = SEQUENCES.get(layout, 0) if sequence is None else sequence
    if not 0 <= number < 100:
        raise ConfigError(f"sequence {number}", "0 to 99")
    if accumulate:
        check_accumulation(town, layout)
    _claim_folder(Path(out), town, layout, number, camera)
    with hold_writing(Path(out) / SETTINGS):
        writer = LAYOUTS[layout](out, calibration=town.calibration)
        names = [
            f"{number:02d}/{i:06d}" if layout in SEQUENCES else None
            for i in range(len(town))
        ]
        missing = [i for i, name in enumerate(names) if not writer.complete(i, name)]
        work = partial(_write_group, town, writer, names, camera)
        with (
            tqdm(total=len(missing), unit="scan", disable=not progress) as bar,
            map_in_processes(work, _groups(missing, jobs), jobs) as done,
        ):
            for count in done:
                bar.update(count)
        writer.finish()
        if layout == "semantic_kitti" and len(town):
            _write_times(Path(out) / "sequences" / f"{number:02d}" / "times.txt", town)
        if accumulate:
            _write_windows(
                town, Path(out), f"2013_05_28_drive_{number:04d}_sync", jobs, progress
            )
    return len(missing), len(town) - len(missing)


def _write_times(path: Path, town: Town) -> None:
    """Write the times of the scans; an earlier call may have written more of them, which stay."""
    there = len(read_text(path).splitlines()) if path.is_file() else 0
    if there < len(town):
        write_file(
            path, "".join(f"{town.interval * i:e}\n" for i in range(len(town))).encode()
        )


def _claim_folder(
    out: Path,
    town: Town,
    layout: str,
    sequence: int,
    camera: bool,
) -> None:
    """Write the settings and a README into the folder.

    Raises:
        ConfigError: if the folder was written with other settings.
    """
    settings = {
        "layout": layout,
        "sequence": sequence,
        "camera": camera,
        **town.settings,
    }
    # kitti, as earlier versions wrote it
    claim(out / SETTINGS, settings | {"layout": layout.removesuffix("_object")})
    if not (out / "README.md").exists():
        names = {
            "sensor": escape_markdown(town.sensor.name),
            "frames": STRETCH_FRAMES,
            "settings": SETTINGS,
            "skin": "",
        }
        if town.skin is not None:
            facts = town.skin.provenance
            source = escape_markdown(facts.get("source", "recorded scans"))
            names["skin"] = (
                f"- the look of their returns (skin) was learnt from {source}; licence: "
                f"{escape_markdown(facts['licence'])}\n"
            )
        text = _README.format(**settings | names)
        write_file(out / "README.md", text.encode())


def _groups(indices: list[int], jobs: int) -> list[list[int]]:
    """The indices in groups that do not cross stretches, small enough that every process gets some;
    one index per group with one process, which keeps its stretch in memory anyway."""
    limit = 1 if jobs == 1 else max(1, min(STRETCH_FRAMES, -(-len(indices) // jobs)))
    parts: list[list[int]] = []
    for i in indices:
        if (
            parts
            and len(parts[-1]) < limit
            and parts[-1][-1] // STRETCH_FRAMES == i // STRETCH_FRAMES
        ):
            parts[-1].append(i)
        else:
            parts.append([i])
    return parts


def _write_group(
    town: Town,
    writer: Writer,
    names: list[str | None],
    camera: bool,
    indices: list[int],
) -> int:
    for i in indices:
        writer.write(town[i], i, name=names[i], image=town.image(i) if camera else None)
    return len(indices)


def _write_windows(
    town: Town,
    out: Path,
    drive: str,
    jobs: int,
    progress: bool,
) -> None:
    missing = [
        w for w in windows_of(town) if not window_paths(out, drive, w)[0].is_file()
    ]
    work = partial(write_window, town, out, drive)
    with map_in_processes(work, missing, jobs) as done:
        for _ in tqdm(done, total=len(missing), unit="window", disable=not progress):
            pass
