"""A trainer of lidar-bonnetal's family with other names: its own script, in a checkout as small as
can be."""

from pathlib import Path

from launched import epochs, launched
from streets import semantic_kitti, synthetic

SCRIPT = """
from modules.trainer import Trainer
from torch.utils.data import default_collate

Trainer().train()
"""
TRAINER = """
class warmupLR:
    state_dict = load_state_dict = None

class Trainer:
    def train(self):
        from dataset.kitti.parser import Parser  # within a function, as CENet does
        loader = Parser().get_train_set()
        for epoch in (0, 1):
            self.train_epoch(train_loader=loader, model=None, epoch=epoch)

    def train_epoch(self, train_loader, model, epoch):
        print("lengths", len(train_loader.dataset), [len(batch) for batch in train_loader])
"""
PARSER = """
from pathlib import Path
import torch
from lidar_synth.datasets.classes import SEMANTIC_KITTI

class LaserScan:
    def __init__(self, *args):
        import numpy
        self.proj_range = numpy.ones((4, 8))

    def open_scan(self, path):
        pass

    def set_points(self, points, remissions):
        pass

class SemanticKitti:
    def __init__(self, root, sequences, **options):
        self.__dict__ |= options
        self.sensor_img_H, self.sensor_img_W = 4, 8
        self.sensor_fov_up, self.sensor_fov_down = 3, -25
        self.scan_files = sorted(map(str, Path(root).glob("sequences/*/velodyne/*.bin")))
        self.label_files = [
            path.replace("velodyne", "labels").replace(".bin", ".label")
            for path in self.scan_files
        ]

    def __len__(self):
        return len(self.scan_files)

    def __getitem__(self, index):
        return "synthetic" in self.scan_files[index]

class Parser:
    def __init__(self):
        super(Parser, self).__init__()
        raw = SEMANTIC_KITTI.from_train
        self.root, self.train_sequences = "sk", [0]
        self.batch_size, self.workers, self.shuffle_train = 2, 0, True
        options = {"labels": {}, "color_map": {}, "sensor": None, "max_points": 9**6, "gt": True}
        options["learning_map"] = {k: i + 1 for i, k in enumerate(raw)} | {0: 0}
        options["learning_map_inv"] = {i + 1: k for i, k in enumerate(raw)} | {0: 0}
        self.train_dataset = SemanticKitti(self.root, [0], **options)
        self.trainloader = torch.utils.data.DataLoader(self.train_dataset, batch_size=2)
        self.trainiter = iter(self.trainloader)

    def get_train_set(self):
        return self.trainloader
"""


def test_a_trainer_that_imports_its_parser_trains_on_the_mixture(
    tmp_path: Path,
) -> None:
    """CENet's layout, without the names of lidar-bonnetal's packages; without a GPU nothing else
    need be set."""
    semantic_kitti(tmp_path / "sk", 6)
    synthetic(tmp_path / "synthetic", 8)
    (tmp_path / "mix.yaml").write_text(
        f"synthetic: {tmp_path / 'synthetic'}\nratio: 0.4\n"
    )
    files = {
        "train.py": SCRIPT,
        "modules/trainer.py": TRAINER,
        "dataset/kitti/parser.py": PARSER,
    }
    for name, code in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(code)
    said = launched("rangenet", "train.py", cwd=tmp_path, mixture=tmp_path / "mix.yaml")
    assert [line[:3] for line in epochs(said)] == [(0, 10, 4), (1, 10, 4)]
    assert said.count("lengths 10 [2, 2, 2, 2, 2]") == 2
    assert "stays on the CPU" in said
    (tmp_path / "train_poss.py").write_text(SCRIPT)
    said = launched("rangenet", "train_poss.py", cwd=tmp_path, mixture=Path(), status=1)
    assert "train_poss.py, whose trainer would see real scans only" in said
