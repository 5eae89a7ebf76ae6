"""Names that libraries have removed: what ``provide`` sets works as the name did, and is announced
in one line."""

import subprocess
import sys
from pathlib import Path

import pytest
from lidar_synth.integrations.removed import NAMES

USES = {
    "numpy.float": "import numpy as np; assert np.zeros(3, dtype=np.float).dtype == np.float64",
    "numpy.int": "import numpy as np; assert np.ones(3).astype(np.int).dtype == np.int64",
    "imp": """
import imp
made = imp.load_source("parserModule", "parser.py")
assert made.Parser().answer() == 42 and sys.modules["parserModule"] is made
""",
    "tensorflow.summary": """
import numpy as np
import tensorflow as tf
writer = tf.summary.FileWriter("logs")
loss = tf.Summary.Value(tag="loss", simple_value=np.float64(0.5))
writer.add_summary(tf.Summary(value=[loss]), 3)
histogram = tf.HistogramProto()
histogram.bucket_limit.append(1.0)
writer.add_summary(tf.Summary(value=[tf.Summary.Value(tag="weights", histo=histogram)]), 3)
writer.flush()
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
events = EventAccumulator("logs").Reload()
assert [(e.step, e.value) for e in events.Scalars("loss")] == [(3, 0.5)]
assert events.Histograms("weights")
""",
    "torchvision": "import torchvision.transforms as transforms",
    "torch.load": """
import numpy as np, torch
torch.save({"loss": np.float64(0.5), "iou": np.float32(0.25), "step": np.int64(3)}, "checkpoint")
assert torch.load("checkpoint") == {"loss": 0.5, "iou": 0.25, "step": 3}
""",
    "spconv": """
import torch
import spconv
import spconv.pytorch.ops
spconv.pytorch.ops.get_current_stream = lambda: 0
cells = torch.tensor([(0, 1, 1, 1), (0, 1, 1, 2), (0, 1, 2, 1)], dtype=torch.int32)
one = spconv.SparseConvTensor(torch.ones(3, 1), cells, [4, 4, 4], 1)
sums = {}
for kernel in ((1, 1, 3), (1, 3, 1)):
    layer = spconv.SubMConv3d(1, 1, kernel, bias=False, indice_key="same")
    torch.nn.init.ones_(layer.weight)
    made = layer(one)
    made.features = made.features * 1.0
    sums[kernel] = made.features[:, 0].tolist()
    made.features.sum().backward()
    assert layer.weight.grad.sum() == 5
assert sums == {(1, 1, 3): [2, 2, 1], (1, 3, 1): [2, 1, 2]}, sums
""",
}
"""A program for each name, as trainers use it."""


@pytest.mark.parametrize("name", NAMES)
def test_a_removed_name_works_again(name: str, tmp_path: Path) -> None:
    if name == "spconv":
        pytest.importorskip("spconv", reason="spconv is not installed")
    (tmp_path / "parser.py").write_text(
        "class Parser:\n    def answer(self):\n        return 42\n"
    )
    hidden = (
        "import importlib.util as u; f = u.find_spec\nu.find_spec = lambda n, *a: None if n == "
        "'imp' else f(n, *a)\n"
    )
    program = (
        f"import sys\n{hidden}from lidar_synth.integrations.removed import provide\nmade = "
        f"provide({name!r})\n"
    )
    ends = f"assert provide({name!r}) == []\n" if name.startswith("numpy") else ""
    command = [sys.executable, "-W", "ignore", "-c", program + USES[name] + "\n" + ends]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = [
        line for line in done.stdout.splitlines() if line.startswith("lidar_synth:")
    ]
    # The library that has the name is installed.
    real = not lines and name in (
        "tensorflow.summary",
        "torchvision",
    )
    assert real or lines == [f"lidar_synth: provides {name} ({NAMES[name][0]})"]


def test_each_name_is_used_in_a_test() -> None:
    assert USES.keys() == NAMES.keys()
