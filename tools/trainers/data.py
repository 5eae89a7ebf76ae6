"""Datasets on disk for the trials: real scans where the machine has them, the town beside them, and
synthetic scans.

Real scans come from the folders that LIDAR_SYNTH_LABELLED_SCANS (``semantic_kitti/sequences``) and
LIDAR_SYNTH_REAL_SCANS (``kitti_object/training``) name; without them every scan is one of the town.
Each dataset is written when it is first used.
"""

import os
import shutil
import subprocess
import sys
from functools import cached_property
from pathlib import Path

from lidar_synth.lab.town import STRETCH_FRAMES, Town, export_town
from lidar_synth.labels import ObjectBank

TRAINING = tuple(f"{number:02d}" for number in (0, 1, 2, 3, 4, 5, 6, 7, 9, 10))
VALIDATION = "08"
KITTI = ("velodyne", "label_2", "calib", "image_2")
"""Folders of KITTI's object set."""
REAL_VALIDATION = "09"
"""The recorded sequence that serves as sequence 08, which every trainer validates on."""


class Data:
    """Datasets for the trials.

    Args:
        folder: where they are written.
        scans: number of scans of each SemanticKITTI sequence, and of the town in KITTI's object
            set.
    """

    def __init__(self, folder: Path, scans: int = 1) -> None:
        self.folder = folder
        self.scans = scans

    @cached_property
    def real(self) -> str:
        """Where the real scans come from, for the table."""
        kinds = {
            "LIDAR_SYNTH_LABELLED_SCANS": "SemanticKITTI",
            "LIDAR_SYNTH_REAL_SCANS": "KITTI object",
        }
        given = [kind for variable, kind in kinds.items() if os.environ.get(variable)]
        return f"{' and '.join(given)}, and the town" if given else "the town"

    @cached_property
    def semantic_kitti(self) -> Path:
        """SemanticKITTI's ``dataset`` folder: sequences 00 to 10; those without real scans are
        streets of the town."""
        out = self.folder / "semantic_kitti"
        recorded = (
            Path(os.environ.get("LIDAR_SYNTH_LABELLED_SCANS", ""))
            / "semantic_kitti"
            / "sequences"
        )
        use = bool(os.environ.get("LIDAR_SYNTH_LABELLED_SCANS"))
        for number in (*TRAINING, VALIDATION):
            source = recorded / (REAL_VALIDATION if number == VALIDATION else number)
            target = out / "sequences" / number
            if target.is_dir():
                continue
            if (
                use
                and source.is_dir()
                and (number == VALIDATION or number != REAL_VALIDATION)
            ):
                self._copy_sequence(source, target)
            else:
                self._town_sequence(int(number), target)
        return out

    @cached_property
    def kitti(self) -> Path:
        """KITTI's object set with ``ImageSets``: the real frames that have an image, then frames of
        the town.

        The last frame of each kind is for validation.
        """
        out = self.folder / "kitti"
        if out.is_dir():
            return out
        made = self.folder / "kitti.part"
        town = self._town_frames(made)
        real = self._real_frames(made)
        validation = [frames[-1] for frames in (real, town) if frames]
        every = sorted(real + town)
        splits = {
            "train": [frame for frame in every if frame not in validation],
            "val": sorted(validation),
            "trainval": every,
        }
        for split, frames in splits.items():
            lines = "".join(f"{frame}\n" for frame in frames)
            (made / "ImageSets" / f"{split}.txt").write_text(lines)
        made.rename(out)
        return out

    def _town_frames(self, made: Path) -> list[str]:
        """Write frames of the town; their names."""
        town = Town(seed=1, scans=self.scans + 1)
        export_town(town, made, "kitti", camera=True, progress=False)
        for path in sorted(made.glob("training/*/*")):
            # KITTI's own numbers end below 007481.
            path.rename(path.with_name(f"{int(path.stem) + 7500:06d}{path.suffix}"))
        return sorted(path.stem for path in made.glob("training/velodyne/*.bin"))

    def _real_frames(self, made: Path) -> list[str]:
        """Copy the real frames that have an image; their names."""
        root = os.environ.get("LIDAR_SYNTH_REAL_SCANS")
        if not root:
            return []
        frames = []
        for image in sorted(Path(root).glob("kitti_object/training/image_2/*.png")):
            folders = [image.parents[1] / kind for kind in KITTI]
            files = [f for each in folders for f in each.glob(f"{image.stem}.*")]
            if len(files) == len(KITTI):
                frames.append(image.stem)
                for file in files:
                    shutil.copyfile(
                        file, made / "training" / file.parent.name / file.name
                    )
        return frames

    @cached_property
    def bank(self) -> Path:
        """A bank of eight scans of ``town``, on 64 x 1024 cells."""
        return self._bank("bank", 1024)

    @cached_property
    def dense_bank(self) -> Path:
        """A bank of eight scans of ``town``, on 64 x 2048 cells."""
        return self._bank("dense_bank", 2048)

    def _bank(self, name: str, columns: int) -> Path:
        out = self.folder / name
        bake = [sys.executable, "-m", "lidar_synth", "bake", out, "--count", "8"]
        bake += ["--columns", str(columns)]
        subprocess.run(bake, check=True, stdout=subprocess.DEVNULL)
        return out

    @cached_property
    def objects(self) -> Path:
        """A bank of objects of 20 streets of the town, for ``labels: paste``."""
        out = self.folder / "objects.npz"
        if not out.exists():
            town = Town(seed=2, scans=20 * STRETCH_FRAMES)
            ObjectBank.from_scans(town, range(0, len(town), STRETCH_FRAMES)).save(out)
        return out

    def _copy_sequence(self, source: Path, target: Path) -> None:
        frames = sorted((source / "velodyne").glob("*.bin"))[: self.scans]
        for kind in ("velodyne", "labels"):
            (target / kind).mkdir(parents=True)
        for frame in frames:
            shutil.copyfile(frame, target / "velodyne" / frame.name)
            shutil.copyfile(
                source / "labels" / f"{frame.stem}.label",
                target / "labels" / f"{frame.stem}.label",
            )
        for name in ("calib.txt", "poses.txt", "times.txt"):
            if (source / name).is_file():
                shutil.copyfile(source / name, target / name)

    def _town_sequence(self, number: int, target: Path) -> None:
        made = self.folder / f"town-{number:02d}"
        town = Town(seed=number, scans=self.scans)
        export_town(
            town, made, "semantic_kitti", sequence=number, camera=False, progress=False
        )
        target.parent.mkdir(parents=True, exist_ok=True)
        (made / "sequences" / f"{number:02d}").rename(target)
        shutil.rmtree(made)
